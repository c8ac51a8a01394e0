"""Held-out examples."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from typing import TypeVar

import numpy as np

Item = TypeVar("Item")


def hold_out(
    items: Sequence[Item], share: float, seed: int, group: Callable[[Item], Hashable] | None = None
) -> tuple[list[Item], list[Item]]:
    """Items to train on and items held out, about ``share`` of them, drawn by the seed; in their order.

    Items of one ``group`` stay together, unless a group is larger than the share; equal items always do,
    where not all are equal. At least one item is held out where there are two or more and the share is above
    0.
    """
    left = max(1, round(share * len(items))) if share > 0 and len(items) > 1 else 0
    keys: list[Hashable] = list(items) if len(set(items)) > 1 else list(range(len(items)))
    if group is not None:
        groups: list[Hashable] = [group(item) for item in items]
        keys = groups if max(Counter(groups).values(), default=0) <= left else keys
    sizes = Counter(keys)
    names = list(sizes)
    held: set[Hashable] = set()
    for index in np.random.default_rng([seed, 1]).permutation(len(names)):
        if left <= 0:
            break
        held.add(names[index])
        left -= sizes[names[index]]
    parts: tuple[list[Item], list[Item]] = ([], [])
    for item, key in zip(items, keys, strict=True):
        parts[key in held].append(item)
    return parts
