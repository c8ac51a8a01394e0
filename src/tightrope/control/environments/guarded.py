"""Faults of vector environments: named as those of single copies are, and made anew where that is possible.

A vector environment is one thing: when it fails, all its copies are lost, and all are made anew. Gymnasium's
vector versions of an id and EnvPool's can be; one that the user gave cannot, and its fault ends the run.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv

from tightrope.control.environments import state as states
from tightrope.control.environments.faults import (
    RAISED,
    ApiBreak,
    EnvironmentFault,
    FaultPolicy,
    Overdue,
    action_text,
    check_finite,
    circumstances,
    given_up,
    pause,
    renewed_seed,
)
from tightrope.control.environments.step import Step
from tightrope.control.environments.vectorised import VectorCopies
from tightrope.control.environments.watchdog import Watchdog
from tightrope.control.spaces import Inputs


class GuardedVector:
    """`VectorCopies` under a FaultPolicy. ``anew``: makes another vector environment; None: impossible."""

    def __init__(
        self, copies: VectorCopies, policy: FaultPolicy, anew: Callable[[int], Any] | None = None
    ) -> None:
        self._copies, self.policy, self._anew, self.restarts = copies, policy, anew, 0
        self.observation_layout, self.action_layout = copies.observation_layout, copies.action_layout
        self._seed, self._count, self._renewals, self._calls = 0, 0, 0, 0
        self._busy, self._actions = False, np.zeros((0, 0))
        self._watchdog: Watchdog | None = None
        if policy.timeout is not None:
            name = f"The vector environment {copies.name}"
            self._watchdog = Watchdog(self.busy, policy.timeout, name)

    @property
    def waves(self) -> tuple[slice, ...]:
        """All rows at once: a vector environment steps them together."""
        return self._copies.waves

    def busy(self) -> int | None:
        """A number that changes with every call; None while there is none under way."""
        return self._calls if self._busy else None

    def reset(self, seed: int) -> tuple[Inputs, np.ndarray | None]:
        """Reset all rows, seeded; the first inputs and action masks."""
        if self._watchdog is not None:
            self._watchdog.start()
        self._seed, self._count, self._renewals = seed, 0, 0
        try:
            return self._reset(seed)
        except RAISED as error:
            return self._renew(error)

    def _reset(self, seed: int) -> tuple[Inputs, np.ndarray | None]:
        self._calls, self._busy = self._calls + 1, True
        try:
            inputs, masks = self._copies.reset(seed)
            if self.policy.restart and "flat" in inputs:
                check_finite("observation", inputs["flat"])
        finally:
            self._busy = False
        return inputs, masks

    @property
    def gives_state(self) -> bool:
        """Whether the environment can give its state (see states.py)."""
        return states.gives_state(self._copies._env)

    def get_state(self) -> dict[str, Any]:
        """The state of the environment, and what its seed is made of."""
        return {"seed": self._seed, "renewals": self._renewals, "states": self._copies.get_state()}

    def set_state(self, found: dict[str, Any]) -> tuple[Inputs, np.ndarray | None]:
        """Reset, and go on from what `get_state` gave; returns what the reset did."""
        fresh = self.reset(found["seed"])
        self._renewals = int(found["renewals"])
        self._copies.set_state(found["states"])
        return fresh

    def count_from(self, restarts: int) -> None:
        """So many restarts are behind the run already."""
        self.restarts = restarts

    def begin(self, rows: slice, actions: np.ndarray) -> None:
        """Take the action matrix [B, A]."""
        self._actions = actions
        self._copies.begin(rows, actions)

    def finish(self) -> Step:
        """Step all rows with the actions taken; when it fails, all episodes are cut."""
        self._calls, self._busy, self._count = self._calls + 1, True, self._count + 1
        try:
            step = self._copies.finish()
            if self.policy.restart:
                check_finite("reward", step.rewards)
                for what, found in (("observation", step.inputs), ("final observation", step.final_inputs)):
                    if found is not None and "flat" in found:
                        check_finite(what, found["flat"])
            return step
        except RAISED as error:
            self._busy = False
            inputs, masks = self._renew(error)
            nothing, none = np.zeros(self._copies.num_envs), np.zeros(self._copies.num_envs, bool)
            return Step(inputs, masks, nothing, none, none.copy(), None, None, None, ~none)
        finally:
            self._busy = False

    def _renew(self, error: BaseException) -> tuple[Inputs, np.ndarray | None]:
        """Another vector environment after a fault, as often as the policy allows; else raise the fault."""
        fault = self._fault(error)
        if not self.policy.restart or self._anew is None:
            raise fault from error
        while True:
            if self.restarts >= self.policy.max_restarts:
                raise given_up(fault, self.restarts) from error
            self.restarts, self._renewals = self.restarts + 1, self._renewals + 1
            time.sleep(pause(self._renewals, self.policy.timeout))
            seed = renewed_seed(self._seed, self._renewals, 0)
            try:
                self._copies.renew(self._anew, seed)
                return self._reset(seed)
            except RAISED as again:
                error, fault = again, self._fault(again)

    def _fault(self, error: BaseException) -> EnvironmentFault:
        name, action = self._copies.name, action_text(self._actions.tolist()) if self._count else None
        where = f"the vector environment {name} at step {self._count}"
        index = -1
        if isinstance(error, EnvironmentFault):
            message, index = str(error), error.index
        elif isinstance(error, Overdue):
            message = f"{where} was {error}"
        elif isinstance(error, ApiBreak):
            message = f"{where} cannot be used: {error}"
        else:
            message = f"{where} raised {type(error).__name__}: {error}"
        seed = self.seed_of(0)
        message += circumstances(0, seed, action)
        if self.policy.restart and self._anew is None:
            message += ". It was given as an object, which cannot be made anew: give an id or a factory"
        if not isinstance(error, EnvironmentFault | ApiBreak):
            message += "\n" + "".join(traceback.format_exception(error)).rstrip()
        facts: dict[str, Any] = {"env_id": name, "seed": seed, "action": action}
        return EnvironmentFault(message, index, self._count, **facts)

    def seed_of(self, row: int) -> int:
        """The one seed of all rows."""
        return renewed_seed(self._seed, self._renewals, 0) if self._renewals else self._seed

    def worker_of(self, row: int) -> int:
        """No worker of ours."""
        return 0

    def close(self) -> None:
        """Close the environment unless it is the caller's own; closing twice is fine."""
        if self._watchdog is not None:
            self._watchdog.stop()
        self._copies.close()


def is_vector_env(env: Any) -> bool:
    """True for Gymnasium's vector environments, and for EnvPool's, which only look like them."""
    if isinstance(env, VectorEnv):
        return True
    looks_like = hasattr(env, "single_action_space") and hasattr(env, "num_envs")
    return looks_like and not isinstance(env, gym.Env | type)
