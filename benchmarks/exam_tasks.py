"""All tasks of the exam: bounds, actions, rewards and ends of episodes here, observations in exam_seen.py.

``best`` is the mean return of the best policy; why it is, a comment says, and ``hand`` is a policy of the
observation alone that reaches it. ``random`` is that of actions drawn evenly from the space (allowed ones,
where there is a mask): exact, or where it says so measured over 20,000 episodes.
"""

from __future__ import annotations

from math import exp
from typing import Any

import exam_worlds as worlds
import gymnasium as gym
import numpy as np
from exam_seen import box, sign, tell
from exam_worlds import TASKS, Line, Pay, Rng, Target, Task, Tell, TwoGoals, add
from gymnasium import spaces

__all__ = ["TASKS", "Task"]
F32, F64 = np.float32, np.float64


# ------------------------------------------------------------------------------------------ bounds of actions
# A cost is never negative, so 0 is best. Drawn evenly from a range, the distance to a point at the share p of
# it is (p^2 + (1 - p)^2) / 2 of the range on average: 0.3125 for p = 0.75, 0.5 for p = 1, 1/3 for an even p.


def target(
    name: str, way: str, low: Any, high: Any, share: float = 0.75, *, random: float | None = None
) -> None:
    """A constant best action at ``share`` of each range, ten steps."""
    lows, highs = np.atleast_1d(np.asarray(low, F32)), np.atleast_1d(np.asarray(high, F32))
    width = np.where(highs > lows, highs - lows, 1.0)
    best = lows + share * (highs - lows)
    mean = (share**2 + (1 - share) ** 2) / 2
    add(
        name,
        way,
        lambda: Target(spaces.Box(lows, highs, dtype=F32), best, width),
        0.0,
        -10 * mean if random is None else random,
        lambda seen: best.astype(F32),
    )


target("bounds-unit", "none: the usual bounds", -1, 1)
target("bounds-100-200", "bounds far from 0", 100, 200)
target("bounds-thousand", "wide bounds", -1000, 1000)
target("bounds-hundredth", "narrow bounds", -0.01, 0.01)
target("bounds-asymmetric", "asymmetric bounds", -0.1, 3.0)
target("bounds-edge", "the best action is the upper bound", -2, 2, 1.0)
target("bounds-mixed", "each dimension has its own bounds", [-1, 0, -0.001], [1, 1000, 0.001])
# of two dimensions one costs nothing: half of 0.3125
target("bounds-constant", "one dimension has low == high", [-1, 5], [1, 5], random=-10 * 0.3125 / 2)
# gymnasium draws a normal number: E|z - 3| = 2 phi(3) + 3 (2 Phi(3) - 1) = 3.00076
add(
    "bounds-unbounded",
    "no bounds; the best action is 3",
    lambda: Target(spaces.Box(-np.inf, np.inf, (1,), F32), [3.0], 1.0),
    0.0,
    -30.0076,
    lambda seen: np.full(1, 3, F32),
)
# gymnasium draws an exponential number: E|e - 3| = 3 - 1 + 2 exp(-3)
add(
    "bounds-half",
    "a lower bound only; the best action is 3",
    lambda: Target(spaces.Box(0, np.inf, (1,), F32), [3.0], 1.0),
    0.0,
    -10 * (2 + 2 * exp(-3)),
    lambda seen: np.full(1, 3, F32),
)
add(
    "bounds-512-follow",
    "0..512 in two dimensions; the best action is the observation",
    lambda: Target(spaces.Box(0, 512, (2,), F32), [0, 0], 512.0, follow=True),
    0.0,
    -10 / 3,
    lambda seen: seen,
)
# mean |k - 7| over 0..10 is 34 / 11
add(
    "bounds-int32",
    "a Box of whole numbers",
    lambda: Target(spaces.Box(0, 10, (1,), np.int32), [7], 10.0),
    0.0,
    -34 / 11,
    lambda seen: np.full(1, 7, np.int32),
)
add(
    "bounds-float64",
    "a Box in float64",
    lambda: Target(spaces.Box(-5, 5, (1,), F64), [2.5], 10.0),
    0.0,
    -3.125,
    lambda seen: np.full(1, 2.5),
)
# the middle is reached by the shortest way: after t steps the distance is max(0, d - t / 10), which no policy
# beats at any step; d is even in 0..1, so the mean is the sum over t = 1..9 of (1 - t / 10)^2 / 2 = 1.425.
add(
    "slide",
    "none: continuous control over 20 steps",
    worlds.Slide,
    -1.425,
    -10.05,  # measured
    lambda seen: np.clip(-10 * seen, -1, 1).astype(F32),
)

