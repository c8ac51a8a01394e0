"""What both sides of a task share: the basic spaces inside a space, in Gymnasium's flatten order.

Worker processes import this folder, so it needs numpy only.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from gymnasium import Space, spaces

Path = tuple[str | int, ...]
Array = np.ndarray
Inputs = dict[str, Array]
MASK_KEY = "action_mask"
SUPPORTED = "Box, Discrete, MultiDiscrete, MultiBinary, and Tuple or Dict of these"
BOUND_LIMIT = 1e6  # bounds from here on stand for "no bound": nobody means to use the whole range


class Reading(NamedTuple):
    """How the spaces of a task are read: the settings ``encoder``, ``action_bounds`` and
    ``observation_keys``."""

    encoder: str = "auto"
    action_bounds: str = "map"
    keys: tuple[str, ...] = ()

    @classmethod
    def of(cls, settings: Any) -> Reading:
        """As a run's settings ask for."""
        return cls(settings.encoder, settings.action_bounds, settings.observation_keys)


@dataclass(frozen=True)
class Component:
    """One independent part of an action: its distribution and its places in parameters, columns and mask."""

    kind: Literal["categorical", "bernoulli", "gaussian"]
    parameter: int  # first of its parameters among the actor's P outputs
    count: int  # categories, bits, or dimensions
    column: int  # first of its columns in the action matrix
    width: int  # how many columns: one index, or one a bit or dimension
    mask: int  # first of its entries in the flat mask; -1 for gaussian
    deviation: int  # first of its entries in a vector of all Gaussian dimensions


def walk(space: Space, what: str, path: Path = ()) -> Iterator[tuple[Path, Space]]:
    """The basic spaces inside ``space`` with their paths, in Gymnasium's flatten order."""
    if isinstance(space, spaces.Dict):
        for key, part in space.spaces.items():
            yield from walk(part, what, (*path, key))
    elif isinstance(space, spaces.Tuple):
        for index, part in enumerate(space.spaces):
            yield from walk(part, what, (*path, index))
    elif isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        yield path, space
    else:
        raise ValueError(
            f"the {what} space{place_of(path)} is {space!r}; supported are {SUPPORTED}. "
            "Wrap the environment so that it offers one of these."
        )


def selected(space: Space, keys: tuple[str, ...]) -> Space:
    """The space as it is, or of a Dict these keys and the action mask. ValueError: a key that is not there,
    or without keys a part that is not supported; it names the keys that are.
    """
    inside = space.spaces if isinstance(space, spaces.Dict) else {}
    if missing := [key for key in keys if key not in inside]:
        wanted = f"expected some of: {', '.join(inside)}" if inside else "which only a Dict has: leave it out"
        raise ValueError(
            f"observation_keys has {missing[0]!r}, {wanted}. The observation space is {space!r}."
        )
    if keys:
        return spaces.Dict({key: part for key, part in inside.items() if key in (*keys, MASK_KEY)})
    try:
        list(walk(space, "observation"))
    except ValueError as error:
        good = [key for key, part in inside.items() if supported(part)]
        hint = f" Or use only what can be read: --observation-keys {' '.join(good)}" if good else ""
        raise ValueError(f"{error}{hint}") from None
    return space


def supported(space: Space) -> bool:
    """Whether every basic space inside is one that has an encoding."""
    try:
        return bool(list(walk(space, "given")))
    except ValueError:
        return False


def place_of(path: Path) -> str:
    """``[a][0]`` for an error message."""
    return "".join(f"[{key!r}]" for key in path)


def structure(space: Space) -> list[str]:
    """Each basic space inside ``space`` as text: where it lies, its type, its shape or categories.

    Bounds are left out: no network sees those of observations, and `bounds_of` gives those of actions.
    """
    found = []
    for path, part in walk(space, "given"):
        one_hot = isinstance(part, spaces.Discrete | spaces.MultiDiscrete)
        size = categories(part)[0].tolist() if one_hot else list(part.shape or ())
        found.append(f"{type(part).__name__}{place_of(path)}{size}")
    return found


def follow(value: Any, path: Path) -> Any:
    """The part of a nested value at ``path``."""
    for key in path:
        value = value[key]
    return value


def categories(space: Space) -> tuple[np.ndarray, np.ndarray]:
    """Category counts and first categories of a Discrete or MultiDiscrete, both [k]."""
    if isinstance(space, spaces.Discrete):
        return np.array([int(space.n)]), np.array([int(space.start)])
    assert isinstance(space, spaces.MultiDiscrete)
    start = getattr(space, "start", np.zeros_like(space.nvec))
    return space.nvec.ravel().astype(np.int64), np.asarray(start).ravel().astype(np.int64)


def nest(space: Space, parts: Iterator[object], skip_mask: bool = False) -> Any:
    """The parts of the leaves, in order, in the structure of the space."""
    if isinstance(space, spaces.Dict):
        return {k: nest(s, parts) for k, s in space.spaces.items() if not (skip_mask and k == MASK_KEY)}
    if isinstance(space, spaces.Tuple):
        return tuple(nest(part, parts) for part in space.spaces)
    return next(parts)


def bounds_of(space: Space) -> list[str]:
    """Low and high of every Box inside ``space`` as text, to compare two spaces."""
    boxes = [part for _, part in walk(space, "given") if isinstance(part, spaces.Box)]
    return [f"{part.low.tolist()} to {part.high.tolist()}" for part in boxes]


def useful_bounds(box: spaces.Box) -> np.ndarray:
    """Whether both bounds of each entry, flat, are finite and below BOUND_LIMIT in size: bool [n]."""
    low, high = box.low.ravel().astype(np.float64), box.high.ravel().astype(np.float64)
    return (np.abs(low) < BOUND_LIMIT) & (np.abs(high) < BOUND_LIMIT)  # False for an infinity
