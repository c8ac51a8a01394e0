"""From Gymnasium's spaces to matrices and back.

Observations become ``inputs``: "flat" [N, D] float32 and one uint8 array per image. Actions are one float32
matrix [N, A]. Both follow the order in which Gymnasium flattens a nested space. Worker processes import this
file, so it needs numpy only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from gymnasium import Space, spaces

Path = tuple[str | int, ...]
Array = np.ndarray
Inputs = dict[str, Array]
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
            f"the {what} space{place_of(path)} is {space!r}; supported are {SUPPORTED}. "
            "Wrap the environment so that it offers one of these."
        )


def place_of(path: Path) -> str:
    """``[a][0]`` for an error message."""
    return "".join(f"[{key!r}]" for key in path)


def structure(space: Space) -> list[str]:
    """Each basic space inside ``space`` as text: where it lies, its type, its shape or categories.

    Bounds are left out: a policy may move to a task that has others.
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


def nest(space: Space, parts: Iterator[Any], skip_mask: bool = False) -> Any:
    """The parts of the leaves, in order, in the structure of the space."""
    if isinstance(space, spaces.Dict):
        return {k: nest(s, parts) for k, s in space.spaces.items() if not (skip_mask and k == MASK_KEY)}
    if isinstance(space, spaces.Tuple):
        return tuple(nest(part, parts) for part in space.spaces)
    return next(parts)


# ----------------------------------------------------------------------------------------------- observations


def is_image(space: Space) -> bool:
    """True for a uint8 Box of rank 2 or 3 whose two spatial sides are at least 8 (channels first or last)."""
    if not isinstance(space, spaces.Box) or space.dtype != np.uint8 or len(space.shape) not in (2, 3):
        return False
    return min(spatial_sides(space.shape)) >= 8


def spatial_sides(shape: tuple[int, ...]) -> tuple[int, int]:
    """Height and width of an image. Of three axes the smaller outer one holds the channels (a tie: last)."""
    if len(shape) == 2:
        return shape[0], shape[1]
    return (shape[0], shape[1]) if shape[2] <= shape[0] else (shape[1], shape[2])


@dataclass(frozen=True, eq=False)
class Leaf:
    """One basic space of an observation: where it lies in the structure and in the inputs."""

    path: Path
    space: Space
    kind: Literal["box", "bits", "one_hot", "image"]
    name: str  # the input it is written to
    columns: slice  # of "flat"; empty for images
    counts: np.ndarray  # one_hot only: categories per entry, and the first category of each
    starts: np.ndarray

    def write(self, values: np.ndarray, inputs: Inputs) -> None:
        """Put batched ``values`` [N, *shape] into ``inputs``; ValueError when they do not fit the space."""
        shape = self.space.shape or ()
        if values.shape[1:] != shape:
            raise ValueError(
                f"observation{place_of(self.path)} has shape {values.shape[1:]}, the space says {shape}: "
                f"{self.space!r}"
            )
        target = inputs[self.name]
        if self.kind == "image":
            target[...] = values
        elif self.kind == "one_hot":
            self._write_one_hot(values, target[:, self.columns])
        else:
            target[:, self.columns] = values.reshape(len(values), -1)

    def _write_one_hot(self, values: np.ndarray, target: np.ndarray) -> None:
        indices = values.reshape(len(values), -1).astype(np.int64) - self.starts
        if (indices < 0).any() or (indices >= self.counts).any():
            raise ValueError(
                f"observation{place_of(self.path)} is {values.tolist()}, outside its space {self.space!r}"
            )
        target[...] = 0.0
        first = np.cumsum(self.counts) - self.counts
        np.put_along_axis(target, indices + first, 1.0, axis=1)


@dataclass(frozen=True, eq=False)
class ObservationLayout:
    """How the observations of one space become inputs. Made by ``observation_layout``."""

    space: Space
    leaves: tuple[Leaf, ...]
    size: int  # D, the columns of "flat"; 0 when there are only images
    continuous: np.ndarray  # bool [D]: columns that come from a Box, which a normaliser may touch
    image_shapes: tuple[tuple[int, ...], ...]
    one_hot: tuple[slice, ...]  # columns of each one-hot group
    has_mask: bool  # the Dict carries the action mask under "action_mask"; it is no input
    plain: bool  # one Box of rank 1: "flat" is the observation itself

    def allocate(self, num: int, zeros: Callable[..., np.ndarray] = np.zeros) -> Inputs:
        """Empty inputs for ``num`` observations; ``zeros(shape, dtype)`` makes the arrays."""
        inputs = {"flat": zeros((num, self.size), np.float32)} if self.size else {}
        for index, shape in enumerate(self.image_shapes):
            inputs[f"image{index}"] = zeros((num, *shape), np.uint8)
        return inputs

    def encode(self, observations: Any, batched: bool) -> Inputs:
        """Inputs of one observation (N = 1) or of a batch in the form of Gymnasium's vector environments.

        A batch of plain float32 rows is returned as it is, without a copy. ValueError: a shape or category
        outside the space.
        """
        if self.plain and batched:
            rows = np.asarray(observations, np.float32)
            if rows.ndim != 2 or rows.shape[1] != self.size:
                raise ValueError(
                    f"observations have shape {rows.shape}, expected (N, {self.size}): {self.space!r}"
                )
            return {"flat": rows}
        if not batched:
            inputs = self.allocate(1)
            self.write(observations, inputs)
            return inputs
        values = [self._value(observations, leaf) for leaf in self.leaves]
        inputs = self.allocate(len(values[0]))
        for leaf, value in zip(self.leaves, values, strict=True):
            leaf.write(value, inputs)
        return inputs

    def write(self, observation: Any, inputs: Inputs) -> None:
        """Put one unbatched observation into the only row of ``inputs``; ValueError when it does not fit."""
        for leaf in self.leaves:
            leaf.write(self._value(observation, leaf)[None], inputs)

    def _value(self, observations: Any, leaf: Leaf) -> np.ndarray:
        try:
            value = np.asarray(follow(observations, leaf.path))
        except (KeyError, IndexError, TypeError) as error:
            raise ValueError(
                f"the observation has nothing at {place_of(leaf.path)}; it is a "
                f"{type(observations).__name__}, the space is {self.space!r}"
            ) from error
        if value.dtype.kind not in "biuf":
            raise ValueError(
                f"observation{place_of(leaf.path)} is {value!r}, not an array of numbers; the space is "
                f"{leaf.space!r}"
            )
        return value

    def mask_of(self, observations: Any) -> Any:
        """The action mask inside a Dict observation, None when the space carries none."""
        return observations[MASK_KEY] if self.has_mask else None

    def unflatten(self, inputs: dict[str, Any]) -> Any:
        """The structure of the space with float torch tensors, for a user's module; leading axes are kept.

        Boxes get their shape back, Discrete and MultiDiscrete stay one-hot [.., sum n], images hold 0 to
        255. A plain Box of rank 1 gives the tensor itself; an action mask is left out.
        """
        parts = []
        for leaf in self.leaves:
            if leaf.kind == "image":
                parts.append(inputs[leaf.name].float())
                continue
            columns = inputs["flat"] if self.plain else inputs["flat"][..., leaf.columns]
            shape = columns.shape[:-1] + (columns.shape[-1:] if leaf.kind == "one_hot" else leaf.space.shape)
            parts.append(columns.reshape(shape))
        return nest(self.space, iter(parts), skip_mask=self.has_mask)


