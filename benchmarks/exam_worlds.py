"""The small worlds that the exam's tasks are made of, and the list of tasks that exam_tasks.py fills.

Nothing but numpy and gymnasium, for both contenders. Each best return follows from the rules.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

Rng = np.random.Generator
NOTHING = spaces.Box(-1, 1, (1,), np.float32)
STEPS = 100_000


@dataclass(frozen=True)
class Task:
    """One question of the exam."""

    name: str
    way: str  # in what it differs
    make: Callable[[], gym.Env]
    best: float
    random: float
    hand: Callable[[Any], Any]
    steps: int = STEPS  # 100k, or what stable-baselines3's defaults need, if that is more
    instance: bool = False  # the contender gets the object itself, not what makes it


TASKS: dict[str, Task] = {}


def add(
    name: str, way: str, make: Callable[[], gym.Env], best: float, random: float, hand: Any, **more: Any
) -> None:
    """Put a task on the list."""
    assert name not in TASKS
    TASKS[name] = Task(name, way, make, best, random, hand, **more)


class World(gym.Env):
    """An episode of ``length`` steps; a subclass says what is seen and what an action brings."""

    metadata = {"render_modes": []}  # noqa: RUF012
    length = 10

    def __init__(self, observation_space: gym.Space, action_space: gym.Space) -> None:
        self.observation_space, self.action_space = observation_space, action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        self.time = 0
        self.begin()
        return self.see(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Act, then look."""
        reward, terminated = self.act(action)
        self.time += 1
        return self.see(), float(reward), bool(terminated or self.time >= self.length), False, {}

    def begin(self) -> None:
        """Put the world into its first state."""

    def see(self) -> Any:
        """The observation of the present state."""
        return np.zeros(1, np.float32)

    def act(self, action: Any) -> tuple[float, bool]:
        """Change the state: reward, and whether the episode terminated."""
        raise NotImplementedError


class Target(World):
    """Box actions: a step costs the distance to the best action, in units of ``width``, mean of dimensions.

    The best action is the same always, or with ``follow`` it is what the observation says.
    """

    def __init__(self, box: spaces.Box, best: Any, width: Any, *, follow: bool = False, length: int = 10):
        super().__init__(spaces.Box(box.low, box.high, dtype=np.float32) if follow else NOTHING, box)
        self.best, self.width = np.asarray(best, float), np.asarray(width, float)
        self.follow, self.length = follow, length

    def _new(self) -> None:
        if self.follow:
            low, high = self.observation_space.low, self.observation_space.high
            self.best = self.np_random.uniform(low, high).astype(np.float32)

    def begin(self) -> None:
        self._new()

    def see(self) -> Any:
        return self.best.copy() if self.follow else np.zeros(1, np.float32)

    def act(self, action: Any) -> tuple[float, bool]:
        cost = np.mean(np.abs(np.asarray(action, float) - self.best) / self.width)
        self._new()
        return -cost, False


class Tell(World):
    """One of ``kinds`` is drawn at every step and shown in some form; the action that names it pays 1.

    ``show(kind, rng)`` gives the observation.  ``reward(right, rng)``: what a right or wrong answer pays.
    """

    def __init__(
        self,
        observation_space: gym.Space,
        show: Callable[[int, Rng], Any],
        *,
        kinds: int = 2,
        length: int = 10,
        reward: Callable[[bool, Rng], float] = lambda right, rng: float(right),
        start: int = 0,
    ) -> None:
        super().__init__(observation_space, spaces.Discrete(kinds, start=start))
        self.kinds, self.show, self.length, self.reward, self.start = kinds, show, length, reward, start

    def _new(self) -> None:
        self.kind = int(self.np_random.integers(self.kinds))
        self.shown = self.show(self.kind, self.np_random)

    def begin(self) -> None:
        self._new()

    def see(self) -> Any:
        return self.shown

    def act(self, action: Any) -> tuple[float, bool]:
        right = int(action) == self.kind + self.start
        reward = self.reward(right, self.np_random)
        self._new()
        return reward, False


class Echo(World):
    """Bits are shown; ``score(bits, action)`` in 0..1 says how well the action of any space answers them."""

    def __init__(self, action_space: gym.Space, bits: int, score: Callable[[np.ndarray, Any], float]) -> None:
        super().__init__(spaces.Box(0, 1, (bits,), np.float32), action_space)
        self.score = score

    def begin(self) -> None:
        self.bits = self.np_random.integers(2, size=self.observation_space.shape).astype(np.float32)

    def see(self) -> Any:
        return self.bits.copy()

    def act(self, action: Any) -> tuple[float, bool]:
        reward = self.score(self.bits, action)
        self.begin()
        return reward, False


class Pay(World):
    """``pay(time, action, rng)`` is the reward; what is seen is the share of the episode that is over."""

    def __init__(self, choices: int, length: int, pay: Callable[[int, int, Rng], float]) -> None:
        super().__init__(NOTHING, spaces.Discrete(choices))
        self.length, self.pay = length, pay

    def see(self) -> Any:
        return np.array([self.time / self.length], np.float32)

    def act(self, action: Any) -> tuple[float, bool]:
        return self.pay(self.time, int(action), self.np_random), False


