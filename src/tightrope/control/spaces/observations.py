"""From observations of any space to matrices.

Observations become ``inputs``: "flat" [N, D] float64, from which a normaliser can subtract before anything is
rounded to the networks' float32, and one array per image. The order is Gymnasium's when it flattens.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from gymnasium import Space, spaces

from tightrope.control.spaces.structure import (
    MASK_KEY,
    Inputs,
    Path,
    categories,
    follow,
    nest,
    place_of,
    selected,
    structure,
    useful_bounds,
    walk,
)

BYTES = (np.uint8, np.bool_)  # what an image keeps as bytes
MOST_COLUMNS = 2**24  # of flat inputs: their first layer of 64 units alone takes 17 GB with Adam's moments
SMALLEST_IMAGE = 5  # what the convolutions for small images need


def is_image(space: Space, encoder: str) -> bool:
    """Whether convolutions read a space (channels first or last); otherwise its numbers are flat inputs.

    Only a Box of rank 2 or 3 whose bounds are useful (see `useful_bounds`) can be an image. ``auto``: bytes
    of 0..255 with both sides at least 16, or anything with both sides at least 36: a smaller board is learnt
    better flat and normalised. ``cnn``: from 5 x 5 on. ``mlp``: nothing. ``old``: uint8 from 8 x 8 on.
    """
    if encoder == "mlp" or not isinstance(space, spaces.Box) or len(space.shape) not in (2, 3):
        return False
    side, of_bytes = min(spatial_sides(space.shape)), space.dtype == np.uint8
    if encoder == "old":
        return of_bytes and side >= 8
    if side < SMALLEST_IMAGE or not useful_bounds(space).all():
        return False
    full = of_bytes and bool((space.low == 0).all() and (space.high == 255).all())
    return encoder == "cnn" or (full and side >= 16) or side >= 36


def spatial_sides(shape: tuple[int, ...]) -> tuple[int, int]:
    """Height and width of an image. Of three axes the smaller outer one holds the channels (a tie: last)."""
    return (shape[0], shape[1]) if len(shape) == 2 or channels_last(shape) else (shape[1], shape[2])


def channels_last(shape: tuple[int, ...]) -> bool:
    """Whether an image of three axes has its channels in the last one."""
    return len(shape) == 3 and shape[2] <= shape[0]


@dataclass(frozen=True, eq=False)
class Leaf:
    """One basic space of an observation: where it lies in the structure and in the inputs.

    An image is kept in its own units: bytes stay bytes, which are small; other numbers become float32.
    """

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
        # flat inputs keep any number; bytes, bits and categories would silently become other ones
        whole = (
            target.dtype if self.kind == "image" else np.dtype(np.int8 if self.kind == "bits" else np.int64)
        )
        if self.kind != "box" and whole.kind in "iu" and not np.can_cast(values.dtype, whole, "safe"):
            values = self._exact(values, whole)
        if self.kind == "image":
            target[...] = values
        elif self.kind == "one_hot":
            self._write_one_hot(values, target[:, self.columns])
        else:
            target[:, self.columns] = values.reshape(len(values), -1)

    def _exact(self, values: np.ndarray, dtype: np.dtype) -> np.ndarray:
        """``values`` as whole numbers of ``dtype``; ValueError for one that it cannot hold."""
        with np.errstate(invalid="ignore"):  # NaN and infinity are among those
            held = values.astype(dtype)
        wrong = values[held != values]
        if wrong.size:
            raise ValueError(
                f"observation{place_of(self.path)} holds {wrong[0]!s} as {values.dtype}, which its space "
                f"{self.space!r} of {self.space.dtype} cannot hold: return such numbers, or declare the "
                "space of what is returned."
            )
        return held

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
    images: tuple[Leaf, ...]  # those of kind "image"
    one_hot: tuple[slice, ...]  # columns of each one-hot group
    has_mask: bool  # the Dict carries the action mask under "action_mask"; it is no input
    plain: bool  # one Box of rank 1: "flat" is the observation itself
    keys: tuple[str, ...] = ()  # of a Dict, those that are used; empty: all
    encoder: str = "auto"  # what is an image

    def fits(self, space: Space) -> bool:
        """Whether a space, of which only ``keys`` count, has the same parts, the same of them images; their
        bounds may differ.
        """
        other = selected(space, self.keys)
        same = structure(self.space) == structure(other)
        return same and self.pictures() == self.pictures(other)

    def pictures(self, space: Space | None = None) -> list[str]:
        """Each image among the parts of a space (default: this one), read as here: where it lies, its shape,
        and whether it is kept as bytes.
        """
        return [
            f"{'bytes' if part.dtype in BYTES else 'numbers'}{place_of(path)}{list(part.shape or ())}"
            for path, part in walk(self.space if space is None else space, "given")
            if is_image(part, self.encoder) and path != (MASK_KEY,)
        ]

    def allocate(self, num: int, zeros: Callable[..., np.ndarray] = np.zeros) -> Inputs:
        """Empty inputs for ``num`` observations; ``zeros(shape, dtype)`` makes the arrays."""
        inputs = {"flat": zeros((num, self.size), np.float64)} if self.size else {}
        for leaf in self.images:
            of_bytes = leaf.space.dtype in BYTES
            shape = (num, *(leaf.space.shape or ()))
            inputs[leaf.name] = zeros(shape, np.uint8 if of_bytes else np.float32)
        return inputs

    def is_batched(self, observation: Any) -> bool:
        """Whether an observation has one axis more than its space. ValueError where it is none of it."""
        leaf, part = self.leaves[0], observation
        try:
            for key in leaf.path:
                part = part[key]
            return np.ndim(part) > len(leaf.space.shape or ())
        except (LookupError, TypeError, ValueError) as error:  # no such key, no dict, rows of several lengths
            raise ValueError(
                f"The observation is {repr(observation)[:80]}; expected one of {self.space}, or a batch of "
                "them."
            ) from error

    def encode(self, observations: object, batched: bool) -> Inputs:
        """Inputs of one observation (N = 1) or of a batch in the form of Gymnasium's vector environments.

        A batch of plain float64 rows is returned as it is, without a copy. ValueError: a shape or category
        outside the space.
        """
        if self.plain and batched:
            rows = np.asarray(observations, np.float64)
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

    def write(self, observation: object, inputs: Inputs) -> None:
        """Put one unbatched observation into the only row of ``inputs``; ValueError when it does not fit."""
        for leaf in self.leaves:
            leaf.write(self._value(observation, leaf)[None], inputs)

    def _value(self, observations: object, leaf: Leaf) -> np.ndarray:
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

        Boxes get their shape back, Discrete and MultiDiscrete stay one-hot [.., sum n], images keep the
        space's units. A plain Box of rank 1 gives the tensor itself; an action mask is left out.
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


def _has_mask(space: Space) -> bool:
    """Whether a Dict carries an action mask; ValueError for a part of that name that can be none."""
    part = space.spaces.get(MASK_KEY) if isinstance(space, spaces.Dict) else None
    if part is None:
        return False
    if isinstance(part, spaces.Discrete | spaces.MultiDiscrete):
        counts, starts = categories(part)
        good = bool((counts == 2).all() and (starts == 0).all())
    else:
        good = isinstance(part, spaces.Box | spaces.MultiBinary)
    if not good:
        raise ValueError(
            f"observation[{MASK_KEY!r}] has the space {part!r}; an action mask holds 0 or 1 a choice: "
            "expected a Box, a MultiBinary, or a MultiDiscrete of 2s. If it is no mask, give it another name."
        )
    return True


def observation_layout(space: Space, encoder: str = "auto", keys: tuple[str, ...] = ()) -> ObservationLayout:
    """The layout of an observation space; ``encoder``: what is an image (see `is_image`). ``keys``: of a
    Dict, those that are used (empty: all).

    ValueError names a space that is not supported, a key that is not there, or in which ``cnn`` finds no
    image.
    """
    space = selected(space, keys)
    has_mask = _has_mask(space)
    leaves: list[Leaf] = []
    continuous: list[bool] = []
    images: list[Leaf] = []
    for path, part in walk(space, "observation"):
        if has_mask and path == (MASK_KEY,):
            continue
        counts = starts = np.zeros(0, np.int64)
        offset, name, width = len(continuous), "flat", math.prod(part.shape or ())
        kind: Literal["box", "bits", "one_hot", "image"] = "box"
        if isinstance(part, spaces.Discrete | spaces.MultiDiscrete):
            kind, (counts, starts) = "one_hot", categories(part)
            width = sum(counts.tolist())  # Python's integers: an int64 may overflow
        elif isinstance(part, spaces.MultiBinary):
            kind = "bits"
        elif is_image(part, encoder):
            kind, name, width = "image", f"image{len(images)}", 0
        if offset + width > MOST_COLUMNS:
            raise ValueError(
                f"observation{place_of(path)} of the space {part!r} becomes {width:,} inputs, which no "
                f"memory holds; expected at most {MOST_COLUMNS:,} in all. A Discrete is one input a "
                "category: declare large numbers as a Box."
            )
        leaves.append(Leaf(path, part, kind, name, slice(offset, offset + width), counts, starts))
        images += leaves[-1:] if kind == "image" else []
        continuous += [kind == "box"] * width
    if encoder == "cnn" and not images:
        raise ValueError(
            f"encoder is 'cnn', and nothing in the observation space {space!r} is an image: a Box of rank 2 "
            f"or 3, both sides at least {SMALLEST_IMAGE}, its bounds finite. Choose auto or mlp."
        )
    if not continuous and not images:
        raise ValueError(
            f"the observation space {space!r} holds no numbers; expected at least one to learn from."
        )
    return ObservationLayout(
        space=space,
        leaves=tuple(leaves),
        size=len(continuous),
        continuous=np.array(continuous, bool),
        images=tuple(images),
        one_hot=tuple(
            slice(int(leaf.columns.start + last - count), int(leaf.columns.start + last))
            for leaf in leaves
            for last, count in zip(np.cumsum(leaf.counts), leaf.counts, strict=True)
        ),
        has_mask=has_mask,
        keys=keys,
        encoder=encoder,
        plain=len(leaves) == 1
        and leaves[0].path == ()
        and leaves[0].kind == "box"
        and len(space.shape or ()) == 1,
    )
