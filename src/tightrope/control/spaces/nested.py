"""Walking through Gymnasium's nested spaces, in the order in which Gymnasium flattens them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import Space, spaces

Path = tuple[str | int, ...]
MASK_KEY = "action_mask"
SUPPORTED = "Box, Discrete, MultiDiscrete, MultiBinary, and Tuple or Dict of these"


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
            f"the {what} space{where(path)} is {space!r}; supported are {SUPPORTED}. "
            "Wrap the environment so that it offers one of these."
        )


def where(path: Path) -> str:
    """``[a][0]`` for an error message."""
    return "".join(f"[{key!r}]" for key in path)


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


def nest(space: Space, parts: Iterator[Any], skip_mask: bool = False) -> Any:
    """The parts of the leaves, in order, in the structure of the space."""
    if isinstance(space, spaces.Dict):
        return {k: nest(s, parts) for k, s in space.spaces.items() if not (skip_mask and k == MASK_KEY)}
    if isinstance(space, spaces.Tuple):
        return tuple(nest(part, parts) for part in space.spaces)
    return next(parts)
