"""Several texts in one row of tokens, without any of them seeing another."""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from tightrope.language.data.examples import Example

PADDING = -1  # the segment of padding in a packed row


@dataclass(frozen=True)
class Packed:
    """Rows [B, N] of one or more texts each: tokens, their positions in their own text, which text of the row
    they belong to (``segments``, from 0; PADDING: none), and which are learnt.
    """

    tokens: Tensor
    positions: Tensor
    segments: Tensor
    learn: Tensor

    def __len__(self) -> int:
        """The number of columns."""
        return self.tokens.shape[1]

    def to(self, device: torch.device | str) -> Packed:
        """The same on another device."""
        return Packed(*(x.to(device) for x in (self.tokens, self.positions, self.segments, self.learn)))


def row_of(examples: Sequence[Example]) -> Packed:
    """Several examples as one row [1, N]."""
    lengths = [len(example.tokens) for example in examples]
    places = torch.cat([torch.arange(n) for n in lengths])
    segments = torch.repeat_interleave(torch.arange(len(examples)), torch.tensor(lengths))
    tokens = torch.tensor([token for example in examples for token in example.tokens])
    learn = torch.tensor([learnt for example in examples for learnt in example.learn])
    return Packed(*(x[None] for x in (tokens, places, segments, learn)))


def pack(examples: Sequence[Example], length: int) -> list[Packed]:
    """All examples in rows of at most ``length`` tokens: the longest first, each into the fullest row that
    still holds it (best fit decreasing). ValueError for an example that fits no row.
    """
    rows: list[list[int]] = []
    room: list[tuple[int, int]] = []  # sorted: tokens left, row
    for i in sorted(range(len(examples)), key=lambda i: -len(examples[i].tokens)):
        size = len(examples[i].tokens)
        if size > length:
            raise ValueError(f"examples[{i}] has {size} tokens; rows have {length}. Cut it first.")
        place = bisect.bisect_left(room, (size, -1))
        left, row = room.pop(place) if place < len(room) else (length, len(rows))
        if row == len(rows):
            rows.append([])
        rows[row].append(i)
        bisect.insort(room, (left - size, row))
    return [row_of([examples[i] for i in sorted(row)]) for row in rows]


def collate(rows: Sequence[Packed], filler: int = 0) -> Packed:
    """Rows [1, N] as one [B, N], padded on the right. Padding is a segment of its own and is never learnt."""
    width = max(len(row) for row in rows)

    def stack(name: str, value: int) -> Tensor:
        columns = [getattr(row, name) for row in rows]
        return torch.cat([torch.nn.functional.pad(x, (0, width - x.shape[1]), value=value) for x in columns])

    return Packed(
        stack("tokens", filler), stack("positions", 0), stack("segments", PADDING), stack("learn", 0)
    )


def attention_of(segments: Tensor) -> Tensor:
    """[B, N] segments -> bool [B, 1, N, N], True where a token (row) sees another (column): itself, or an
    earlier one of its own text. Padding sees padding, since a softmax over nothing is NaN.
    """
    length = segments.shape[1]
    causal = torch.ones(length, length, dtype=torch.bool, device=segments.device).tril()
    return ((segments[:, :, None] == segments[:, None, :]) & causal)[:, None]