# --------------------------------------------------------------------------------------------------- actions
# A score is at most 1 a step; a part of an answer that is drawn evenly of n is right one time in n.


def echo(name: str, way: str, space: gym.Space, bits: int, score: Any, random: float, hand: Any, **more: Any):
    """Ten steps."""
    add(name, way, lambda: worlds.Echo(space, bits, score), 10.0, 10 * random, hand, **more)


echo(
    "actions-multidiscrete",
    "MultiDiscrete actions",
    spaces.MultiDiscrete([2, 3, 4]),
    3,
    lambda bits, a: float(np.mean(np.asarray(a) == bits * [1, 2, 3])),
    (1 / 2 + 1 / 3 + 1 / 4) / 3,
    lambda seen: (seen * [1, 2, 3]).astype(np.int64),
)
echo(
    "actions-multibinary",
    "MultiBinary actions",
    spaces.MultiBinary(5),
    5,
    lambda bits, a: float(np.mean(np.asarray(a) == bits)),
    0.5,
    lambda seen: seen.astype(np.int8),
)
echo(
    "actions-start",
    "Discrete actions from 5",
    spaces.Discrete(4, start=5),
    2,
    lambda bits, a: float(int(a) == 5 + 2 * bits[0] + bits[1]),
    1 / 4,
    lambda seen: np.int64(5 + 2 * seen[0] + seen[1]),
)
echo(
    "actions-fifty",
    "fifty actions of which one is right",
    spaces.Discrete(50),
    2,
    lambda bits, a: float(int(a) == 13 * (2 * bits[0] + bits[1]) + 3),
    1 / 50,
    lambda seen: np.int64(13 * (2 * seen[0] + seen[1]) + 3),
)
echo(
    "actions-tuple",
    "a Tuple of two Discrete",
    spaces.Tuple((spaces.Discrete(2), spaces.Discrete(3))),
    2,
    lambda bits, a: float(np.mean([a[0] == bits[0], a[1] == 2 * bits[1]])),
    (1 / 2 + 1 / 3) / 2,
    lambda seen: (np.int64(seen[0]), np.int64(2 * seen[1])),
)
# gear: 1/2. Speed 75 or 25 of 0..100, 1 less the distance: 1 - 0.3125.
echo(
    "actions-dict",
    "a Dict of a choice and a number in 0..100",
    spaces.Dict({"gear": spaces.Discrete(2), "speed": box(0, 100)}),
    2,
    lambda bits, a: (
        ((int(a["gear"]) == bits[0]) + 1 - abs(float(a["speed"][0]) - 25 - 50 * bits[1]) / 100) / 2
    ),
    (1 / 2 + 1 - 0.3125) / 2,
    lambda seen: {"gear": np.int64(seen[0]), "speed": np.full(1, 25 + 50 * seen[1], F32)},
)
# of two allowed actions one pays 1
add(
    "mask-info",
    "masks in the info; a forbidden action costs 1,000",
    lambda: worlds.MaskedInfo(1000.0),
    10.0,
    5.0,
    lambda seen: int(np.argmax(seen)),
)
add(
    "mask-method",
    "masks by a method; a forbidden action ends the episode",
    lambda: worlds.MaskedMethod(0.0),
    10.0,
    5.0,
    lambda seen: int(np.argmax(seen)),
)

# --------------------------------------------------------------------------------------------------- rewards
# What a right answer pays times ten answers; the noise has mean 0.


def rewarded(name: str, way: str, right: float, wrong: float, noise: float = 0.0, **more: Any):
    """Two kinds, ten steps, as bounds of the reward say."""

    def reward(good: bool, rng: Rng) -> float:
        return (right if good else wrong) + noise * rng.standard_normal()

    make = lambda: Tell(  # noqa: E731
        NUMBER, lambda k, rng: np.full(1, sign(k), F32), reward=reward
    )
    add(name, way, make, 10 * right, 5 * (right + wrong), lambda seen: int(seen[0] > 0), **more)


NUMBER = box(-1, 1)
rewarded("reward-unit", "none: the usual rewards", 1.0, 0.0)
rewarded("reward-micro", "rewards of 1e-6", 1e-6, 0.0)
rewarded("reward-mega", "rewards of 1e6", 1e6, 0.0)
rewarded("reward-shift-up", "100 is added to each reward", 101.0, 100.0)
rewarded("reward-shift-down", "1,000 is taken from each reward", -999.0, -1000.0)
rewarded("reward-noisy", "rewards with noise of deviation 3", 1.0, 0.0, 3.0)


