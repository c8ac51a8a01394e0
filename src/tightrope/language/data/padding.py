"""Rows of unequal length as one tensor, and the positions of their tokens."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def positions(real: Tensor) -> Tensor:
    """Position of every token [B, T]: real tokens count from 0, whatever the padding."""
    return (real.long().cumsum(1) - 1).clamp(min=0)


def pad_left(rows: Sequence[Sequence[int]], filler: int = 0) -> tuple[Tensor, Tensor]:
    """Rows of ids as one [B, T] int64 that ends where they end, and its mask: True where a token is real."""
    return _pad(rows, filler, left=True)


def pad_right(rows: Sequence[Sequence[int]], filler: int = 0) -> tuple[Tensor, Tensor]:
    """Rows of ids as one [B, T] int64 that begins where they begin, and its mask: True where a token is
    real.
    """
    return _pad(rows, filler, left=False)


def _pad(rows: Sequence[Sequence[int]], filler: int, *, left: bool) -> tuple[Tensor, Tensor]:
    length = max((len(row) for row in rows), default=0)
    tokens = torch.full((len(rows), length), filler, dtype=torch.int64)
    real = torch.zeros(len(rows), length, dtype=torch.bool)
    for i, row in enumerate(rows):
        place = slice(length - len(row), length) if left else slice(len(row))
        tokens[i, place] = torch.tensor(row, dtype=torch.int64)
        real[i, place] = True
    return tokens, real
