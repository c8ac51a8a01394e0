"""A tiny deterministic task for tests of the environment side: the observation is (row, episode, step).

Episode k of row r follows ``SCRIPT[(k + r) % len(SCRIPT)]``: its length and how it ends. Nothing is random;
the row is taken from the seed, so that every way to vectorise the task must deliver the same transitions.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

SCRIPT = (
    (3, "terminated"),
    (2, "truncated"),
    (1, "terminated"),
    (4, "truncated"),
    (1, "truncated"),
    (3, "both"),
)
BASE_SEED = 100
OBSERVATIONS = gym.spaces.Box(-1e6, 1e6, (3,), np.float32)
ACTIONS = gym.spaces.Discrete(3, start=5)


def reward_of(row: int, episode: int, step: int, action: int) -> float:
    """Every transition has its own reward, exact in float32."""
    return row * 64.0 + episode * 8.0 + step + action / 16.0


class Chain(gym.Env):
    """One copy. ``mask`` is how it forbids action (episode + step) % 3: "none", "info", "method" or
    "observation".
    """

    observation_space: gym.Space = OBSERVATIONS
    action_space = ACTIONS

    def __init__(self, mask: str = "none") -> None:
        self.mask = mask
        self.row, self.episode, self.time = 0, -1, 0
        self.closed = False
        if mask == "method":
            self.action_masks = self.allowed
        if mask == "observation":
            parts = {"action_mask": gym.spaces.MultiBinary(3), "state": OBSERVATIONS}
            self.observation_space = gym.spaces.Dict(parts)

    def allowed(self) -> np.ndarray:
        """All but one action."""
        return np.arange(3) != (self.episode + self.time) % 3

    def _answer(self) -> tuple[Any, dict[str, Any]]:
        state = np.array([self.row, self.episode, self.time], np.float32)
        if self.mask == "observation":
            return {"state": state, "action_mask": self.allowed().astype(np.int8)}, {}
        return state, {"action_mask": self.allowed().astype(np.int8)} if self.mask == "info" else {}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.row, self.episode = seed - BASE_SEED, -1
        self.episode += 1
        self.time = 0
        return self._answer()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), f"{action!r} is no action of {self.action_space}"
        length, end = SCRIPT[(self.episode + self.row) % len(SCRIPT)]
        assert self.time < length, "stepped past the end of an episode"
        reward = reward_of(self.row, self.episode, self.time, int(action))
        self.time += 1
        over = self.time == length
        observation, info = self._answer()
        return observation, reward, over and end != "truncated", over and end != "terminated", info

    def close(self) -> None:
        self.closed = True


class ChainVector(gym.vector.VectorEnv):
    """All copies in one object, as a task's own vector version: any mode, float32 rewards, arrays used again.

    SAME_STEP gives a dense ``final_obs`` without a mask, as Atari's does. ``faulty_mask``: reset ignores the
    mask.
    """

    def __init__(
        self,
        num_envs: int = 2,
        autoreset_mode: Any = AutoresetMode.NEXT_STEP,
        faulty_mask: bool = False,
        max_episode_steps: int | None = None,
    ) -> None:
        self.num_envs = num_envs
        self.mode = autoreset_mode
        self.metadata = {"autoreset_mode": autoreset_mode}
        self.single_observation_space, self.single_action_space = OBSERVATIONS, ACTIONS
        self.observation_space = gym.vector.utils.batch_space(OBSERVATIONS, num_envs)
        self.action_space = gym.vector.utils.batch_space(ACTIONS, num_envs)
        self.envs = [Chain() for _ in range(num_envs)]
        self.ended = np.zeros(num_envs, bool)
        self.observations = np.zeros((num_envs, 3), np.float32)
        self.faulty_mask = faulty_mask
        self.closings = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        mask = np.ones(self.num_envs, bool)
        if options and "reset_mask" in options and not self.faulty_mask:
            mask = options["reset_mask"]
        for i in np.flatnonzero(mask):
            self.observations[i], _ = self.envs[i].reset(seed=None if seed is None else seed + int(i))
        self.ended[mask] = False
        return self.observations, {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        rewards = np.zeros(self.num_envs, np.float32)
        terminated, truncated = np.zeros((2, self.num_envs), bool)
        infos: dict[str, Any] = {}
        finals = self.observations.copy()
        for i, env in enumerate(self.envs):
            if self.mode == AutoresetMode.NEXT_STEP and self.ended[i]:
                self.observations[i], _ = env.reset()
                rewards[i] = 77.0  # the content of a phantom row must not be used
                continue
            self.observations[i], rewards[i], terminated[i], truncated[i], _ = env.step(actions[i])
            finals[i] = self.observations[i]
            if self.mode == AutoresetMode.SAME_STEP and (terminated[i] or truncated[i]):
                self.observations[i], _ = env.reset()
                infos["final_obs"] = finals
        self.ended = terminated | truncated
        return self.observations, rewards, terminated, truncated, infos

    def close(self, **_: Any) -> None:
        self.closings += 1


def register() -> None:
    """Put the task into the registry, once: with and without a vector version, and with a wrapper-made
    time limit.
    """
    if "tightrope_tests/Chain-v0" in gym.registry:
        return
    gym.register("tightrope_tests/Chain-v0", entry_point=Chain)
    gym.register("tightrope_tests/VectorChain-v0", entry_point=Chain, vector_entry_point=ChainVector)
    gym.register("tightrope_tests/NextStepChain-v0", entry_point=Chain, vector_entry_point=NextStepChain)
    gym.register("tightrope_tests/LimitedChain-v0", entry_point=Chain, max_episode_steps=2)


class NextStepChain(ChainVector):
    """A vector version without ``autoreset_mode``, like CartPole's."""

    def __init__(self, num_envs: int = 2) -> None:
        super().__init__(num_envs)


