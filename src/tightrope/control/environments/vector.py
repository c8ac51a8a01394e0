"""Gymnasium's vector environments, in all three of their reset modes, as `Environments`.

SAME_STEP: the row holds the next episode's first observation, the true last one is in info["final_obs"].
NEXT_STEP: the row holds the true last observation; the next step ignores its action and only resets (a
phantom row). DISABLED: this module resets the rows that ended, with options={"reset_mask": ...}.

A vector environment fails as a whole: all its rows are lost, and all are restarted. The vector versions of an
id and EnvPool's can be; one that the user gave as an object cannot, and its fault ends the run.
"""

from __future__ import annotations

import contextlib
import functools
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeGuard, final

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from tightrope.control.environments import state as states
from tightrope.control.environments import tasks
from tightrope.control.environments.base import Environments
from tightrope.control.environments.episode import Start, Step
from tightrope.control.environments.faults import (
    RAISED,
    ApiBreak,
    EnvironmentFault,
    FaultPolicy,
    action_text,
    check_finite,
    explained,
    float_parts,
    kind_of,
    wait_before_restart,
)
from tightrope.control.environments.masks import (
    MISSING,
    NOTHING_ALLOWED,
    SUCCESS_KEY,
    find_source,
    given,
    vector_success,
)
from tightrope.control.environments.tasks import close_environment
from tightrope.control.environments.watchdog import Watchdog, limited
from tightrope.control.spaces.actions import action_layout
from tightrope.control.spaces.observations import observation_layout
from tightrope.control.spaces.structure import MASK_KEY, Inputs, Reading

# the second is a typing error in some of Gymnasium's environments
MODE_KEYS = ("autoreset_mode", "autoreseet-mode")


def is_vector_env(env: object) -> TypeGuard[VectorEnv]:
    """True for Gymnasium's vector environments, and for EnvPool's, which only look like them."""
    if isinstance(env, VectorEnv):
        return True
    looks_like = hasattr(env, "single_action_space") and hasattr(env, "num_envs")
    return looks_like and not isinstance(env, gym.Env | type)


def autoreset_mode(env: VectorEnv) -> AutoresetMode:
    """The mode that a vector environment declares; NEXT_STEP with a warning when it declares none."""
    tag = next((env.metadata[key] for key in MODE_KEYS if key in env.metadata), None)
    if isinstance(tag, AutoresetMode):
        return tag
    modes = {mode.value.lower(): mode for mode in AutoresetMode}
    word = str(tag).rsplit(".", 1)[-1].replace("_", "").lower()
    if word in modes:
        return modes[word]
    if tag is not None:
        raise ValueError(
            f"autoreset_mode of {env} is {tag!r}; expected one of {[m.name for m in AutoresetMode]}."
        )
    warnings.warn(
        f"{type(env).__name__} does not say in metadata['autoreset_mode'] how it resets; taken as NEXT_STEP. "
        "Add the entry if it resets otherwise: with a wrong mode the advantages are wrong.",
        stacklevel=2,
    )
    return AutoresetMode.NEXT_STEP


