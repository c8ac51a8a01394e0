"""From rows of numbers to actions of any space, and action masks to rows of flags.

The policy's actions are one float32 matrix [N, A], in Gymnasium's flatten order. This file is the only place
where they become the environment's.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from gymnasium import Space, spaces

from tightrope.control.spaces.structure import (
    BOUND_LIMIT,
    Component,
    Path,
    bounds_of,
    categories,
    follow,
    nest,
    place_of,
    structure,
    useful_bounds,
    walk,
)


@dataclass(frozen=True, eq=False)
class ActionLeaf:
    """One basic space of an action and its columns; for a Box also its flat bounds, and how to reach them."""

    path: Path
    space: Space
    columns: slice
    low: np.ndarray
    high: np.ndarray
    mapped: np.ndarray  # bool [n]: dimensions that are stretched from [-1, 1] onto their bounds
    tanh: bool = False  # squashed instead

    @cached_property
    def _stretch(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Middle and half width of each dimension; None where all are 0 and 1, which change no bit."""
        low, high = np.where(self.mapped, (self.low, self.high), ((-1,), (1,))).astype(self.low.dtype)
        middle, half = (low + high) / 2, (high - low) / 2
        return (middle, half) if middle.any() or (half != 1).any() else None

    def to_env(self, actions: np.ndarray) -> np.ndarray:
        """Columns of the matrix to [N, *shape] in the space's dtype, start added, within the bounds."""
        space, shape = self.space, (len(actions), *(self.space.shape or ()))
        if isinstance(space, spaces.Box):
            values = actions[:, self.columns]
            if self.tanh:
                values = self.low + 0.5 * (np.tanh(values) + 1.0) * (self.high - self.low)
            elif self._stretch is not None:
                middle, half = self._stretch
                values = middle + half * values
            values = np.minimum(np.maximum(values, self.low), self.high)
            if space.dtype.kind in "iub":
                values = np.rint(values)
            return values.astype(space.dtype, copy=False).reshape(shape)
        if isinstance(space, spaces.Discrete):
            indices = actions[:, self.columns.start].astype(space.dtype)
            return indices + space.dtype.type(space.start) if space.start else indices
        values = actions[:, self.columns].astype(space.dtype)
        if isinstance(space, spaces.MultiDiscrete):
            values += categories(space)[1].astype(space.dtype)
        return values.reshape(shape)


