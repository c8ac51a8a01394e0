"""Tensors that grow from checkpoint to checkpoint: only what is new is written, to one file of the run.

A group of tensors under the name `GROUP` is not part of a checkpoint's folder. Its rows go to `FILE`, one
line a tensor and save: {"name", "first", "width", "rows"}, the rows as base64 of little-endian int32
[n, width]; they take the place of all rows from ``first`` on. The checkpoint holds lengths and hashes.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tightrope.runs.durable import replace_file
from tightrope.runs.records import dumps, read_lines

if TYPE_CHECKING:
    from torch import Tensor

GROUP, FILE = "actions", "actions.jsonl"
SMALL = 4 << 20  # bytes of a file in which nothing is looked for that could be dropped


def lines(tensors: dict[str, Tensor], held: dict[str, int]) -> Iterator[dict[str, Any]]:
    """The lines for what is not yet in a file that holds so many rows of each."""
    for name, tensor in tensors.items():
        first = held.get(name, 0)
        if first < len(tensor):
            rows = tensor[first:].numpy().astype("<i4")
            text = base64.b64encode(rows.tobytes()).decode()
            yield {"name": name, "first": first, "width": rows.shape[1], "rows": text}


def marks(tensors: dict[str, Tensor]) -> dict[str, tuple[int, str]]:
    """How many rows each has, and their SHA-256."""
    return {name: (len(tensor), _digest(tensor.numpy())) for name, tensor in tensors.items()}


def gathered(path: Path, wanted: dict[str, tuple[int, str]]) -> dict[str, Tensor]:
    """The tensors that have these marks. ValueError when the file does not hold them."""
    import numpy as np
    import torch

    found: dict[str, Any] = {}
    for line in _of(path, wanted):
        name, first = line["name"], line["first"]
        rows = np.frombuffer(base64.b64decode(line["rows"]), "<i4").reshape(-1, line["width"])
        found[name] = np.concatenate([found[name][:first], rows]) if first else rows
    tensors = {}
    for name, (length, digest) in wanted.items():
        rows = found.get(name, np.zeros((0, 0)))[:length].astype(np.int32)
        if len(rows) != length or _digest(rows) != digest:
            raise ValueError(f"{path} does not hold the {length} rows of {name!r} that were saved")
        tensors[name] = torch.from_numpy(rows)
    return tensors


def drop_others(path: Path, names: Collection[str]) -> int:
    """Leave only these tensors in a file, which is whole at every moment; its new size in bytes."""
    content = "".join(dumps(line) + "\n" for line in _of(path, names)).encode()
    replace_file(path, content)
    return len(content)


def _of(path: Path, names: Collection[str]) -> Iterable[dict[str, Any]]:
    return (line for line in read_lines(path) if line["name"] in names)


def _digest(rows: Any) -> str:
    return hashlib.sha256(rows.astype("<i4").tobytes()).hexdigest()