@final
class VectorEnvironments(Environments):
    """B environments inside one gymnasium.vector.VectorEnv.

    ``make(seed)`` gives the environment to use from a reset with this seed on: usually always the same one
    (EnvPool fixes its seeds when it is built). ``make_another(seed)`` builds another one after a fault; None:
    impossible. ``keep``: the caller closes it.
    """

    def __init__(
        self,
        make: Callable[[int], Any],
        name: str,
        policy: FaultPolicy,
        make_another: Callable[[int], Any] | None = None,
        *,
        keep: bool = False,
        int32_actions: bool = False,
        reading: Reading = Reading(),  # noqa: B008 - it cannot be changed
    ) -> None:
        super().__init__(policy)
        self.name = name
        self.spec_id = name
        self._make = make
        self._make_another = make_another
        self._keep = keep
        self._int32 = int32_actions
        self._use(make(0))
        with tasks.without_noise():  # EnvPool makes its spaces when they are asked for
            seen, actions = self._env.single_observation_space, self._env.single_action_space
        self.observation_layout = observation_layout(seen, reading.encoder, reading.keys)
        self.action_layout = action_layout(actions, reading.action_bounds)
        self.gives_state = states.gives_state(self._env)
        self.row_groups = (slice(0, self.num_envs),)  # they are stepped together
        self._episode = 0  # of which the seed was that of the last reset
        self._resets_rows = tasks.resets_rows_with_seeds(self._env)
        self._origins = np.zeros((self.num_envs, 3), np.int64)  # as in StepBuffers; of seeded rows
        self._waiting = np.full(self.num_envs, -1)  # the count of steps at which a row begins; -1: it has
        self._count = 0  # steps since the last reset by the caller
        self._restarts_here = 0  # since then
        self._calls = 0  # of the environment, that have begun
        self._in_call = False
        self._watchdog: Watchdog | None = None
        if policy.timeout is not None:
            self._watchdog = Watchdog(self.call_number, policy.timeout, f"The vector environment {name}")

    def _use(self, env: Any) -> None:
        self._env = env
        self.num_envs = int(env.num_envs)
        self.mode = autoreset_mode(env)

    def call_number(self) -> int | None:
        """A number that changes with every call; None between calls."""
        return self._calls if self._in_call else None

    def _reset(self, starts: Sequence[Start] | None) -> tuple[Inputs, np.ndarray | None]:
        if self._watchdog is not None:
            self._watchdog.start()
        starts = [Start()] * self.num_envs if starts is None else starts
        self._episode = starts[0].episode
        waits = np.array([start.wait for start in starts])
        self._origins[:] = np.column_stack([[start.episode for start in starts], 0 * waits, waits])
        self._waiting[:] = np.where(waits > 0, waits, -1)
        self._count = 0
        self._restarts_here = 0
        try:
            return self._reset_env(self.seed_of(0))
        except RAISED as error:
            return self._restart(error)

    def _reset_env(self, seed: int) -> tuple[Inputs, np.ndarray | None]:
        self._calls += 1
        self._in_call = True
        try:
            env = self._make(seed)
            if env is not self._env:
                self._close_env()
                self._use(env)
            self._ended = np.zeros(self.num_envs, bool)
            self._any_ended = False
            with warnings.catch_warnings():
                # it was built with the seed
                warnings.filterwarnings("ignore", message="EnvPool seeds are fixed")
                result = env.reset(
                    seed=self._row_seeds(np.ones(self.num_envs, bool)) if self.replays else seed
                )
            if not (isinstance(result, tuple) and len(result) == 2):
                raise ApiBreak(f"reset returned {kind_of(result)}, expected the pair (observations, infos)")
            observations, infos = result
            self._mask_source = find_source(
                env, infos, self.observation_layout.has_mask, self.action_layout.num_logits
            )
            inputs = self._encode(observations)
            masks = self._masks(observations, infos, None)
            self._check_finite(inputs, "observation")
        finally:
            self._in_call = False
        return inputs, masks

    def send(self, rows: slice, actions: np.ndarray) -> None:
        """See Environments."""
        self._actions = actions

    def receive(self) -> Step:
        """Step all rows with the actions sent; after a fault all episodes are cut."""
        self._calls += 1
        self._in_call = True
        self._count += 1
        try:
            step = self._step()
            if self.policy.restart:
                check_finite("reward", step.rewards)
                self._check_finite(step.inputs, "observation")
                self._check_finite(step.final_inputs or {}, "final observation")
            return step
        except RAISED as error:
            self._in_call = False
            inputs, masks = self._restart(error)
            rewards = np.zeros(self.num_envs)
            no_end = np.zeros(self.num_envs, bool)
            return Step(inputs, masks, rewards, no_end, no_end.copy(), cut=~no_end, origins=self.origins())
        finally:
            self._in_call = False

    def _check_finite(self, inputs: Inputs, what: str) -> None:
        for numbers in float_parts(inputs) if self.policy.restart else ():
            check_finite(what, numbers)

    def _step(self) -> Step:
        actions = self.action_layout.to_env(self._actions)
        result = self._env.step(_to_int32(actions) if self._int32 else actions)
        if not isinstance(result, tuple) or len(result) != 5:
            raise ApiBreak(
                f"step returned {kind_of(result)}, expected five values: observations, rewards, "
                "terminations, truncations, infos"
            )
        observations, rewards, terminated, truncated, infos = result
        rewards, terminated, truncated = self._check(rewards, terminated, truncated)
        inputs = self._encode(observations)
        success = None
        if "final_info" in infos or SUCCESS_KEY in infos:
            success = vector_success(infos, (terminated | truncated) & ~self._ended)
        if self.mode == AutoresetMode.NEXT_STEP:
            phantom = self._ended if self._any_ended else None
            if phantom is not None:
                rewards = np.where(phantom, 0.0, rewards)
                terminated = terminated > phantom
                truncated = truncated > phantom
            self._ended = terminated | truncated
            self._any_ended = _any(self._ended)
            masks = self._masks(observations, infos, self._ended)
            return Step(inputs, masks, rewards, terminated, truncated, phantom=phantom, success=success)
        if self.mode == AutoresetMode.SAME_STEP:
            rows = np.flatnonzero(truncated) if _any(truncated) else None
            finals = None if rows is None else self._final_inputs(infos, rows)
            masks = self._masks(observations, infos, None)
            step = Step(inputs, masks, rewards, terminated, truncated, None, rows, finals, success=success)
            return self._seed_rows(step) if self.replays else step
        masks = self._masks(observations, infos, terminated | truncated)
        return self._reset_ended(Step(inputs, masks, rewards, terminated, truncated, success=success))

    # ------------------------------------------------------------------------------------------ seeds of rows

    @property
    def repeatable(self) -> bool:  # type: ignore[override]
        """See Environments."""
        return self._resets_rows and self.mode == AutoresetMode.SAME_STEP

    def origins(self) -> np.ndarray | None:
        """See Environments."""
        if not self.replays:
            return None
        return np.column_stack([self._origins[:, :2], self._count - self._origins[:, 2]])

    def renew(self, row: int, wait: int) -> tuple[Inputs, np.ndarray | None]:
        """See Environments."""
        self._origins[row] = (self._origins[row, :2].sum() + 1, 0, self._count + wait)
        self._waiting[row] = self._count + wait if wait else -1
        return self._reset_rows(np.arange(self.num_envs) == row), None

    def _seed_rows(self, step: Step) -> Step:
        """Reset with seeds the rows whose next episode is to have one, and those that waited until now."""
        waits = self._waiting >= 0
        step = step._replace(terminated=step.terminated & ~waits, truncated=step.truncated & ~waits)
        ended, begins = step.terminated | step.truncated, self._waiting == self._count
        due = np.zeros_like(ended)
        for row in np.flatnonzero(ended):
            due[row] = self.seeding.due(self._count - int(self._origins[row, 2]))
            self._origins[row, 1] += 1
        self._origins[due, 0] = self._origins[due, :2].sum(axis=1)
        self._origins[due, 1:] = (0, self._count)
        self._waiting[begins] = -1
        if ended.any():
            step = step._replace(origins=self.origins())
        return step._replace(inputs=self._reset_rows(due | begins)) if (due | begins).any() else step

    def _reset_rows(self, rows: np.ndarray) -> Inputs:
        observations, _ = self._env.reset(seed=self._row_seeds(rows), options={"reset_mask": rows})
        return self._encode(observations)

    def _row_seeds(self, rows: np.ndarray) -> np.ndarray:
        return np.array([self.seed_of(row) for row in np.flatnonzero(rows).tolist()])

    def _check(
        self, rewards: Any, terminated: Any, truncated: Any
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rewards and flags as arrays [B]; where both flags are set, terminated wins."""
        arrays = (rewards, terminated, truncated)
        if all(type(x) is np.ndarray and x.shape == (self.num_envs,) for x in arrays) and (
            rewards.dtype.kind == "f" and terminated.dtype == truncated.dtype == bool
        ):
            return rewards, terminated, truncated > terminated  # "greater" of flags is "and not", in one pass
        rewards, terminated, truncated = (np.asarray(x) for x in arrays)
        if rewards.dtype.kind not in "biuf" or not (_are_flags(terminated) and _are_flags(truncated)):
            raise ApiBreak(
                f"rewards are {str(rewards)[:60]}, terminations {str(terminated)[:60]}, truncations "
                f"{str(truncated)[:60]}; expected numbers and two arrays of True and False"
            )
        rewards, terminated, truncated = (
            rewards.astype(float),
            terminated.astype(bool),
            truncated.astype(bool),
        )
        if not rewards.shape == terminated.shape == truncated.shape == (self.num_envs,):
            raise ApiBreak(
                f"rewards, terminations and truncations have shapes {rewards.shape}, {terminated.shape} and "
                f"{truncated.shape}; expected ({self.num_envs},) each"
            )
        truncated &= ~terminated
        return rewards, terminated, truncated

    def _encode(self, observations: object) -> Inputs:
        try:
            inputs = self.observation_layout.encode(observations, batched=True)
        except ValueError as error:
            raise ApiBreak(str(error)) from error
        if any(len(array) != self.num_envs for array in inputs.values()):
            raise ApiBreak(f"the observations hold {kind_of(observations)}, expected {self.num_envs} rows")
        if self.observation_layout.plain and inputs["flat"] is observations:
            # a vector environment may write into its own array again
            inputs = {"flat": inputs["flat"].copy()}
        return inputs

    def _reset_ended(self, step: Step) -> Step:
        """In mode DISABLED: reset the rows that ended."""
        ended = step.terminated | step.truncated
        if not ended.any():
            return step
        if step.truncated.any():
            rows = np.flatnonzero(step.truncated)
            finals = {name: array[rows] for name, array in step.inputs.items()}
            step = step._replace(final_rows=rows, final_inputs=finals)
        observations, infos = self._env.reset(options={"reset_mask": ended.copy()})
        inputs = self._encode(observations)
        for name, array in inputs.items():
            changed = ~ended & ~_same_rows(array, step.inputs[name])
            if changed.any():
                raise ApiBreak(
                    f"reset with a reset_mask also changed environments {np.flatnonzero(changed).tolist()}, "
                    "which had not ended. Use autoreset mode SAME_STEP or NEXT_STEP with this vector "
                    "environment"
                )
        fresh = self._masks(observations, infos, ~ended)
        if step.action_mask is not None and fresh is not None:
            step.action_mask[ended] = fresh[ended]
        return step._replace(inputs=inputs)

    def _final_inputs(self, infos: Mapping[str, object], rows: np.ndarray) -> Inputs:
        """The true last observations of ``rows``: one per row in an object array, or a dense batch."""
        finals = infos.get("final_obs", infos.get("final_observation"))
        present = infos.get("_final_obs", infos.get("_final_observation", np.ones(self.num_envs, bool)))
        if finals is None or not np.asarray(present)[rows].all():
            raise ApiBreak(
                f"environments {rows.tolist()} were truncated in SAME_STEP mode but infos['final_obs'] is "
                "missing; without it a truncation cannot be bootstrapped"
            )
        try:
            if isinstance(finals, np.ndarray) and finals.dtype == object:
                parts = [self.observation_layout.encode(finals[row], batched=False) for row in rows]
                return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
            whole = self.observation_layout.encode(finals, batched=True)
        except ValueError as error:
            raise ApiBreak(f"infos['final_obs']: {error}") from error
        return {name: array[rows] for name, array in whole.items()}

    def _masks(self, observations: Any, infos: dict[str, Any], idle: np.ndarray | None) -> np.ndarray | None:
        """The masks [B, L]; ``idle`` rows, whose next action is not used, allow all. ApiBreak: masks are
        missing, have another shape, or allow no choice.
        """
        source, actions = self._mask_source, self.action_layout
        if source.kind == "none":
            return None
        needed = np.ones(self.num_envs, bool) if idle is None else ~idle
        masks = np.ones((self.num_envs, actions.num_logits), bool)
        if not needed.any():
            return masks
        raw = source.read(observations, infos)
        told = infos.get(f"_{MASK_KEY}") if source.kind == "info" else None  # which rows have one
        if told is not None and not np.asarray(told)[needed].all():
            raise ApiBreak(MISSING)
        if told is not None and isinstance(raw, np.ndarray) and raw.dtype == object:
            for row in np.flatnonzero(told):
                masks[row] = actions.flatten_mask(given(raw[row], MASK_KEY), 1)
        else:
            flat = actions.flatten_mask(raw, self.num_envs)
            assert flat is not None
            masks = flat
        masks[~needed] = True
        if len(blocked := actions.blocked_rows(masks)):
            raise ApiBreak(NOTHING_ALLOWED, int(blocked[0]))
        return masks

    # ------------------------------------------------------------------------------------------------ faults

    def _restart(self, error: BaseException) -> tuple[Inputs, np.ndarray | None]:
        """Build another vector environment and reset it, as often as the policy allows; else raise."""
        fault = self._fault(error)
        make = self._make_another
        if not self.policy.restart or make is None:
            raise fault from error

        def attempt() -> tuple[Inputs, np.ndarray | None]:
            self._restarts_here += 1
            self._episode += 1
            self._origins[:] = np.column_stack(
                [self._origins[:, :2].sum(axis=1) + 1, np.full((self.num_envs, 2), [0, self._count])]
            )
            wait_before_restart(self._restarts_here, self.policy)
            with contextlib.suppress(EnvironmentFault):
                self._close_env()
            seed = self.seed_of(0)
            fresh = make(seed)
            self._make = lambda seed: fresh
            self._use(fresh)
            return self._reset_env(seed)

        return self._restarts.until_it_works(fault, attempt, self._fault)

    def _fault(self, error: BaseException) -> EnvironmentFault:
        index = error.index if isinstance(error, ApiBreak) else -1
        row = f"environment {index} of " if index >= 0 else "the vector environment "
        advice = ""
        if self.policy.restart and self._make_another is None:
            advice = ". It was given as an object, which cannot be restarted: give an id or a factory"
        return explained(
            error,
            f"{row}{self.name}",
            index,
            self._count,
            env_id=self.name,
            worker=0,
            seed=self.seed_of(0),
            action=action_text(self._given(index)) if self._count else None,
            advice=advice,
        )

    def _given(self, index: int) -> Any:
        """The last actions of all rows, or of one, as the environment got them."""
        layout = self.action_layout
        return layout.to_env(self._actions) if index < 0 else layout.to_env_single(self._actions[index])

    def seed_of(self, row: int) -> int:
        """The seed of a row; the one of all rows where they are seeded as a whole."""
        if self.replays:
            return self.seeding.seed(row, int(self._origins[row, 0]))
        return self.seeding.seed(0, self._episode)

    # ------------------------------------------------------------------------------------------------- state

    def get_state(self) -> Any:
        """See Environments."""
        return {"env": states.saved_state(self._env), "ended": self._ended.tolist(), "episode": self._episode}

    def set_state(self, state: Any) -> None:
        """See Environments."""
        states.restore_state(self._env, state["env"])
        self._ended = np.array(state["ended"], bool).reshape(self._ended.shape)
        self._episode = int(state["episode"])
        self._any_ended = _any(self._ended)

    def close(self) -> None:
        """See Environments; the caller's own environment stays open."""
        if self._watchdog is not None:
            self._watchdog.stop()
        self._close_env()

    def _close_env(self) -> None:
        env, self._env = self._env, None
        if env is not None and not self._keep:
            close_environment(env, -1, functools.partial(limited, timeout=self.policy.timeout))


def _are_flags(array: np.ndarray) -> bool:
    return array.dtype == bool or (array.dtype.kind in "iuf" and bool(np.isin(array, (0, 1)).all()))


def _any(flags: np.ndarray) -> bool:
    """flags.any() for a few flags, ten times as fast: it is called at every step."""
    return b"\x01" in flags.tobytes()


def _same_rows(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """bool [N]: rows that are equal, NaN counting as equal to NaN."""
    equal = (a == b) | ((a != a) & (b != b))
    return equal.reshape(len(a), -1).all(axis=1)


def _to_int32(actions: Any) -> Any:
    """The same structure with its integer arrays as int32, the only width that EnvPool takes."""
    if isinstance(actions, dict):
        return {key: _to_int32(value) for key, value in actions.items()}
    if isinstance(actions, tuple):
        return tuple(_to_int32(value) for value in actions)
    return actions.astype(np.int32) if actions.dtype.kind in "iub" else actions