@dataclass(frozen=True, eq=False)
class ActionLayout:
    """How the actions of one space lie in parameters, columns and masks. Made by ``action_layout``."""

    space: Space
    leaves: tuple[ActionLeaf, ...]
    components: tuple[Component, ...]
    num_parameters: int  # P
    num_columns: int  # A
    num_logits: int  # L, the width of the flat mask
    gaussian: np.ndarray  # bool [A]: columns that are Gaussian dimensions
    maps: bool  # whether Box dimensions are to be mapped onto their bounds

    def to_env(self, actions: np.ndarray) -> Any:
        """The action matrix [N, A] as batched actions, as Gymnasium's vector environments take them.

        Categories get the space's start. With x a number of a Box dimension: x in [-1, 1] is stretched onto
        the bounds (map), or x is taken as it is (clip), and what lies outside is cut off; or low +
        (tanh(x) + 1) / 2 * (high - low) (squash). A Box of whole numbers is rounded after that.
        """
        if len(self.leaves) == 1 and self.leaves[0].path == ():
            return self.leaves[0].to_env(actions)
        return nest(self.space, (leaf.to_env(actions) for leaf in self.leaves))

    def to_env_single(self, actions: np.ndarray) -> Any:
        """One row of the action matrix, [A], as an action of a plain environment."""
        return next(self.rows(np.asarray(actions, np.float32)[None]))

    def rows(self, actions: np.ndarray) -> Iterator[Any]:
        """The action matrix [N, A] as N actions of a plain environment."""
        values = [leaf.to_env(actions) for leaf in self.leaves]
        if len(values) == 1 and self.leaves[0].path == ():
            return iter(values[0])
        return (nest(self.space, iter(row)) for row in zip(*values, strict=True))

    def fits(self, space: Space) -> bool:
        """Whether a space has the same parts and bounds."""
        same = structure(self.space) == structure(space)
        return same and bounds_of(self.space) == bounds_of(space)

    def clipped_share(self, actions: np.ndarray) -> float | None:
        """The share of the numbers for bounded Box dimensions in [N, A] that lie outside what reaches the
        bounds, and so are cut off; None where nothing can be. A constant dimension does not count.
        """
        cut = total = 0
        for leaf in self.leaves:
            if isinstance(leaf.space, spaces.Box) and not leaf.tanh:
                counted = (leaf.high > leaf.low) & (np.isfinite(leaf.low) | np.isfinite(leaf.high))
                low, high = np.where(leaf.mapped, -1, leaf.low), np.where(leaf.mapped, 1, leaf.high)
                x = actions[:, leaf.columns]
                cut += int((((x < low) | (x > high)) & counted).sum())
                total += len(x) * int(counted.sum())
        return cut / total if total else None

    def not_mapped(self) -> list[str]:
        """A line about the dimensions that were to be mapped and have no useful bounds; none without any."""
        boxes = [leaf for leaf in self.leaves if isinstance(leaf.space, spaces.Box)]
        missing = [leaf for leaf in boxes if not leaf.mapped.all()]
        if not self.maps or not missing:
            return []
        count = sum(int((~leaf.mapped).sum()) for leaf in missing)
        names = ", ".join(f"{place_of(leaf.path) or ''} {leaf.space!r}".strip() for leaf in missing)
        return [
            f"{count} of {sum(leaf.mapped.size for leaf in boxes)} Box action dimensions have no two finite "
            f"bounds below {BOUND_LIMIT:g} in size and cannot be mapped: the policy's numbers, of size 1 at "
            f"first, are given as they are, clipped to the bounds ({names}). If the task needs larger ones, "
            "give the space its real bounds."
        ]

    def flatten_mask(self, mask: object, num: int) -> np.ndarray | None:
        """What environments give as masks -> bool [num, L], True = allowed. None stays None.

        Flat arrays [num, L] (with one row also [L]), one mask per row, or nested like the space (a part that
        is None allows everything). ValueError: another shape.
        """
        if mask is None or not self.num_logits:
            return None
        if not isinstance(mask, dict):
            rows = self._flat_mask(mask, num)
            if rows is not None:
                return rows
        flat = np.ones((num, self.num_logits), bool)
        components = iter([c for c in self.components if c.kind != "gaussian"])
        for leaf in self.leaves:
            if isinstance(leaf.space, spaces.Box):
                continue
            entries = len(categories(leaf.space)[0]) if isinstance(leaf.space, spaces.MultiDiscrete) else 1
            parts = [next(components) for _ in range(entries)]
            try:
                part_mask = follow(mask, leaf.path)
            except (KeyError, IndexError, TypeError):
                raise self._mask_error(mask, num) from None
            start, stop = parts[0].mask, parts[-1].mask + parts[-1].count
            self._write_mask(part_mask, parts, flat[:, start:stop], mask)
        return flat

    def allowed(self, mask: object, num: int) -> np.ndarray | None:
        """`flatten_mask`; ValueError also for a row that allows no choice."""
        flat = self.flatten_mask(mask, num)
        if flat is not None and len(blocked := self.blocked_rows(flat)):
            raise ValueError(f"action_masks forbid every choice in row {blocked[0]}; allow at least one.")
        return flat

    def _flat_mask(self, mask: object, num: int) -> np.ndarray | None:
        """The mask when it is flat or one per row, None when it must be nested."""
        try:
            array = np.asarray(mask)
        except ValueError:  # ragged
            return None
        if array.dtype == object:
            per_row = array.ndim == 1 and len(array) == num and num > 1
            return np.concatenate([self.flatten_mask(row, 1) for row in array]) if per_row else None
        if array.shape == (num, self.num_logits) or (num == 1 and array.shape == (self.num_logits,)):
            return as_allowed(array).reshape(num, self.num_logits)
        return None

    def _write_mask(self, part: Any, components: list[Component], target: np.ndarray, whole: object) -> None:
        if part is None:
            return
        pieces = list(part) if len(components) > 1 else [part]
        if len(components) > 1 and not isinstance(part, tuple | list) and np.size(part) == target.size:
            pieces = np.split(
                np.reshape(part, target.shape), np.cumsum([c.count for c in components])[:-1], axis=1
            )
        if len(pieces) != len(components):
            raise self._mask_error(whole, len(target))
        first = components[0].mask
        for component, piece in zip(components, pieces, strict=True):
            columns = target[:, component.mask - first : component.mask - first + component.count]
            if piece is None:
                continue
            if np.size(piece) != columns.size:
                raise self._mask_error(whole, len(target))
            columns[...] = as_allowed(np.asarray(piece)).reshape(columns.shape)

    def _mask_error(self, mask: Any, num: int) -> ValueError:
        shape = f"a {type(mask).__name__}" if isinstance(mask, dict | tuple) else f"shape {np.shape(mask)}"
        return ValueError(
            f"the action mask is {shape}; expected ({num}, {self.num_logits}), one entry per choice of "
            f"{self.space!r}, or the space's own structure."
        )

    def blocked_rows(self, mask: np.ndarray) -> np.ndarray:
        """Rows of a flat mask in which a categorical part allows no choice; bits may all be forbidden."""
        open_rows = np.ones(len(mask), bool)
        for part in self.components:
            if part.kind == "categorical":
                open_rows &= mask[:, part.mask : part.mask + part.count].any(axis=1)
        return np.flatnonzero(~open_rows)


