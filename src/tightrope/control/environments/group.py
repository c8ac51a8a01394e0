"""Several environments stepped one after the other in one process.

Each is reset in the step in which its episode ends, so every row is a transition. The true final observation
of a truncated episode is kept.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import gymnasium as gym
import numpy as np

from tightrope.control.environments import state as states
from tightrope.control.environments.episode import Seeding, Start, Step
from tightrope.control.environments.faults import (
    RAISED,
    ApiBreak,
    EnvironmentFault,
    FaultPolicy,
    Restarts,
    action_text,
    check_finite,
    explained,
    float_parts,
    kind_of,
    wait_before_restart,
)
from tightrope.control.environments.masks import NOTHING_ALLOWED, MaskSource, find_source, success_of
from tightrope.control.environments.tasks import close_environment, make_all, renew_world
from tightrope.control.environments.watchdog import limited
from tightrope.control.spaces.actions import ActionLayout, action_layout
from tightrope.control.spaces.observations import ObservationLayout, observation_layout
from tightrope.control.spaces.structure import MASK_KEY, Inputs, Reading
from tightrope.runs import generators

# types of flags and rewards that need no look at each step
FLAG_TYPES = frozenset((bool, np.bool_))
REWARD_TYPES = frozenset((float, int, np.float64, np.float32))


@dataclass(frozen=True, eq=False)
class StepBuffers:
    """The arrays that N environments read their actions from and write their steps to, a row each.

    Allocated once; shared memory where worker processes step the environments.
    """

    inputs: Inputs
    final_inputs: Inputs
    actions: np.ndarray  # float32 [N, A], as sampled
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    success: np.ndarray  # float64 [N]: of the episode that ended, NaN: not said
    masks: np.ndarray  # bool [N, L]
    cut: np.ndarray  # bool [N]: restarted in this step
    restarts: np.ndarray  # int64 [N]: since all were reset
    origins: (
        np.ndarray
    )  # int64 [N, 3]: episode of the last seeded reset, others since, the count of steps then
    current: np.ndarray  # int64 [N]: in the first place of a group the row that it is stepping, else -1

    @classmethod
    def allocate(
        cls,
        num: int,
        observations: ObservationLayout,
        actions: ActionLayout,
        zeros: Callable[..., Any] = np.zeros,
    ) -> StepBuffers:
        """Buffers for ``num`` environments; ``zeros(shape, dtype)`` makes each array."""
        return cls(
            inputs=observations.allocate(num, zeros),
            final_inputs=observations.allocate(num, zeros),
            actions=zeros((num, actions.num_columns), np.float32),
            rewards=zeros((num,), np.float64),
            terminated=zeros((num,), np.bool_),
            truncated=zeros((num,), np.bool_),
            success=zeros((num,), np.float64),
            masks=zeros((num, actions.num_logits), np.bool_),
            cut=zeros((num,), np.bool_),
            restarts=zeros((num,), np.int64),
            origins=zeros((num, 3), np.int64),
            current=zeros((num,), np.int64),
        )

    def map(self, function: Callable[[Any], Any]) -> StepBuffers:
        """The same buffers with ``function`` applied to each array."""

        def mapped(value: object) -> Any:
            if isinstance(value, dict):
                return {name: function(array) for name, array in value.items()}
            return function(value)

        return StepBuffers(**{field.name: mapped(getattr(self, field.name)) for field in fields(self)})

    def origins_at(self, count: int) -> np.ndarray:
        """See `Environments.origins`; ``count``: of the steps now."""
        found = self.origins.copy()
        found[:, 2] = count - found[:, 2]
        return found

    def step(self, has_masks: bool, count: int) -> Step:
        """The last step, copied; ``count``: its number."""
        rows = np.flatnonzero(self.truncated) if self.truncated.any() else None
        success = None
        if rows is not None or self.terminated.any():
            success = np.where(self.terminated | self.truncated, self.success, np.nan)
        cut = self.cut.copy() if self.cut.any() else None
        new = rows is not None or cut is not None or self.terminated.any()
        return Step(
            inputs={name: array.copy() for name, array in self.inputs.items()},
            action_mask=self.masks.copy() if has_masks else None,
            rewards=self.rewards.copy(),
            terminated=self.terminated.copy(),
            truncated=self.truncated.copy(),
            final_rows=rows,
            final_inputs=None if rows is None else {k: array[rows] for k, array in self.final_inputs.items()},
            cut=cut,
            origins=self.origins_at(count) if new else None,
            success=success,
        )


class EnvGroup:
    """Environments that write their steps straight into their rows of the buffers.

    ``first``: index of the first among all of the run. ``makers``: one function per environment, for a policy
    that restarts it after a fault. ``worker``: number of this process, 0 for the main one.
    """

    def __init__(
        self,
        envs: Sequence[gym.Env],
        buffers: StepBuffers,
        name: str,
        first: int = 0,
        *,
        makers: Sequence[Callable[[], gym.Env]] = (),
        policy: FaultPolicy = FaultPolicy(),  # noqa: B008 - it cannot be changed
        worker: int = 0,
        reading: Reading = Reading(),  # noqa: B008
    ) -> None:
        self.envs = list(envs)
        self.buffers = buffers
        self.name = name
        self.first = first
        self.worker = worker
        # the main process watches its workers
        self._limit = functools.partial(limited, timeout=None if worker else policy.timeout)
        self.makers = makers
        self.policy = policy
        self.restarts = Restarts(policy)
        self.observation_layout = observation_layout(envs[0].observation_space, reading.encoder, reading.keys)
        self.action_layout = action_layout(envs[0].action_space, reading.action_bounds)
        self.has_masks = False
        self._mask_sources = [MaskSource()] * len(envs)
        self._shape = envs[0].observation_space.shape
        self._plain = self.observation_layout.plain
        self._dtype: np.dtype[Any] | None = None  # of plain observations, as last seen
        self._rows = [{k: a[i : i + 1] for k, a in buffers.inputs.items()} for i in range(len(envs))]
        self._finals = [{k: a[i : i + 1] for k, a in buffers.final_inputs.items()} for i in range(len(envs))]
        self._flat_rows = [row["flat"][0] for row in self._rows] if self._plain else []
        self._seeding = Seeding(0)
        self._clean: list[Any] = [None] * len(envs)  # what they carry before their first episode
        self.carried: list[Any] = [None] * len(envs)  # see `Environments.carried`
        self._count = 0  # steps since the last reset of all
        self._calls = 0  # steps and resets that have begun
        self._checked = False  # the first step is checked closely
        self._dirty = True  # a flag may be set
        buffers.current.fill(-1)

    def reset(self, seeding: Seeding, starts: Sequence[Start] | None = None, count: int = 0) -> None:
        """Reset all; the steps are counted from ``count`` on. See `Environments.reset`."""
        self._seeding = seeding
        self._count = count
        self._checked = False
        self._dirty = True
        self.buffers.masks.fill(True)
        self.buffers.cut.fill(False)
        if self.worker:
            generators.seed(seeding.run, self.first)
        try:
            for row in range(len(self.envs)):
                try:
                    self._begin(row, Start() if starts is None else starts[row])
                except RAISED as error:
                    self._restart(row, error)
            self._check_masks()
        finally:
            self.buffers.current[0] = -1

    def renew(self, row: int, wait: int) -> None:
        """Begin the next episode in one row, which then waits for ``wait`` steps."""
        try:
            self._begin(row, Start(self._next_episode(row), wait))
        finally:
            self.buffers.current[0] = -1

    def step(self) -> None:
        """Step each with its row of ``buffers.actions``; one whose episode ends is reset at once."""
        if self._dirty:
            for flags in (self.buffers.terminated, self.buffers.truncated, self.buffers.cut):
                flags.fill(False)
            self._dirty = False
        self._count += 1
        self._calls += 1
        actions = self.action_layout.rows(self.buffers.actions)
        row = 0
        try:
            while row < len(self.envs):
                row = self._step_from(row, actions)
            self._checked = True
            self._check_masks()
        finally:
            self.buffers.current[0] = -1

    def call_number(self) -> int | None:
        """A number that changes with every call of an environment; None between calls."""
        row = int(self.buffers.current[0])
        return None if row < 0 else self._calls * len(self.envs) + row

    def _begin(self, row: int, start: Start) -> None:
        """Reset one environment with the seed of an episode."""
        env = self.envs[row] = _awake(self.envs[row])
        self._calls += 1
        self.buffers.current[0] = row
        self.buffers.origins[row] = (start.episode, 0, self._count + start.wait)
        names = self._seeding.carried
        if self._seeding.reseed_after is not None and (names or states.gives_state(env)):
            if self._clean[row] is None:
                self._clean[row] = states.clean(env, names, self._seed_of(row))
            self.carried[row] = None
            states.give(env, start.carried or self._clean[row], self._seed_of(row))
        observation, info = _check_reset(self._seeded_reset(row))
        if absent := states.not_there(env, names):
            raise ApiBreak(f"carried names {absent[0]}, and that layer has no such attribute")
        self._plain &= isinstance(observation, np.ndarray)
        self.observation_layout.write(observation, self._rows[row])
        if self.policy.restart:
            self._check_row(self._rows[row], "observation")
        self._find_mask(row, info)
        if self.has_masks:
            self._store_mask(row, observation, info)
        if start.wait:
            waiting: Any = _Waiting(self.envs, row, (observation, info), start.wait)
            self.envs[row] = waiting

    def _seeded_reset(self, row: int) -> tuple[Any, dict[str, Any]]:
        """Reset with the seed of the episode; an episode is a function of it and of what is carried."""
        env = self.envs[row]
        if self._clean[row] is not None and not isinstance(self.carried[row], str):
            try:
                self.carried[row] = states.take(env, self._seeding.carried)
            except TypeError as error:  # from here on it cannot be repeated; see `Environments.carried`
                self.carried[row] = str(error)
        renew_world(env)
        seed = self._seed_of(row)
        if len(self.envs) == 1:  # what it draws from the global generators is then its own
            generators.seed(seed)
        return env.reset(seed=seed)

    def _next_episode(self, row: int) -> int:
        episode, after, _ = self.buffers.origins[row].tolist()
        return int(episode + after + 1)

    def _step_from(self, begin: int, actions: Iterator[object]) -> int:
        """Step from row ``begin`` on; the row to continue from, behind one that was restarted."""
        # local names are faster, and this loop runs at every step
        buffers, plain, shape, checked = self.buffers, self._plain, self._shape, self._checked
        envs, rewards, flat_rows, current = self.envs, buffers.rewards, self._flat_rows, buffers.current
        has_masks, strict, dtype = self.has_masks, self.policy.restart, self._dtype
        may_tell = has_masks or not self.action_layout.num_logits  # of a mask, if only one with no use
        row = begin
        try:
            for row, action in zip(range(begin, len(self.envs)), actions, strict=False):
                current[0] = row
                result = envs[row].step(action)
                if not checked:
                    _check_step(result, may_tell)
                observation, reward, terminated, truncated, info = result
                if not (
                    type(terminated) in FLAG_TYPES
                    and type(truncated) in FLAG_TYPES
                    and type(reward) in REWARD_TYPES
                    and type(info) is dict
                ):  # numpy would store most of these all the same
                    _check_step(result, may_tell)
                rewards[row] = reward
                if strict:
                    check_finite("reward", rewards[row])
                if terminated or truncated:
                    observation, info = self._end(row, observation, terminated, info)
                if plain:
                    if observation.shape != shape or observation.dtype is not dtype:
                        dtype = self._checked_dtype(observation)
                    flat_rows[row][...] = observation
                else:
                    self.observation_layout.write(observation, self._rows[row])
                if strict:
                    self._check_row(self._rows[row], "observation")
                if has_masks:
                    self._store_mask(row, observation, info)
        except RAISED as error:
            self._restart(row, error)
            return row + 1
        return len(self.envs)

    def _checked_dtype(self, observation: np.ndarray) -> np.dtype[Any]:
        """The dtype of a plain observation. ApiBreak: another shape, or no real numbers, which numpy would
        store all the same (a text as the number it spells, a complex number without its imaginary part).
        """
        if observation.shape != self._shape:
            raise ApiBreak(f"the observation has shape {observation.shape}, the space says {self._shape}")
        if observation.dtype.kind not in "biuf":
            raise ApiBreak(f"the observation is {observation!r}, expected an array of real numbers")
        self._dtype = observation.dtype
        return self._dtype

    def _end(
        self, row: int, observation: object, terminated: bool, info: dict[str, Any]
    ) -> tuple[Any, dict[str, Any]]:
        """Record how the episode ended, keep a truncation's last observation, and reset."""
        self._dirty = True
        self.buffers.success[row] = success_of(info)
        if terminated:
            self.buffers.terminated[row] = True
        else:
            self.observation_layout.write(observation, self._finals[row])
            if self.policy.restart:
                self._check_row(self._finals[row], "final observation")
            self.buffers.truncated[row] = True
        episode, after, begun = self.buffers.origins[row].tolist()
        if not self._seeding.due(self._count - begun):
            self.buffers.origins[row, 1] += 1
            return self.envs[row].reset()
        self.buffers.origins[row] = (episode + after + 1, 0, self._count)
        return self._seeded_reset(row)

    @staticmethod
    def _check_row(inputs: Inputs, what: str) -> None:
        for numbers in float_parts(inputs):
            check_finite(what, numbers[0])

    # ------------------------------------------------------------------------------------------------- masks

    def _find_mask(self, row: int, info: Mapping[str, object]) -> None:
        source = find_source(
            self.envs[row], info, self.observation_layout.has_mask, self.action_layout.num_logits
        )
        self._mask_sources[row] = source
        self.has_masks = source.kind != "none"
        if source.kind != self._mask_sources[0].kind:
            raise ApiBreak(
                f"this copy's action masks come from {source.kind!r}, copy 0's from "
                f"{self._mask_sources[0].kind!r}"
            )

    def _store_mask(self, row: int, observation: object, info: Mapping[str, object]) -> None:
        mask = self._mask_sources[row].read(observation, info)
        self.buffers.masks[row] = self.action_layout.flatten_mask(mask, 1)

    def _check_masks(self) -> None:
        while self.has_masks and len(blocked := self.action_layout.blocked_rows(self.buffers.masks)):
            self._restart(int(blocked[0]), ApiBreak(NOTHING_ALLOWED))

    # ------------------------------------------------------------------------------------------------ faults

    def _restart(self, row: int, error: BaseException) -> None:
        """Restart an environment after a fault, as often as the policy allows; else raise the fault.

        The step in which it failed did not take place (``buffers.cut``), unless only the reset after it
        failed.
        """
        fault = self._fault(row, error)
        if not (self.policy.restart and self.makers):
            raise fault from error
        buffers = self.buffers
        complete = bool(buffers.terminated[row] or buffers.truncated[row])

        def attempt() -> None:
            buffers.restarts[row] += 1
            wait_before_restart(int(buffers.restarts[row]), self.policy)
            self._replace(row)
            self._begin(row, Start(self._next_episode(row)))

        self.restarts.until_it_works(fault, attempt, lambda again: self._fault(row, again))
        if not complete and self._count:
            buffers.cut[row] = True
            buffers.rewards[row] = 0.0
        self._dirty = True

    def _replace(self, row: int) -> None:
        """Make another environment for a row; an instance that the user gave stays and is reset."""
        old = _awake(self.envs[row])
        fresh: list[gym.Env] = []
        make_all(self.makers[row : row + 1], fresh, self.first + row, self._limit)
        check_alike(fresh, self.observation_layout, self.action_layout, self.name)
        if fresh[0] is not old:
            with contextlib.suppress(EnvironmentFault):
                close_environment(old, self.first + row, self._limit)
            self._clean[row] = None
        self.envs[row] = fresh[0]

    def _seed_of(self, row: int) -> int:
        return self._seeding.seed(self.first + row, int(self.buffers.origins[row, 0]))

    def _fault(self, row: int, error: BaseException) -> EnvironmentFault:
        action = None
        if self._count:
            action = action_text(self.action_layout.to_env_single(self.buffers.actions[row]))
        index = self.first + row
        return explained(
            error,
            f"environment {index} ({self.name})",
            index,
            self._count,
            env_id=self.name,
            worker=self.worker,
            seed=self._seed_of(row),
            action=action,
        )


