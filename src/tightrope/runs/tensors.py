"""Named tensors as the bytes of a safetensors file, one tensor at a time.

The writer of the safetensors library copies every tensor first, and the caller cannot hash the bytes while
they are written. This one yields the bytes. The format: the length of the header (8 bytes, little-endian),
the header as JSON, padded to a multiple of 8, the tensors.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

_NAMES = {
    "bool": "BOOL",
    "uint8": "U8",
    "int8": "I8",
    "uint16": "U16",
    "int16": "I16",
    "float16": "F16",
    "bfloat16": "BF16",
    "uint32": "U32",
    "int32": "I32",
    "float32": "F32",
    "uint64": "U64",
    "int64": "I64",
    "float64": "F64",
}


def safetensors_bytes(tensors: dict[str, Tensor]) -> Iterator[bytes | memoryview]:
    """The bytes of a safetensors file of these tensors. ValueError for a dtype without a name there."""
    import torch

    ordered = sorted(tensors, key=lambda name: (-tensors[name].itemsize, name))  # so that each is aligned
    header, end = {}, 0
    for name in ordered:
        tensor, begin = tensors[name], end
        kind = str(tensor.dtype).removeprefix("torch.")
        if kind not in _NAMES:
            raise ValueError(f"{name} is a tensor of {kind}; a checkpoint holds {', '.join(_NAMES)}.")
        end = begin + tensor.numel() * tensor.itemsize
        header[name] = {"dtype": _NAMES[kind], "shape": list(tensor.shape), "data_offsets": [begin, end]}
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    yield len(text).to_bytes(8, "little") + text
    for name in ordered:
        plain = tensors[name].detach().cpu().contiguous().reshape(-1)
        yield plain.view(torch.uint8).numpy().data
