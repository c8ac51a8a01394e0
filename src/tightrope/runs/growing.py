"""Tensors that grow from checkpoint to checkpoint: only what is new is written, to one file of the run.

A group of tensors under the name `GROUP` is not part of a checkpoint's folder. Its rows go to `FILE`, one
line a tensor and save: {"name", "first", "rows"}, the rows as base64 of little-endian int32 [n, width]. The
checkpoint holds the lengths.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor

GROUP, FILE = "actions", "actions.jsonl"


def lines(tensors: dict[str, Tensor], held: dict[str, int]) -> Iterator[dict[str, Any]]:
    """The lines for what is not yet in a file that holds so many rows of each."""
    for name, tensor in tensors.items():
        first = held.get(name, 0)
        if first < len(tensor):
            rows = tensor[first:].numpy().astype("<i4")
            text = base64.b64encode(rows.tobytes()).decode()
            yield {"name": name, "first": first, "width": rows.shape[1], "rows": text}


def lengths(tensors: dict[str, Tensor]) -> dict[str, int]:
    """How many rows each has."""
    return {name: len(tensor) for name, tensor in tensors.items()}


def held_in(found: Iterable[dict[str, Any]]) -> dict[str, int]:
    """How many rows of each tensor the lines of a file hold."""
    held: dict[str, int] = {}
    for line in found:
        held[line["name"]] = line["first"] + len(_rows(line))
    return held


def gathered(found: Iterable[dict[str, Any]], wanted: dict[str, int]) -> dict[str, Tensor]:
    """The tensors of these lengths. ValueError when the lines do not hold them."""
    import numpy as np
    import torch

    parts: dict[str, list[Any]] = {name: [] for name in wanted}
    for line in found:
        if line["name"] in parts:
            parts[line["name"]].append(_rows(line))
    tensors = {}
    for name, length in wanted.items():
        rows = np.concatenate(parts[name])[:length] if parts[name] else ()
        if len(rows) != length:
            raise ValueError(f"{FILE} holds {len(rows)} rows of {name!r}, the checkpoint counts on {length}")
        tensors[name] = torch.from_numpy(rows)
    return tensors


def _rows(line: dict[str, Any]) -> Any:
    import numpy as np

    return np.frombuffer(base64.b64decode(line["rows"]), "<i4").reshape(-1, line["width"]).astype(np.int32)