class _Waiting:
    """Stands in the place of an environment that has been reset, until it was stepped ``steps`` times."""

    def __init__(self, envs: list[Any], row: int, reset: tuple[Any, dict[str, Any]], steps: int) -> None:
        self.env, self._envs, self._row, self._reset, self._left = envs[row], envs, row, reset, steps

    def step(self, action: object) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if not self._left:
            self._envs[self._row] = self.env
            return self.env.step(action)
        self._left -= 1
        return self._reset[0], 0.0, False, False, self._reset[1]

    def close(self) -> None:
        self.env.close()


def _awake(env: object) -> Any:
    return env.env if isinstance(env, _Waiting) else env


def check_alike(
    envs: Sequence[gym.Env], observations: ObservationLayout, actions: ActionLayout, name: str
) -> None:
    """ValueError when the copies' observations or actions differ in shape, or the bounds of actions."""
    for env in envs:
        if not (observations.fits(env.observation_space) and actions.fits(env.action_space)):
            raise ValueError(
                f"the copies of {name} differ: {env.observation_space}, {env.action_space} against "
                f"{observations.space}, {actions.space}. All copies must have the same spaces."
            )


def _check_reset(result: object) -> tuple[Any, dict[str, Any]]:
    """The pair (observation, info) that ``reset`` returned; ApiBreak when it is something else."""
    if not (isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], dict)):
        raise ApiBreak(
            f"reset returned {kind_of(result)}, expected the pair (observation, info dict). "
            "Environments of the old gym API must be ported to Gymnasium 1.x"
        )
    return result


