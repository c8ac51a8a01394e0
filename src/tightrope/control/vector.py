"""Many copies of one environment, stepped in this process (``EnvGroup``; other processes: workers.py).

Copies reset in the step in which they end, so that no row is ever wasted; the true final observation of a
truncated episode is kept. Everything goes through preallocated arrays (``Slots``), which workers share with
this process.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from tightrope.control import spaces, states
from tightrope.control.nested import MASK_KEY
from tightrope.control.spaces import (
    ActionLayout,
    Inputs,
    ObservationLayout,
    action_layout,
    observation_layout,
)


class EnvironmentFault(RuntimeError):
    """An environment raised, broke Gymnasium's API, or its process died: which copy, at which step, what."""

    def __init__(self, message: str, index: int = -1, step: int = -1) -> None:
        super().__init__(message)
        self.index = index
        self.step = step


class ApiBreak(Exception):
    """What an environment gave that Gymnasium's API does not allow; becomes an EnvironmentFault."""


class Step(NamedTuple):
    """What one step of all B copies gave; rewards and flags are good until the next step."""

    inputs: Inputs  # what the next action is chosen from
    action_mask: np.ndarray | None  # bool [B, L], for the next action
    rewards: np.ndarray  # float64 [B]
    terminated: np.ndarray  # bool [B]
    truncated: np.ndarray  # bool [B]; never True where terminated is
    phantom: np.ndarray | None  # bool [B]: NEXT_STEP's reset, no transition; None: there is none in this step
    final_rows: np.ndarray | None  # int [F]: truncated rows whose ``inputs`` are the next episode's already
    final_inputs: Inputs | None  # [F, ...]: the true last observations of these rows


@dataclass(frozen=True, eq=False)
class Slots:
    """The arrays through which N copies speak; row i belongs to copy i."""

    inputs: Inputs
    final_inputs: Inputs
    actions: np.ndarray  # float32 [N, A], already squashed where that was asked for
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    masks: np.ndarray  # bool [N, L]

    @classmethod
    def allocate(
        cls,
        num: int,
        observations: ObservationLayout,
        actions: ActionLayout,
        zeros: Callable[..., Any] = np.zeros,
    ) -> Slots:
        """Slots for ``num`` copies; ``zeros(shape, dtype)`` makes each array."""
        return cls(
            inputs=observations.allocate(num, zeros),
            final_inputs=observations.allocate(num, zeros),
            actions=zeros((num, actions.num_columns), np.float32),
            rewards=zeros((num,), np.float64),
            terminated=zeros((num,), np.bool_),
            truncated=zeros((num,), np.bool_),
            masks=zeros((num, actions.num_logits), np.bool_),
        )

    def map(self, function: Callable[[Any], Any]) -> Slots:
        """The same slots with ``function`` applied to each array."""
        return Slots(
            {name: function(array) for name, array in self.inputs.items()},
            {name: function(array) for name, array in self.final_inputs.items()},
            *(function(a) for a in (self.actions, self.rewards, self.terminated, self.truncated, self.masks)),
        )

    def step(self, has_masks: bool) -> Step:
        """A copy of what the last step left here."""
        rows = np.flatnonzero(self.truncated) if self.truncated.any() else None
        return Step(
            {name: array.copy() for name, array in self.inputs.items()},
            self.masks.copy() if has_masks else None,
            self.rewards.copy(),
            self.terminated.copy(),
            self.truncated.copy(),
            None,
            rows,
            None if rows is None else {name: array[rows] for name, array in self.final_inputs.items()},
        )