class TwoGoals(World):
    """The first action chooses a corridor; at its end lies 1 (action 0) or 2 (action 1)."""

    def __init__(self, length: int) -> None:
        super().__init__(spaces.Box(-1, 1, (2,), np.float32), spaces.Discrete(2))
        self.length = length

    def begin(self) -> None:
        self.side = 0

    def see(self) -> Any:
        return np.array([self.time / self.length, self.side], np.float32)

    def act(self, action: Any) -> tuple[float, bool]:
        if self.time == 0:
            self.side = 1 if int(action) else -1
        last = self.time == self.length - 1
        return (1.5 + 0.5 * self.side) * last, False


class Line(World):
    """Places 0..n-1 on a line: action 0 goes left, 1 goes right. What ends stands at either end.

    ``left`` and ``right``: what reaching that end pays, None for a wall.  ``each``: what every step pays.
    """

    def __init__(
        self,
        places: int,
        start: int,
        length: float,
        *,
        left: float | None = None,
        right: float = 1.0,
        each: float = 0.0,
    ) -> None:
        super().__init__(NOTHING, spaces.Discrete(2))
        self.places, self.start, self.length = places, start, length  # type: ignore[assignment]
        self.left, self.right, self.each = left, right, each

    def begin(self) -> None:
        self.place = self.start

    def see(self) -> Any:
        return np.array([2 * self.place / (self.places - 1) - 1], np.float32)

    def act(self, action: Any) -> tuple[float, bool]:
        self.place = max(0, self.place + (1 if int(action) else -1))
        if self.place == self.places - 1:
            return self.each + self.right, True
        if self.place == 0 and self.left is not None:
            return self.each + self.left, True
        return self.each, False


class Late(World):
    """A bit is shown at every step; the answer is paid ``delay`` steps after it was given."""

    def __init__(self, delay: int, length: int) -> None:
        super().__init__(NOTHING, spaces.Discrete(2))
        self.delay, self.length = delay, length

    def begin(self) -> None:
        self.bit, self.owed = int(self.np_random.integers(2)), [0.0] * self.delay

    def see(self) -> Any:
        return np.array([2 * self.bit - 1], np.float32)

    def act(self, action: Any) -> tuple[float, bool]:
        self.owed.append(float(int(action) == self.bit))
        self.bit = int(self.np_random.integers(2))
        return self.owed.pop(0), False


class StayOrLeave(World):
    """Action 0 stays and pays 1, action 1 leaves, pays 15 and terminates. A TimeLimit stands outside."""

    length = float("inf")  # type: ignore[assignment]

    def __init__(self) -> None:
        super().__init__(NOTHING, spaces.Discrete(2))

    def act(self, action: Any) -> tuple[float, bool]:
        return (15.0, True) if int(action) else (1.0, False)


class Slide(World):
    """A place in -1..1 moves by a tenth of the action at most; each step costs the distance to the middle."""

    length = 20

    def __init__(self) -> None:
        super().__init__(NOTHING, spaces.Box(-1, 1, (1,), np.float32))

    def begin(self) -> None:
        self.place = float(self.np_random.uniform(-1, 1))

    def see(self) -> Any:
        return np.array([self.place], np.float32)

    def act(self, action: Any) -> tuple[float, bool]:
        self.place = float(np.clip(self.place + 0.1 * float(np.asarray(action).reshape(-1)[0]), -1, 1))
        return -abs(self.place), False


class Masked(World):
    """Of eight actions two are allowed, and the lower one of these pays 1; the mask is all there is to see.

    A forbidden action costs ``fine`` and terminates the episode.
    """

    def __init__(self, fine: float) -> None:
        super().__init__(spaces.MultiBinary(8), spaces.Discrete(8))
        self.fine = fine

    def begin(self) -> None:
        self.mask = np.zeros(8, np.int8)
        self.mask[self.np_random.choice(8, 2, replace=False)] = 1

    def see(self) -> Any:
        return self.mask.copy()

    def act(self, action: Any) -> tuple[float, bool]:
        allowed, lower = bool(self.mask[int(action)]), int(action) == int(np.argmax(self.mask))
        self.begin()
        return (float(lower), False) if allowed else (-self.fine, True)


class MaskedInfo(Masked):
    """The mask comes in ``info["action_mask"]``."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        observation, _ = super().reset(seed=seed)
        return observation, {"action_mask": self.mask.copy()}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        *rest, _ = super().step(action)
        return (*rest, {"action_mask": self.mask.copy()})  # type: ignore[return-value]


class MaskedMethod(Masked):
    """The mask comes by the method ``action_masks``."""

    def action_masks(self) -> np.ndarray:
        """True where an action is allowed."""
        return self.mask.astype(bool)


class Chosen(World):
    """Pays for the action that its attribute names; whoever makes the task sets it."""

    good = 0

    def __init__(self) -> None:
        super().__init__(NOTHING, spaces.Discrete(2))

    def act(self, action: Any) -> tuple[float, bool]:
        return float(int(action) == self.good), False


gym.register("ExamChosen-v0", entry_point=Chosen)