def as_allowed(mask: np.ndarray) -> np.ndarray:
    """A mask of True and False, or 1 and 0, as bool. ValueError for other numbers: -inf is not False."""
    if mask.dtype.kind == "b":
        return mask
    wrong = (mask != 0) & (mask != 1)
    if wrong.any():
        raise ValueError(
            f"the action mask holds {mask[wrong].flat[0]}; expected True (1) where a choice is allowed and "
            "False (0) where it is not."
        )
    return mask.astype(bool)


def action_layout(space: Space, bounds: str = "map") -> ActionLayout:
    """The layout of an action space; ``bounds``: how a Box reaches its bounds, map, clip or squash.

    ValueError names a space that is not supported, or an infinite bound, onto which nothing is squashed.
    """
    leaves: list[ActionLeaf] = []
    components: list[Component] = []
    parameter = column = logit = deviation = 0
    for path, part in walk(space, "action"):
        low, high, mapped = np.zeros(0, np.float32), np.zeros(0, np.float32), np.zeros(0, bool)
        kind: Literal["categorical", "bernoulli", "gaussian"] = "categorical"
        first, counts = column, []
        if isinstance(part, spaces.Box):
            work = np.float32 if part.dtype in (np.float32, np.float16) else np.float64
            low, high = part.low.ravel().astype(work), part.high.ravel().astype(work)
            mapped = useful_bounds(part) & (bounds == "map")
            if bounds == "squash":
                _require_finite(path, part, low, high)
            kind, counts = "gaussian", [math.prod(part.shape)]
        elif isinstance(part, spaces.MultiBinary):
            kind, counts = "bernoulli", [math.prod(part.shape)]
        else:
            counts = [int(n) for n in categories(part)[0]]
        for count in counts:
            if count == 0:
                continue
            width = 1 if kind == "categorical" else count
            mask = -1 if kind == "gaussian" else logit
            components.append(Component(kind, parameter, count, column, width, mask, deviation))
            parameter, column = parameter + count, column + width
            if kind == "gaussian":
                deviation += count
            else:
                logit += count
        leaves.append(ActionLeaf(path, part, slice(first, column), low, high, mapped, bounds == "squash"))
    if not components:
        raise ValueError(
            f"the action space {space!r} holds no choice; expected at least one action to choose."
        )
    gaussian = np.concatenate([np.full(c.width, c.kind == "gaussian") for c in components])
    numbers = (parameter, column, logit)
    return ActionLayout(space, tuple(leaves), tuple(components), *numbers, gaussian, bounds == "map")


def _require_finite(path: Path, box: spaces.Box, low: np.ndarray, high: np.ndarray) -> None:
    with np.errstate(over="ignore"):
        finite = np.isfinite(high - low).all()
    if not finite:
        raise ValueError(
            f"action_bounds squash needs finite bounds; the action space{place_of(path)} is {box!r}. Choose "
            "map or clip, or give the space bounds."
        )