class EnvGroup:
    """Some copies stepped one after the other in this process, writing straight into their slots."""

    def __init__(self, envs: Sequence[gym.Env], slots: Slots, name: str, first: int = 0) -> None:
        self.envs = list(envs)
        self.slots = slots
        self.name = name
        self.first = first  # index of the first copy among all
        self.observation_layout = observation_layout(envs[0].observation_space)
        self.action_layout = action_layout(envs[0].action_space)
        self.has_masks = False
        self._plain = self.observation_layout.plain
        self._shape = envs[0].observation_space.shape
        self._steps = [env.step for env in envs]
        self._rows = [{k: a[i : i + 1] for k, a in slots.inputs.items()} for i in range(len(envs))]
        self._final_rows = [
            {k: a[i : i + 1] for k, a in slots.final_inputs.items()} for i in range(len(envs))
        ]
        self._flat_rows = [row["flat"][0] for row in self._rows] if self._plain else []
        self._mask_sources: list[str] = []
        self._mask_functions: list[Callable[[], Any]] = []
        self._checked = False  # the first step is looked at closely
        self._ended = True  # the flags hold something to wipe
        self._count = 0

    def reset(self, seed: int) -> None:
        """Reset every copy; copy i (counted over all groups) gets ``seed + i``."""
        self._count, self._checked, self._ended, row = 0, False, True, 0
        self._mask_sources, self._mask_functions = [], []
        self.slots.masks.fill(True)
        try:
            for row, env in enumerate(self.envs):
                observation, info = check_reset(env.reset(seed=seed + self.first + row))
                self._plain &= isinstance(observation, np.ndarray)
                self.observation_layout.write(observation, self._rows[row])
                self._find_mask(env, observation, info)
                if self.has_masks:
                    self._store_mask(row, observation, info)
        except Exception as error:
            raise self._fault(row, error) from error
        if self.has_masks:
            self._check_masks()

    def step(self) -> None:
        """Step every copy with its row of ``slots.actions``; one that ends is reset at once."""
        slots, plain, shape, checked = self.slots, self._plain, self._shape, self._checked
        rewards, flat_rows, has_masks = slots.rewards, self._flat_rows, self.has_masks
        if self._ended:
            slots.terminated.fill(False)
            slots.truncated.fill(False)
            self._ended = False
        self._count += 1
        row = 0
        try:
            for row, action in enumerate(self.action_layout.rows(slots.actions)):
                result = self._steps[row](action)
                if not checked:
                    check_step(result, self.has_masks)
                observation, reward, terminated, truncated, info = result
                rewards[row] = reward
                if terminated or truncated:
                    observation, info = self._end(row, observation, terminated)
                if plain:
                    if observation.shape != shape:
                        raise ApiBreak(
                            f"the observation has shape {observation.shape}, the space says {shape}"
                        )
                    flat_rows[row][...] = observation
                else:
                    self.observation_layout.write(observation, self._rows[row])
                if has_masks:
                    self._store_mask(row, observation, info)
        except Exception as error:
            raise self._fault(row, error) from error
        self._checked = True
        if has_masks:
            self._check_masks()

    def get_state(self) -> list[Any]:
        """The packed state of every copy (see states.py)."""
        return [self._kept(row, states.state_of, env) for row, env in enumerate(self.envs)]

    def set_state(self, found: list[Any]) -> None:
        """Put packed states back into copies that have been reset."""
        for row, (env, state) in enumerate(zip(self.envs, found, strict=True)):
            self._kept(row, states.put_back, env, state)

    def _kept(self, row: int, function: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return function(*arguments)
        except Exception as error:
            what = f"the state of environment {self.first + row} ({self.name}) cannot be kept"
            message = f"{what}: {type(error).__name__}: {error}."
            raise EnvironmentFault(message, self.first + row, self._count) from error

    def _end(self, row: int, observation: Any, terminated: bool) -> tuple[Any, dict[str, Any]]:
        """Note how the episode ended, keep a truncation's last observation, and reset."""
        self._ended = True
        if terminated:
            self.slots.terminated[row] = True
        else:
            self.slots.truncated[row] = True
            self.observation_layout.write(observation, self._final_rows[row])
        observation, info = self.envs[row].reset()
        return observation, info

    def _find_mask(self, env: gym.Env, observation: Any, info: dict[str, Any]) -> None:
        """Decide once where this copy's action masks come from."""
        source = "none"
        if not self.action_layout.num_logits:
            pass  # nothing that a mask could forbid
        elif MASK_KEY in info:
            source = "info"
        elif env.has_wrapper_attr("action_masks") and callable(env.get_wrapper_attr("action_masks")):
            source = "method"
        elif self.observation_layout.has_mask:
            source = "observation"
        self._mask_sources.append(source)
        self._mask_functions.append(env.get_wrapper_attr("action_masks") if source == "method" else dict)
        self.has_masks = source != "none"
        if source != self._mask_sources[0]:
            raise ApiBreak(
                f"this copy's action masks come from {source!r}, copy 0's from {self._mask_sources[0]!r}"
            )

    def _store_mask(self, row: int, observation: Any, info: dict[str, Any]) -> None:
        source = self._mask_sources[row]
        if source == "info":
            if MASK_KEY not in info:
                raise ApiBreak(
                    f"info has no {MASK_KEY!r} although reset gave one; give it at every reset and every step"
                )
            mask = info[MASK_KEY]
        else:
            mask = (
                self._mask_functions[row]()
                if source == "method"
                else self.observation_layout.mask_of(observation)
            )
        self.slots.masks[row] = self.action_layout.flatten_mask(mask, 1)

    def _check_masks(self) -> None:
        blocked = self.action_layout.blocked_rows(self.slots.masks)
        if len(blocked):
            raise self._fault(
                int(blocked[0]), ApiBreak("the action mask forbids every choice; allow at least one")
            )

    def _fault(self, row: int, error: Exception) -> EnvironmentFault:
        """The error of one copy in words; an environment's own exception brings its traceback along."""
        index = self.first + row
        where = f"environment {index} ({self.name}) at step {self._count}"
        if isinstance(error, ApiBreak) or _raised_here(error):
            message = f"{where} does not follow Gymnasium's API: {error}."
        else:
            trace = "".join(traceback.format_exception(error))
            message = f"{where} raised {type(error).__name__}: {error}\n{trace}"
        return EnvironmentFault(message, index, self._count)


def _raised_here(error: Exception) -> bool:
    """True when the innermost frame is this library's: an answer could not be used, no environment raised."""
    frames = traceback.extract_tb(error.__traceback__)
    return bool(frames) and frames[-1].filename in (__file__, spaces.__file__)


def check_reset(result: Any) -> tuple[Any, dict[str, Any]]:
    """The pair (observation, info) that ``reset`` gave; ApiBreak when it is something else."""
    if not (isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], dict)):
        raise ApiBreak(
            f"reset returned {describe(result)}, expected the pair (observation, info dict). "
            "Environments of the old gym API must be ported to Gymnasium 1.x"
        )
    return result