def _check_step(result: object, may_tell: bool) -> None:
    """Check a step of an environment. ApiBreak when it does not follow Gymnasium's API."""
    if not isinstance(result, tuple) or len(result) != 5:
        raise ApiBreak(
            f"step returned {kind_of(result)}, expected five values: observation, reward, terminated, "
            "truncated, info. Environments of the old gym API (four values) must be ported to Gymnasium 1.x"
        )
    _, reward, terminated, truncated, info = result
    if np.ndim(reward) != 0 or np.asarray(reward).dtype.kind not in "biuf":
        several = ". Weigh several rewards into one in a wrapper" if np.ndim(reward) else ""
        raise ApiBreak(f"the reward is {reward!r}, expected one number{several}")
    for name, flag in (("terminated", terminated), ("truncated", truncated)):
        if np.ndim(flag) != 0 or np.asarray(flag).dtype.kind not in "biuf" or flag not in (0, 1):
            raise ApiBreak(f"{name} is {flag!r}, expected True or False")
    if not isinstance(info, dict):
        raise ApiBreak(f"info is {kind_of(info)}, expected a dict")
    if MASK_KEY in info and not may_tell:
        raise ApiBreak(
            f"step gives info[{MASK_KEY!r}] but reset did not; give it at every reset and every step"
        )
