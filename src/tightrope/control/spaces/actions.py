"""Action spaces: one float32 matrix [N, A] inside, each space's own structure and dtype outside."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from gymnasium import Space, spaces

from tightrope.control.spaces.nested import Path, categories, follow, nest, walk, where


@dataclass(frozen=True)
class Component:
    """One independent part of an action: its distribution and its places in parameters, columns and mask."""

    kind: Literal["categorical", "bernoulli", "gaussian"]
    parameter: int  # first of its parameters among the actor's P outputs
    count: int  # categories, bits, or dimensions
    column: int  # first of its columns in the action matrix
    mask: int  # first of its entries in the flat mask; -1 for gaussian

    @property
    def width(self) -> int:
        """How many columns of the action matrix it has: one index, or one a bit or dimension."""
        return 1 if self.kind == "categorical" else self.count


@dataclass(frozen=True, eq=False)
class ActionLeaf:
    """One basic space of an action and its columns; for a Box also its flat bounds."""

    path: Path
    space: Space
    columns: slice
    low: np.ndarray
    high: np.ndarray

    def to_env(self, actions: np.ndarray) -> np.ndarray:
        """Columns of the action matrix -> [N, *shape] in the space's dtype, start added, clipped to the
        bounds.
        """
        space, shape = self.space, (len(actions), *(self.space.shape or ()))
        if isinstance(space, spaces.Box):
            values = np.minimum(np.maximum(actions[:, self.columns], self.low), self.high)
            if space.dtype.kind in "iu":
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

    def squashed(self, actions: np.ndarray) -> np.ndarray:
        """Box columns u become low + (tanh(u) + 1) / 2 * (high - low); the others stay. A copy, [N, A]."""
        actions = actions.copy()
        for leaf in self.leaves:
            if isinstance(leaf.space, spaces.Box):
                share = 0.5 * (np.tanh(actions[:, leaf.columns]) + 1.0)
                actions[:, leaf.columns] = leaf.low + share * (leaf.high - leaf.low)
        return actions

    def check_squash(self) -> None:
        """ValueError when a Box has an infinite bound, onto which tanh cannot be stretched."""
        for leaf in self.leaves:
            if not (np.isfinite(leaf.low).all() and np.isfinite(leaf.high).all()):
                raise ValueError(
                    f"squash needs finite bounds; the action space{where(leaf.path)} is {leaf.space!r}. "
                    "Switch squash off or give the space bounds."
                )

    def to_env(self, actions: np.ndarray, squash: bool = False) -> Any:
        """The action matrix [N, A] as batched actions of the space, as Gymnasium's vector environments take
        them.

        Categories get the space's start, Box values are clipped to the bounds (or squashed onto them), an
        integer Box is rounded.
        """
        if squash:
            actions = self.squashed(actions)
        if len(self.leaves) == 1 and self.leaves[0].path == ():
            return self.leaves[0].to_env(actions)
        return nest(self.space, (leaf.to_env(actions) for leaf in self.leaves))

    def to_env_single(self, actions: np.ndarray, squash: bool = False) -> Any:
        """One row of the action matrix, [A], as an action of a plain environment."""
        rows = np.asarray(actions, np.float32)[None]
        return next(self.rows(rows, squash))

    def rows(self, actions: np.ndarray, squash: bool = False) -> Iterator[Any]:
        """The action matrix [N, A] as N actions of a plain environment."""
        if squash:
            actions = self.squashed(actions)
        values = [leaf.to_env(actions) for leaf in self.leaves]
        if len(values) == 1 and self.leaves[0].path == ():
            return iter(values[0])
        return (nest(self.space, iter(row)) for row in zip(*values, strict=True))

    def flatten_mask(self, mask: Any, num: int) -> np.ndarray | None:
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

    def _flat_mask(self, mask: Any, num: int) -> np.ndarray | None:
        """The mask when it is flat or one per row, None when it must be nested."""
        try:
            array = np.asarray(mask)
        except ValueError:  # ragged
            return None
        if array.dtype == object:
            per_row = array.ndim == 1 and len(array) == num and num > 1
            return np.concatenate([self.flatten_mask(row, 1) for row in array]) if per_row else None
        if array.shape == (num, self.num_logits) or (num == 1 and array.shape == (self.num_logits,)):
            return array.reshape(num, self.num_logits).astype(bool)
        return None

    def _write_mask(self, part: Any, components: list[Component], target: np.ndarray, whole: Any) -> None:
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
            columns[...] = np.asarray(piece).reshape(columns.shape).astype(bool)

    def _mask_error(self, mask: Any, num: int) -> ValueError:
        shape = f"a {type(mask).__name__}" if isinstance(mask, dict | tuple) else f"shape {np.shape(mask)}"
        return ValueError(
            f"the action mask is {shape}; expected ({num}, {self.num_logits}), one entry per choice of "
            f"{self.space!r}, or the space's own structure."
        )

    def blocked_rows(self, mask: np.ndarray) -> np.ndarray:
        """Rows of a flat mask in which some categorical part has no allowed choice; bits may all be
        forbidden.
        """
        open_rows = np.ones(len(mask), bool)
        for part in self.components:
            if part.kind == "categorical":
                open_rows &= mask[:, part.mask : part.mask + part.count].any(axis=1)
        return np.flatnonzero(~open_rows)


def action_layout(space: Space) -> ActionLayout:
    """The layout of an action space; ValueError names a space that is not supported."""
    leaves: list[ActionLeaf] = []
    components: list[Component] = []
    parameter = column = logit = 0
    for path, part in walk(space, "action"):
        low = high = np.zeros(0, np.float32)
        kind: Literal["categorical", "bernoulli", "gaussian"] = "categorical"
        first, counts = column, []
        if isinstance(part, spaces.Box):
            work = np.float32 if part.dtype in (np.float32, np.float16) else np.float64
            low, high = part.low.ravel().astype(work), part.high.ravel().astype(work)
            kind, counts = "gaussian", [math.prod(part.shape)]
        elif isinstance(part, spaces.MultiBinary):
            kind, counts = "bernoulli", [math.prod(part.shape)]
        else:
            counts = [int(n) for n in categories(part)[0]]
        for count in counts:
            if count == 0:
                continue
            components.append(Component(kind, parameter, count, column, -1 if kind == "gaussian" else logit))
            parameter, logit = parameter + count, logit + (count if kind != "gaussian" else 0)
            column += 1 if kind == "categorical" else count
        leaves.append(ActionLeaf(path, part, slice(first, column), low, high))
    if not components:
        raise ValueError(
            f"the action space {space!r} holds no choice; expected at least one action to choose."
        )
    return ActionLayout(space, tuple(leaves), tuple(components), parameter, column, logit)