# action 1 pays 1 on average, action 0 pays 0.5 surely, five times
def rare(time: int, action: int, rng: Rng) -> float:
    """10 one time in ten, or 0.5 surely; both draw, so that the luck of an episode is the same."""
    luck = 10.0 * (rng.random() < 0.1)
    return luck if action else 0.5


add("reward-rare", "10 one time in ten, or 0.5 surely", lambda: Pay(2, 5, rare), 5.0, 3.75, lambda seen: 1)
# Random: the share of an even walk that has arrived after 30 steps, by its Markov chain.
add(
    "reward-sparse",
    "1 at the end of a line of 10, 30 steps",
    lambda: Line(10, 0, 30),
    1.0,
    0.16949,
    lambda seen: 1,
)
add("reward-two-goals-30", "1 or 2 at the end of 30 steps", lambda: TwoGoals(30), 2.0, 1.5, lambda seen: 1)
add("reward-two-goals-300", "1 or 2 at the end of 300 steps", lambda: TwoGoals(300), 2.0, 1.5, lambda seen: 1)
# right: nine steps; left: two and the pit, 22. Random, as the gambler's ruin: 2 x 9 steps, the pit 9 times
# in 11.
add(
    "reward-costs",
    "each step costs 1, and a pit that costs 20 is near",
    lambda: Line(12, 2, 200, left=-20.0, right=0.0, each=-1.0),
    -9.0,
    -18 - 20 * 9 / 11,
    lambda seen: 1,
)
# steps 800..999 pay 1 for action 1
add(
    "clock-1000",
    "1,000 steps by a clock of its own, paid in the last 200",
    lambda: Pay(2, 1000, lambda t, a, rng: float(a == 1 and t >= 800)),
    200.0,
    100.0,
    lambda seen: 1,
)
add(
    "clock-2000",
    "2,000 steps by a clock of its own, every step pays",
    lambda: Pay(2, 2000, lambda t, a, rng: float(a == 1)),
    2000.0,
    1000.0,
    lambda seen: 1,
)
# the answers of the last five steps are never paid
add(
    "delay-5",
    "what an action pays comes five steps later",
    lambda: worlds.Late(5, 30),
    25.0,
    12.5,
    lambda seen: int(seen[0] > 0),
)

# ---------------------------------------------------------------------------------------------- episode ends
add(
    "one-step-bandit",
    "one step, ten arms that pay 0 to 0.9",
    lambda: Pay(10, 1, lambda t, a, rng: a / 10),
    0.9,
    0.45,
    lambda seen: 9,
)
tell(
    "one-step-contextual",
    "one step, four contexts",
    box(0, 1, (4,)),
    lambda k, rng: np.eye(4, dtype=F32)[k],
    lambda seen: int(np.argmax(seen)),
    kinds=4,
    length=1,
)
add(
    "one-step-box",
    "one step, a Box action",
    lambda: Target(box(-1, 1), [0.5], 2.0, length=1),
    0.0,
    -0.3125,
    lambda seen: np.full(1, 0.5, F32),
)
# the shortest way is nine steps; an even walk from a wall needs 2 + 4 + ... + 18 = 90 on average
add(
    "no-time-limit",
    "no time limit: a line of 10, each step costs 0.01",
    lambda: Line(10, 0, np.inf, each=-0.01),
    1 - 0.09,
    1 - 0.9,
    lambda seen: 1,
)
# Nothing tells the time, so a deterministic policy stays always (20) or leaves at once (15). A critic that
# takes the time limit for an end finds staying worth about ten. Random: 15, and 1 for the steps stayed.
add(
    "truncation",
    "staying pays 1 a step up to a time limit of 20, leaving 15",
    lambda: gym.wrappers.TimeLimit(worlds.StayOrLeave(), 20),
    20.0,
    16.0,
    lambda seen: 0,
)


def configured() -> gym.Env:
    """A task made by gymnasium.make, then changed by its user."""
    env = gym.make("ExamChosen-v0")
    env.unwrapped.good = 1  # type: ignore[attr-defined]
    return env


assert worlds.Chosen.good == 0
add(
    "configured",
    "an instance that was changed after gymnasium.make",
    configured,
    10.0,
    5.0,
    lambda seen: 1,
    instance=True,
)