def observation_layout(space: Space) -> ObservationLayout:
    """The layout of an observation space; ValueError names a space that is not supported."""
    mask_space = space.spaces.get(MASK_KEY) if isinstance(space, spaces.Dict) else None
    has_mask = isinstance(mask_space, spaces.Box | spaces.MultiBinary)
    leaves: list[Leaf] = []
    continuous: list[bool] = []
    image_shapes: list[tuple[int, ...]] = []
    for path, part in walk(space, "observation"):
        if has_mask and path == (MASK_KEY,):
            continue
        counts = starts = np.zeros(0, np.int64)
        offset, name, width = len(continuous), "flat", math.prod(part.shape or ())
        kind: Literal["box", "bits", "one_hot", "image"] = "box"
        if isinstance(part, spaces.Discrete | spaces.MultiDiscrete):
            kind, (counts, starts) = "one_hot", categories(part)
            width = int(counts.sum())
        elif isinstance(part, spaces.MultiBinary):
            kind = "bits"
        elif is_image(part):
            kind, name, width = "image", f"image{len(image_shapes)}", 0
            image_shapes.append(tuple(part.shape or ()))
        leaves.append(Leaf(path, part, kind, name, slice(offset, offset + width), counts, starts))
        continuous += [kind == "box"] * width
    if not continuous and not image_shapes:
        raise ValueError(
            f"the observation space {space!r} holds no numbers; expected at least one to learn from."
        )
    return ObservationLayout(
        space=space,
        leaves=tuple(leaves),
        size=len(continuous),
        continuous=np.array(continuous, bool),
        image_shapes=tuple(image_shapes),
        one_hot=tuple(
            slice(int(leaf.columns.start + last - count), int(leaf.columns.start + last))
            for leaf in leaves
            for last, count in zip(np.cumsum(leaf.counts), leaf.counts, strict=True)
        ),
        has_mask=has_mask,
        plain=len(leaves) == 1
        and leaves[0].path == ()
        and leaves[0].kind == "box"
        and len(space.shape or ()) == 1,
    )


# ---------------------------------------------------------------------------------------------------- actions


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


@dataclass(frozen=True, eq=False)
class ActionLeaf:
    """One basic space of an action and its columns; for a Box also its flat bounds."""

    path: Path
    space: Space
    columns: slice
    low: np.ndarray
    high: np.ndarray

    def to_env(self, actions: np.ndarray) -> np.ndarray:
        """Columns of the matrix to [N, *shape] in the space's dtype, start added, clipped to bounds."""
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
    gaussian: Array  # bool [A]: columns that are Gaussian dimensions

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
                    f"squash needs finite bounds; the action space{place_of(leaf.path)} is {leaf.space!r}. "
                    "Switch squash off or give the space bounds."
                )

    def to_env(self, actions: np.ndarray, squash: bool = False) -> Any:
        """The action matrix [N, A] as batched actions, as Gymnasium's vector environments take them.

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
            return as_allowed(array).reshape(num, self.num_logits)
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


def action_layout(space: Space) -> ActionLayout:
    """The layout of an action space; ValueError names a space that is not supported."""
    leaves: list[ActionLeaf] = []
    components: list[Component] = []
    parameter = column = logit = deviation = 0
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
            width = 1 if kind == "categorical" else count
            mask = -1 if kind == "gaussian" else logit
            components.append(Component(kind, parameter, count, column, width, mask, deviation))
            parameter, column = parameter + count, column + width
            if kind == "gaussian":
                deviation += count
            else:
                logit += count
        leaves.append(ActionLeaf(path, part, slice(first, column), low, high))
    if not components:
        raise ValueError(
            f"the action space {space!r} holds no choice; expected at least one action to choose."
        )
    gaussian = np.concatenate([np.full(c.width, c.kind == "gaussian") for c in components])
    return ActionLayout(space, tuple(leaves), tuple(components), parameter, column, logit, gaussian)
