"""Some copies of one environment, stepped in this process (``EnvGroup``; other processes: workers.py).

Copies reset in the step in which they end, so that no row is ever wasted; the true final observation of a
truncated episode is kept.
"""

from __future__ import annotations

import contextlib
import itertools
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from tightrope.control.environments import state as states
from tightrope.control.environments.faults import (
    RAISED,
    ApiBreak,
    EnvironmentFault,
    FaultPolicy,
    Overdue,
    action_text,
    check_finite,
    check_reset,
    check_step,
    circumstances,
    given_up,
    pause,
    raised_here,
    renewed_seed,
)
from tightrope.control.environments.step import Slots
from tightrope.control.environments.tasks import check_alike, make_all
from tightrope.control.spaces import MASK_KEY, Inputs, action_layout, observation_layout


class EnvGroup:
    """Some copies stepped one after the other in this process, writing straight into their slots.

    ``first``: index of the first copy among all. ``makers``: one function a copy, for a policy that makes it
    anew after a fault. ``worker``: 0 in the main process.
    """

    def __init__(
        self,
        envs: Sequence[gym.Env],
        slots: Slots,
        name: str,
        first: int = 0,
        *,
        makers: Sequence[Callable[[], gym.Env]] = (),
        policy: FaultPolicy = FaultPolicy(),  # noqa: B008 - it cannot be changed
        worker: int = 0,
    ) -> None:
        self.envs, self.slots, self.name, self.first, self.worker = list(envs), slots, name, first, worker
        self.observation_layout = observation_layout(envs[0].observation_space)
        self.action_layout = action_layout(envs[0].action_space)
        self.has_masks = False
        self.calls = 0  # steps and resets that have begun
        self.makers, self.policy = makers, policy
        self.renewed = 0  # copies made anew, in all
        self._plain = self.observation_layout.plain
        self._shape = envs[0].observation_space.shape
        self._steps = [env.step for env in envs]
        self._rows = [{k: a[i : i + 1] for k, a in slots.inputs.items()} for i in range(len(envs))]
        self._final_rows = [
            {k: a[i : i + 1] for k, a in slots.final_inputs.items()} for i in range(len(envs))
        ]
        self._flat_rows = [row["flat"][0] for row in self._rows] if self._plain else []
        self._mask_sources = [""] * len(envs)
        self._mask_functions: list[Callable[[], Any]] = [dict] * len(envs)
        self._checked = False  # the first step is looked at closely
        self._ended = True  # the flags hold something to wipe
        self._count, self._seed = 0, 0
        self._seeds: list[int | None] = [None] * len(envs)
        slots.under_way.fill(-1)

    def reset(self, seed: int) -> None:
        """Reset every copy; copy i (counted over all groups) gets ``seed + i``, one that was made anew a seed
        of its own.
        """
        self._count, self._checked, self._ended, self._seed = 0, False, True, seed
        self.slots.masks.fill(True)
        self.slots.cut.fill(False)
        try:
            for row in range(len(self.envs)):
                self._seeds[row] = self._seed_of(row)
                try:
                    self._begin(row)
                except RAISED as error:
                    self._renew(row, error)
            if self.has_masks:
                self._check_masks()
        finally:
            self.slots.under_way[0] = -1

    def _seed_of(self, row: int) -> int:
        often, index = int(self.slots.renewals[row]), self.first + row
        return renewed_seed(self._seed, often, index) if often else self._seed + index

    def _begin(self, row: int) -> None:
        """Reset one copy with its seed."""
        self.calls += 1
        self.slots.under_way[0] = row
        observation, info = check_reset(self.envs[row].reset(seed=self._seeds[row]))
        self._plain &= isinstance(observation, np.ndarray)
        self.observation_layout.write(observation, self._rows[row])
        if self.policy.restart:
            self._check_row(row, self._rows)
        self._find_mask(row, observation, info)
        if self.has_masks:
            self._store_mask(row, observation, info)

    def step(self) -> None:
        """Step every copy with its row of ``slots.actions``; one that ends is reset at once."""
        if self._ended:
            for flags in (self.slots.terminated, self.slots.truncated, self.slots.cut):
                flags.fill(False)
            self._ended = False
        self._count += 1
        self.calls += 1
        actions, row = self.action_layout.rows(self.slots.actions), 0
        try:
            while row < len(self.envs):
                row = self._step_from(row, actions)
            self._checked = True
            if self.has_masks:
                self._check_masks()
        finally:
            self.slots.under_way[0] = -1

    def busy(self) -> int | None:
        """A number that changes with every call of an environment; None while there is none under way."""
        row = int(self.slots.under_way[0])
        return None if row < 0 else self.calls * len(self.envs) + row

    def _step_from(self, begin: int, actions: Iterator[Any]) -> int:
        """Step the copies from ``begin`` on; the first that is still to be stepped, behind one made anew."""
        slots, plain, shape, checked = self.slots, self._plain, self._shape, self._checked
        rewards, flat_rows, under_way = slots.rewards, self._flat_rows, slots.under_way
        has_masks, strict, row = self.has_masks, self.policy.restart, begin
        try:
            for row, action in zip(range(begin, len(self.envs)), actions, strict=False):
                under_way[0] = row
                result = self._steps[row](action)
                if not checked:
                    check_step(result, has_masks)
                observation, reward, terminated, truncated, info = result
                rewards[row] = reward
                if strict:
                    check_finite("reward", rewards[row])
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
                if strict:
                    self._check_row(row, self._rows)
                if has_masks:
                    self._store_mask(row, observation, info)
        except RAISED as error:
            self._renew(row, error)
            return row + 1
        return len(self.envs)

    def _check_row(self, row: int, rows: list[Inputs], what: str = "observation") -> None:
        if "flat" in rows[row]:
            check_finite(what, rows[row]["flat"][0])

    def _renew(self, row: int, error: BaseException) -> None:
        """Make a copy anew after a fault, as often as the policy allows; else raise what happened.

        The step in which it failed did not take place (``slots.cut``), unless only the reset after it failed.
        """
        fault = self._fault(row, error)
        if not (self.policy.restart and self.makers):
            raise fault from error
        slots = self.slots
        whole = bool(slots.terminated[row] or slots.truncated[row])
        while True:
            if self.renewed >= self.policy.max_restarts:
                raise given_up(fault, self.renewed) from error
            self.renewed += 1
            slots.renewals[row] += 1
            often = int(slots.renewals[row])
            time.sleep(pause(often, self.policy.timeout))
            self._seeds[row] = self._seed_of(row)
            try:
                self._replace(row)
                self._begin(row)
                break
            except RAISED as again:
                error, fault = again, self._fault(row, again)
        if not whole and self._count:
            slots.cut[row], slots.rewards[row] = True, 0.0
        self._ended = True

    def _replace(self, row: int) -> None:
        """Another environment in the place of a copy; an instance of the user's own stays and is reset."""
        old = self.envs[row]
        fresh: list[gym.Env] = []
        make_all(self.makers[row : row + 1], fresh)
        check_alike(fresh, self.observation_layout, self.action_layout, self.name)
        if fresh[0] is not old:
            with contextlib.suppress(Exception):
                old.close()
        self.envs[row], self._steps[row] = fresh[0], fresh[0].step

    def get_state(self) -> list[Any]:
        """The packed state of every copy (see states.py)."""
        return [self._kept(row, states.state_of, env) for row, env in enumerate(self.envs)]

    def set_state(self, found: list[Any]) -> None:
        """Put packed states back into copies that have been reset."""
        for row, (env, state) in enumerate(zip(self.envs, found, strict=True)):
            self._kept(row, states.put_back, env, state)
            self._seeds[row] = self._seed_of(row)

    def _kept(self, row: int, function: Callable[..., Any], *arguments: Any) -> Any:
        self.calls += 1
        self.slots.under_way[0] = row
        try:
            return function(*arguments)
        except RAISED as error:
            what = f"the state of environment {self.first + row} ({self.name}) cannot be kept"
            message = f"{what}: {type(error).__name__}: {error}."
            facts: dict[str, Any] = {"env_id": self.name, "worker": self.worker}
            raise EnvironmentFault(message, self.first + row, self._count, **facts) from error
        finally:
            self.slots.under_way[0] = -1

    def _end(self, row: int, observation: Any, terminated: bool) -> tuple[Any, dict[str, Any]]:
        """Note how the episode ended, keep a truncation's last observation, and reset."""
        self._ended = True
        if terminated:
            self.slots.terminated[row] = True
        else:
            self.observation_layout.write(observation, self._final_rows[row])
            if self.policy.restart:
                self._check_row(row, self._final_rows, "final observation")
            self.slots.truncated[row] = True
        observation, info = self.envs[row].reset()
        return observation, info

    def _find_mask(self, row: int, observation: Any, info: dict[str, Any]) -> None:
        """Decide once where this copy's action masks come from."""
        env, source = self.envs[row], "none"
        if not self.action_layout.num_logits:
            pass  # nothing that a mask could forbid
        elif MASK_KEY in info:
            source = "info"
        elif env.has_wrapper_attr("action_masks") and callable(env.get_wrapper_attr("action_masks")):
            source = "method"
        elif self.observation_layout.has_mask:
            source = "observation"
        self._mask_sources[row] = source
        self._mask_functions[row] = env.get_wrapper_attr("action_masks") if source == "method" else dict
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
        while len(blocked := self.action_layout.blocked_rows(self.slots.masks)):
            self._renew(int(blocked[0]), ApiBreak("the action mask forbids every choice; allow at least one"))

    def _fault(self, row: int, error: BaseException) -> EnvironmentFault:
        """The error of one copy in words; an environment's own exception brings its traceback along."""
        index, seed = self.first + row, self._seeds[row]
        action = action_text(_nth(self.action_layout.rows(self.slots.actions), row)) if self._count else None
        where = f"environment {index} ({self.name}) at step {self._count}"
        if isinstance(error, Overdue):
            what = f" was {error}"
        elif isinstance(error, ApiBreak) or raised_here(error):
            what = f" does not follow Gymnasium's API: {error}"
        else:
            what = f" raised {type(error).__name__}: {error}"
        message = where + what + circumstances(self.worker, seed, action)
        if not isinstance(error, ApiBreak):
            message += "\n" + "".join(traceback.format_exception(error)).rstrip()
        facts: dict[str, Any] = {"env_id": self.name, "worker": self.worker, "seed": seed, "action": action}
        return EnvironmentFault(message, index, self._count, **facts)


def _nth(items: Iterator[Any], index: int) -> Any:
    return next(itertools.islice(items, index, None))