def action_for(flat: np.ndarray) -> np.ndarray:
    """The scripted action of every row, [N, 1] float32 from 0: depends only on (episode, step).

    It is never the one that a masked chain forbids.
    """
    return ((flat[:, -2:].sum(axis=1, keepdims=True) + 1 + flat[:, -3:-2] % 2) % 3).astype(np.float32)


def transitions(environments: Any, count: int, seed: int = BASE_SEED) -> list[list[tuple[Any, ...]]]:
    """The first ``count`` transitions of each row, in order: observation, action, reward, flags, true
    next one.
    """
    inputs, _ = environments.reset(seed)
    rows: list[list[tuple[Any, ...]]] = [[] for _ in range(environments.num_envs)]
    while min(len(row) for row in rows) < count:
        actions = action_for(inputs["flat"])
        step = environments.step(actions)
        finals = (
            {}
            if step.final_rows is None
            else dict(zip(step.final_rows, step.final_inputs["flat"], strict=True))
        )
        for i, row in enumerate(rows):
            if step.phantom is not None and step.phantom[i]:
                assert step.rewards[i] == 0 and not step.terminated[i] and not step.truncated[i]
                continue
            after = None if step.terminated[i] else tuple(finals.get(i, step.inputs["flat"][i]).tolist())
            before = tuple(inputs["flat"][i].tolist())
            flags = bool(step.terminated[i]), bool(step.truncated[i])
            row.append((before, float(actions[i, 0]), float(step.rewards[i]), *flags, after))
        inputs = step.inputs
    return [row[:count] for row in rows]


def expected_transitions(num_envs: int, count: int) -> list[list[tuple[Any, ...]]]:
    """The same, computed from the script without an environment."""
    rows = []
    for row in range(num_envs):
        found: list[tuple[Any, ...]] = []
        episode = 0
        while len(found) < count:
            length, end = SCRIPT[(episode + row) % len(SCRIPT)]
            for time in range(length):
                before = (float(row), float(episode), float(time))
                action = float(action_for(np.array([before], np.float32))[0, 0])
                over = time + 1 == length
                terminated, truncated = over and end != "truncated", over and end == "truncated"
                after = None if terminated else (before[0], before[1], before[2] + 1)
                reward = reward_of(row, episode, time, int(action) + 5)
                found.append((before, action, reward, terminated, truncated, after))
            episode += 1
        rows.append(found[:count])
    return rows