def check_step(result: Any, has_masks: bool) -> None:
    """A close look at the first step of a copy; ApiBreak names what came and what was expected."""
    if not isinstance(result, tuple) or len(result) != 5:
        raise ApiBreak(
            f"step returned {describe(result)}, expected five values: observation, reward, terminated, "
            "truncated, "
            "info. Environments of the old gym API (four values) must be ported to Gymnasium 1.x"
        )
    _, reward, terminated, truncated, info = result
    if isinstance(reward, str | bytes | None) or np.ndim(reward) != 0:
        raise ApiBreak(f"the reward is {reward!r}, expected one number")
    for name, flag in (("terminated", terminated), ("truncated", truncated)):
        if not isinstance(flag, bool | np.bool_ | int):
            raise ApiBreak(f"{name} is {flag!r}, expected True or False")
    if not isinstance(info, dict):
        raise ApiBreak(f"info is {describe(info)}, expected a dict")
    if MASK_KEY in info and not has_masks:
        raise ApiBreak(
            f"step gives info[{MASK_KEY!r}] but reset did not; give it at every reset and every step"
        )


def describe(value: Any) -> str:
    """A value in a few words for an error message."""
    if isinstance(value, tuple):
        return f"a tuple of {len(value)} values"
    return (
        f"an array of shape {value.shape}" if isinstance(value, np.ndarray) else f"a {type(value).__name__}"
    )
