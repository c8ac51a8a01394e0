"""The exam's tasks about observations: scale, offset, kind of number, boards, pictures, nested spaces.

Ten answers of which each pays at most 1, and what is shown holds the answer: 10 is best, chance 10 / kinds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from exam_worlds import Rng, Tell, add
from gymnasium import spaces

F32, F64, U8 = np.float32, np.float64, np.uint8


def tell(
    name: str,
    way: str,
    space: gym.Space,
    show: Callable[[int, Rng], Any],
    read: Any,
    kinds: int = 2,
    **more: Any,
) -> None:
    """``read`` finds the kind in what is shown."""
    length = more.pop("length", 10)
    make = lambda: Tell(space, show, kinds=kinds, length=length)  # noqa: E731
    add(name, way, make, float(length), length / kinds, read, **more)


def box(low: float, high: float, shape: tuple[int, ...] = (1,), dtype: Any = F32) -> spaces.Box:
    """A Box, shortly."""
    return spaces.Box(low, high, shape, dtype)


def sign(kind: int) -> int:
    """-1 or 1."""
    return 2 * kind - 1


def field(kind: int, rng: Rng, side: int, value: float, dtype: Any) -> np.ndarray:
    """A board with one field set, in the upper (0) or the lower half (1); an odd middle row stays empty."""
    board = np.zeros((side, side), dtype)
    board[int(rng.integers(side // 2)) + kind * (side - side // 2), int(rng.integers(side))] = value
    return board


def half(board: np.ndarray) -> int:
    """In which half of a board more is set."""
    rows = np.abs(board.astype(float)).sum(axis=1)
    return int(rows[-(len(rows) // 2) :].sum() > rows[: len(rows) // 2].sum())


def picture(kind: int, rng: Rng, side: int) -> np.ndarray:
    """A grey picture with noise and one bright square of 6 x 6 in the left (0) or the right half (1)."""
    image = rng.integers(0, 100, (side, side), U8)
    x = int(rng.integers(side // 2 - 5)) + kind * (side // 2)
    y = int(rng.integers(side - 5))
    image[y : y + 6, x : x + 6] = 255
    return image


def bright(image: np.ndarray) -> int:
    """Which half of a picture, in any order of axes, holds the square."""
    plane = image if image.ndim == 2 else image[..., 0] if image.shape[2] <= 3 else image[0]
    return int(np.argmax((plane == 255).sum(axis=0)) >= plane.shape[1] // 2)


tell(
    "seen-thousands",
    "1000..5000",
    box(1000, 5000),
    lambda k, rng: (3000 + sign(k) * rng.uniform(200, 2000, 1)).astype(F32),
    lambda seen: int(seen[0] > 3000),
)
tell(
    "seen-unix-time",
    "1.7e9 or 10 more, in float64",
    box(0, 1e12, (1,), F64),
    lambda k, rng: np.array([1.7e9 + 10 * k]),
    lambda seen: int(seen[0] > 1.7e9 + 5),
)
tell(
    "seen-micro",
    "of size 1e-6",
    box(-1, 1),
    lambda k, rng: np.full(1, 1e-6 * sign(k), F32),
    lambda seen: int(seen[0] > 0),
)
tell(
    "seen-float64",
    "float64",
    box(-1, 1, (1,), F64),
    lambda k, rng: sign(k) * rng.uniform(0.1, 1, 1),
    lambda seen: int(seen[0] > 0),
)
tell(
    "seen-int32",
    "whole numbers",
    box(-1000, 1000, (1,), np.int32),
    lambda k, rng: (sign(k) * rng.integers(1, 1000, 1)).astype(np.int32),
    lambda seen: int(seen[0] > 0),
)
tell(
    "seen-bool",
    "bool",
    box(0, 1, (4,), np.bool_),
    lambda k, rng: np.array([k, 1 - k, k, rng.random() < 0.5], np.bool_),
    lambda seen: int(seen[0]),
)
tell(
    "seen-two-scales",
    "noise of size 1e6 beside 0.01",
    box(-1e7, 1e7, (2,)),
    lambda k, rng: np.array([1e6 * rng.standard_normal(), 0.01 * sign(k)], F32),
    lambda seen: int(seen[1] > 0),
)
tell(
    "seen-heavy-tails",
    "no bounds, and noise without a variance",
    box(-np.inf, np.inf, (2,)),
    lambda k, rng: np.array([rng.standard_cauchy(), sign(k)], F32),
    lambda seen: int(seen[1] > 0),
)
tell(
    "seen-constants",
    "nine constant numbers of size 1e4 beside one",
    box(-1e5, 1e5, (10,)),
    lambda k, rng: np.array([1e4] * 9 + [sign(k)], F32),
    lambda seen: int(seen[9] > 0),
)
tell(
    "board-uint8",
    "8 x 8 of {0, 1}, uint8",
    box(0, 1, (8, 8), U8),
    lambda k, rng: field(k, rng, 8, 1, U8),
    half,
)
tell(
    "board-float32",
    "8 x 8 of {0, 1}, float32",
    box(0, 1, (8, 8)),
    lambda k, rng: field(k, rng, 8, 1, F32),
    half,
)
tell(
    "board-int8",
    "5 x 5 of {-1, 0, 1}, int8",
    box(-1, 1, (5, 5), np.int8),
    lambda k, rng: field(k, rng, 5, rng.choice([-1, 1]), np.int8),
    half,
)
tell(
    "image-5x5",
    "5 x 5 of {0, 255}, uint8",
    box(0, 255, (5, 5), U8),
    lambda k, rng: field(k, rng, 5, 255, U8),
    half,
)
tell(
    "image-8x8x1",
    "8 x 8 x 1 of {0, 255}, uint8",
    box(0, 255, (8, 8, 1), U8),
    lambda k, rng: field(k, rng, 8, 255, U8)[..., None],
    lambda seen: half(seen[..., 0]),
)
tell(
    "image-36-last",
    "36 x 36 x 3",
    box(0, 255, (36, 36, 3), U8),
    lambda k, rng: np.repeat(picture(k, rng, 36)[..., None], 3, 2),
    bright,
)
tell(
    "image-36-first",
    "3 x 36 x 36",
    box(0, 255, (3, 36, 36), U8),
    lambda k, rng: np.repeat(picture(k, rng, 36)[None], 3, 0),
    bright,
)
tell(
    "discrete",
    "Discrete observations",
    spaces.Discrete(16),
    lambda k, rng: np.int64(4 * rng.integers(4) + k),
    lambda seen: int(seen) % 4,
    kinds=4,
)
tell(
    "discrete-start",
    "Discrete observations from 5",
    spaces.Discrete(16, start=5),
    lambda k, rng: np.int64(5 + 4 * rng.integers(4) + k),
    lambda seen: (int(seen) - 5) % 4,
    kinds=4,
)
tell(
    "multidiscrete",
    "MultiDiscrete observations",
    spaces.MultiDiscrete([3, 5]),
    lambda k, rng: np.array([k, rng.integers(5)], np.int64),
    lambda seen: int(seen[0]),
    kinds=3,
)
tell(
    "multibinary",
    "MultiBinary observations",
    spaces.MultiBinary(6),
    lambda k, rng: np.r_[rng.integers(2, size=4), k // 2, k % 2].astype(np.int8),
    lambda seen: int(2 * seen[4] + seen[5]),
    kinds=4,
)
tell(
    "dict",
    "a Dict of two Boxes",
    spaces.Dict({"a": box(-1, 1), "b": box(0, 100, (2,))}),
    lambda k, rng: {"a": np.full(1, sign(k % 2), F32), "b": np.array([100 * (k // 2), 50], F32)},
    lambda seen: int(seen["a"][0] > 0) + 2 * int(seen["b"][0] > 50),
    kinds=4,
)
tell(
    "tuple",
    "a Tuple of Discrete and Box",
    spaces.Tuple((spaces.Discrete(2), box(-1, 1))),
    lambda k, rng: (np.int64(k % 2), np.full(1, sign(k // 2), F32)),
    lambda seen: int(seen[0]) + 2 * int(seen[1][0] > 0),
    kinds=4,
)
tell(
    "nested",
    "a Dict inside a Dict, with a Tuple",
    spaces.Dict(
        {
            "in": spaces.Dict({"x": box(-1, 1)}),
            "pair": spaces.Tuple((spaces.Discrete(2), spaces.MultiBinary(2))),
        }
    ),
    lambda k, rng: {
        "in": {"x": np.full(1, sign(k % 2), F32)},
        "pair": (np.int64(k // 2), rng.integers(2, size=2).astype(np.int8)),
    },
    lambda seen: int(seen["in"]["x"][0] > 0) + 2 * int(seen["pair"][0]),
    kinds=4,
)
tell(
    "dict-image",
    "a picture beside a number",
    spaces.Dict({"eye": box(0, 255, (36, 36, 1), U8), "x": box(-1, 1)}),
    lambda k, rng: {"eye": picture(k % 2, rng, 36)[..., None], "x": np.full(1, sign(k // 2), F32)},
    lambda seen: bright(seen["eye"]) + 2 * int(seen["x"][0] > 0),
    kinds=4,
)
