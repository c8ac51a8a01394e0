"""Rows of tokens as tensors: padded, grouped by length, or packed so that no text in a row sees another."""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

PADDING = -1  # the segment of padding in a packed row
MOST_GROUPS = 4  # passes that a batch is split into at most
PASS = 64  # what a pass costs besides its tokens, in tokens


@dataclass(frozen=True)
class Example:
    """One text to learn from: ``learn[i]`` is True where token i is a target of the loss.

    The first token never is: nothing before it could predict it.
    """

    tokens: tuple[int, ...]
    learn: tuple[bool, ...]


def positions(real: Tensor) -> Tensor:
    """Position of every token [B, T]: real tokens count from 0, padding does not count."""
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


def length_groups(real: Tensor, mask: Tensor) -> list[Tensor]:
    """Rows [B] of about one length each, in as many groups as make the padded passes cheapest.

    A group costs its rows times the longest prompt and the longest response among them, and a pass PASS
    tokens more, however small it is.
    """
    prompts = real[:, : real.shape[1] - mask.shape[1]].sum(1)
    places = torch.arange(1, mask.shape[1] + 1, device=mask.device)
    responses = torch.where(mask, places, 0).amax(1)
    order = (prompts + responses).argsort(stable=True)
    sizes = torch.stack([prompts, responses])[:, order].cpu()

    def cost(groups: int) -> int:
        parts = sizes.tensor_split(groups, dim=1)
        return sum(part.shape[1] * int(part.amax(1).sum()) + PASS for part in parts)

    fewest = min(range(1, min(MOST_GROUPS, len(mask)) + 1), key=cost)
    return list(order.tensor_split(fewest))


def used_columns(real: Tensor, mask: Tensor) -> tuple[int, int]:
    """The columns [left, right) of [B, P + R] whose states matter: from the first real prompt token to the
    token before the last counting one, whose state decides that last token.
    """
    prompt = real.shape[1] - mask.shape[1]
    any_prompt = real[:, :prompt].any(0).nonzero()
    any_response = mask.any(0).nonzero()
    left = int(any_prompt[0]) if len(any_prompt) else prompt - 1
    right = prompt + (int(any_response[-1]) if len(any_response) else 0)
    return left, right


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


def pack_rows(examples: Sequence[Example], length: int) -> list[Packed]:
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
