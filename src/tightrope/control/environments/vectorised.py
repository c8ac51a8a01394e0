"""Gymnasium's vector environments, in all three of their reset modes, made to speak in ``Step``.

SAME_STEP: the row holds the next episode's first observation, the true last one is in info["final_obs"].
NEXT_STEP: the row holds the true last observation; the next step ignores its action and only resets (a
phantom row). DISABLED: we reset the rows that ended ourselves, with options={"reset_mask": ...}.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from tightrope.control.environments import state as states
from tightrope.control.environments.faults import EnvironmentFault, describe
from tightrope.control.environments.step import Step
from tightrope.control.spaces import (
    MASK_KEY,
    ActionLayout,
    Inputs,
    ObservationLayout,
    action_layout,
    observation_layout,
)

MODE_KEYS = (
    "autoreset_mode",
    "autoreseet-mode",
)  # the second is a slip in some of Gymnasium's own environments


def autoreset_mode(env: Any) -> AutoresetMode:
    """The mode a vector environment declares, as enum or string; NEXT_STEP with a warning when it
    declares none.
    """
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
        "Add the entry if it resets otherwise: a wrong mode spoils the advantages.",
        stacklevel=2,
    )
    return AutoresetMode.NEXT_STEP


class VectorCopies:
    """B copies inside one gymnasium.vector.VectorEnv.

    ``make(seed)`` gives the environment to use from a reset with this seed on: usually always the same one
    (EnvPool fixes its seeds when it is built). ``keep`` leaves closing to the caller.
    """

    def __init__(
        self, make: Callable[[int], Any], name: str, *, keep: bool = False, int32_actions: bool = False
    ) -> None:
        self.name = name
        self._make, self._keep, self._int32 = make, keep, int32_actions
        self._use(make(0))
        self.observation_layout: ObservationLayout = observation_layout(self._env.single_observation_space)
        self.action_layout: ActionLayout = action_layout(self._env.single_action_space)
        self._count = 0

    def _use(self, env: Any) -> None:
        self._env = env
        self.num_envs = int(env.num_envs)
        self.mode = autoreset_mode(env)

    def reset(self, seed: int) -> tuple[Inputs, np.ndarray | None]:
        """Reset all rows, seeded; the first inputs and action masks."""
        env = self._make(seed)
        if env is not self._env:
            self.close()
            self._use(env)
        self._count = 0
        self._ended, self._any_ended = np.zeros(self.num_envs, bool), False
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="EnvPool seeds are fixed")  # the seed was given to make
            result = env.reset(seed=seed)
        if not (isinstance(result, tuple) and len(result) == 2):
            raise self._fault(f"reset returned {describe(result)}, expected the pair (observations, infos)")
        observations, infos = result
        self._mask_source = self._find_mask(infos)
        inputs = self._encode(observations)
        self._inputs = inputs
        return inputs, self._masks(observations, infos, None)

    @property
    def waves(self) -> tuple[slice, ...]:
        """All rows at once: a vector environment steps them together."""
        return (slice(0, self.num_envs),)

    def begin(self, rows: slice, actions: np.ndarray) -> None:
        """Take the action matrix [B, A]."""
        self._actions = actions

    def finish(self) -> Step:
        """Step all rows with the actions taken."""
        self._count += 1
        actions = self._actions
        env_actions = self.action_layout.to_env(actions)
        result = self._env.step(_to_int32(env_actions) if self._int32 else env_actions)
        if not isinstance(result, tuple) or len(result) != 5:
            raise self._fault(
                f"step returned {describe(result)}, expected five values: observations, rewards, "
                "terminations, truncations, infos"
            )
        observations, rewards, terminated, truncated, infos = result
        rewards, terminated, truncated = self._check(rewards, terminated, truncated)
        inputs = self._encode(observations)
        if self.mode == AutoresetMode.NEXT_STEP:
            step = self._next_step(observations, inputs, rewards, terminated, truncated, infos)
        elif self.mode == AutoresetMode.SAME_STEP:
            step = self._same_step(observations, inputs, rewards, terminated, truncated, infos)
        else:
            step = self._disabled(observations, inputs, rewards, terminated, truncated, infos)
        return step

    def _check(
        self, rewards: Any, terminated: Any, truncated: Any
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rewards and flags as arrays; where both flags are set, terminated wins."""
        arrays = (rewards, terminated, truncated)
        if all(type(x) is np.ndarray and x.shape == (self.num_envs,) for x in arrays) and (
            rewards.dtype.kind == "f" and terminated.dtype == truncated.dtype == bool
        ):
            return rewards, terminated, truncated > terminated  # "greater" of flags is "and not", in one pass
        try:
            rewards = np.array(rewards, np.float64)
            terminated, truncated = np.array(terminated, bool), np.array(truncated, bool)
        except (TypeError, ValueError) as error:
            raise self._fault(f"rewards or flags are not arrays of numbers: {error}") from error
        if not rewards.shape == terminated.shape == truncated.shape == (self.num_envs,):
            raise self._fault(
                f"rewards, terminations and truncations have shapes {rewards.shape}, {terminated.shape} and "
                f"{truncated.shape}; expected ({self.num_envs},) each"
            )
        truncated &= ~terminated
        return rewards, terminated, truncated

    def _encode(self, observations: Any) -> Inputs:
        try:
            inputs = self.observation_layout.encode(observations, batched=True)
        except ValueError as error:
            raise self._fault(str(error)) from error
        if any(len(array) != self.num_envs for array in inputs.values()):
            raise self._fault(
                f"the observations hold {describe(observations)}, expected {self.num_envs} rows"
            )
        if self.observation_layout.plain and inputs["flat"] is observations:
            # a vector environment may write into its own array again
            inputs = {"flat": inputs["flat"].copy()}
        return inputs

    def _next_step(
        self, observations: Any, inputs: Inputs, rewards: Any, terminated: Any, truncated: Any, infos: Any
    ) -> Step:
        phantom = self._ended if self._any_ended else None
        if phantom is not None:
            rewards = np.where(phantom, 0.0, rewards)
            terminated, truncated = terminated > phantom, truncated > phantom
        self._ended = terminated | truncated
        self._any_ended = _any(self._ended)
        masks = self._masks(observations, infos, self._ended)
        return Step(inputs, masks, rewards, terminated, truncated, phantom, None, None)

    def _same_step(
        self, observations: Any, inputs: Inputs, rewards: Any, terminated: Any, truncated: Any, infos: Any
    ) -> Step:
        rows, finals = None, None
        if _any(truncated):
            rows = np.flatnonzero(truncated)
            finals = self._final_inputs(infos, rows)
        masks = self._masks(observations, infos, None)
        return Step(inputs, masks, rewards, terminated, truncated, None, rows, finals)

    def _disabled(
        self, observations: Any, inputs: Inputs, rewards: Any, terminated: Any, truncated: Any, infos: Any
    ) -> Step:
        ended = terminated | truncated
        masks = self._masks(observations, infos, ended)
        if not ended.any():
            return Step(inputs, masks, rewards, terminated, truncated, None, None, None)
        rows = np.flatnonzero(truncated) if truncated.any() else None
        finals = None if rows is None else {name: array[rows] for name, array in inputs.items()}
        observations, infos = self._env.reset(options={"reset_mask": ended.copy()})
        fresh = self._encode(observations)
        for name, array in fresh.items():
            changed = ~ended & ~_same_rows(array, inputs[name])
            if changed.any():
                raise self._fault(
                    f"reset with a reset_mask also changed environments {np.flatnonzero(changed).tolist()}, "
                    "which had "
                    "not ended. Use autoreset mode SAME_STEP or NEXT_STEP with this vector environment"
                )
        if masks is not None:
            fresh_masks = self._masks(observations, infos, ~ended)
            assert fresh_masks is not None
            masks[ended] = fresh_masks[ended]
        return Step(fresh, masks, rewards, terminated, truncated, None, rows, finals)

    def _final_inputs(self, infos: dict[str, Any], rows: np.ndarray) -> Inputs:
        """The true last observations of ``rows``: one per row in an object array, or a dense batch."""
        finals = infos.get("final_obs", infos.get("final_observation"))
        present = infos.get("_final_obs", infos.get("_final_observation", np.ones(self.num_envs, bool)))
        if finals is None or not np.asarray(present)[rows].all():
            raise self._fault(
                f"environments {rows.tolist()} were truncated in SAME_STEP mode but infos['final_obs'] is "
                "missing; "
                "without it a truncation cannot be bootstrapped"
            )
        try:
            if isinstance(finals, np.ndarray) and finals.dtype == object:
                parts = [self.observation_layout.encode(finals[row], batched=False) for row in rows]
                return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
            whole = self.observation_layout.encode(finals, batched=True)
        except ValueError as error:
            raise self._fault(f"infos['final_obs']: {error}") from error
        return {name: array[rows] for name, array in whole.items()}

    def _find_mask(self, infos: dict[str, Any]) -> str:
        if not self.action_layout.num_logits:
            return "none"
        if MASK_KEY in infos:
            return "info"
        if callable(getattr(self._env.unwrapped, "action_masks", None)):
            return "method"
        if self._copies_have_masks():
            return "call"
        return "observation" if self.observation_layout.has_mask else "none"

    def _copies_have_masks(self) -> bool:
        """Whether the single environments inside Gymnasium's vector environments have ``action_masks``."""
        env = self._env.unwrapped
        copies = getattr(env, "envs", None)
        if copies:
            return callable(getattr(copies[0].unwrapped, "action_masks", None))
        makers = getattr(
            env, "env_fns", None
        )  # copies in other processes: asking one that has none breaks it
        if not makers:
            return False
        probe = makers[0]()
        try:
            return callable(getattr(probe.unwrapped, "action_masks", None))
        finally:
            probe.close()

    def _masks(self, observations: Any, infos: dict[str, Any], idle: np.ndarray | None) -> np.ndarray | None:
        """The action masks; rows in ``idle`` (whose next action is not used) allow everything."""
        if self._mask_source == "none":
            return None
        if self._mask_source == "info":
            raw, given = infos.get(MASK_KEY), infos.get("_" + MASK_KEY)
        else:
            env = self._env.unwrapped
            if self._mask_source == "method":
                raw = env.action_masks()
            elif self._mask_source == "call":
                raw = np.stack([np.asarray(mask) for mask in env.call("action_masks")])
            else:
                raw = self.observation_layout.mask_of(observations)
            given = None
        needed = np.ones(self.num_envs, bool) if idle is None else ~idle
        if needed.any() and (raw is None or (given is not None and not np.asarray(given)[needed].all())):
            raise self._fault(
                f"infos[{MASK_KEY!r}] is missing although reset gave one; give it at every step"
            )
        masks = np.ones((self.num_envs, self.action_layout.num_logits), bool)
        if raw is None:
            return masks
        try:
            masks = self._flatten(raw, given)
        except ValueError as error:
            raise self._fault(str(error)) from error
        masks[~needed] = True
        blocked = self.action_layout.blocked_rows(masks)
        if len(blocked):
            raise self._fault("the action mask forbids every choice; allow at least one", int(blocked[0]))
        return masks

    def _flatten(self, raw: Any, given: Any) -> np.ndarray:
        if given is not None and isinstance(raw, np.ndarray) and raw.dtype == object:
            masks = np.ones((self.num_envs, self.action_layout.num_logits), bool)
            for row in np.flatnonzero(given):
                masks[row] = self.action_layout.flatten_mask(raw[row], 1)
            return masks
        flat = self.action_layout.flatten_mask(raw, self.num_envs)
        assert flat is not None
        return flat

    def _fault(self, what: str, index: int = -1) -> EnvironmentFault:
        where = f"environment {index} of {self.name}" if index >= 0 else f"the vector environment {self.name}"
        return EnvironmentFault(f"{where} at step {self._count} cannot be used: {what}.", index, self._count)

    def get_state(self) -> list[Any]:
        """The packed state of the environment, and the rows that its next step resets."""
        return [states.state_of(self._env), self._ended.tolist()]

    def set_state(self, found: list[Any]) -> None:
        """Go on from what `get_state` gave, after a reset."""
        states.put_back(self._env, found[0])
        self._ended = np.array(found[1], bool).reshape(self._ended.shape)
        self._any_ended = _any(self._ended)

    def close(self) -> None:
        """Close the environment unless it is the caller's own; closing twice is fine."""
        if self._env is not None and not self._keep:
            self._env.close()
        self._env = None

    def renew(self, make: Callable[[int], Any], seed: int) -> None:
        """Go on with another environment, made for this seed; what closing the old one raises is ignored."""
        with contextlib.suppress(Exception):
            self.close()
        fresh = make(seed)
        self._make = lambda seed: fresh
        self._use(fresh)


def _any(flags: np.ndarray) -> bool:
    """flags.any() for a handful of flags, ten times as fast: this is asked at every step."""
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
