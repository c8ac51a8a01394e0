"""Rollouts: step the environments with the policy, and turn what came back into a Batch to learn from.

Memory is environment-major, [B, T, ...], allocated once and filled in place.
"""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np
import torch

from tightrope.algorithms.batch import Batch
from tightrope.algorithms.settings import ReinforceSettings, UpdateSettings
from tightrope.control import states
from tightrope.control.environments import Environments
from tightrope.control.normalise import Normalisers

Array = np.ndarray


def reset_seed(seed: int, step: int) -> int:
    """The seed of a reset at an agent step; copy i of single environments adds i. At 0 the run's own."""
    if step == 0:
        return seed
    return int(np.random.SeedSequence([seed, step]).generate_state(1)[0]) >> 2  # with i it fits 31 bits


class BadNumbers(ValueError):
    """An environment returned a NaN or an infinity; nothing was learned from it."""


class Rollout:
    """What happened in T steps of B environments. ``mask`` False: NEXT_STEP's reset row, not a transition.

    ``inputs``: what the policy saw (normalised), ``raw``: flat observations as they came, ``rewards``: as
    they came. ``last``: encoded observation after the last step; ``finals``: (column, rows, encoded true
    final observations) of truncated episodes whose next row already belongs to a new episode.
    """

    def __init__(self, environments: Environments, num_steps: int, *, keep_raw: bool) -> None:
        rows, layout, actions = (
            environments.num_envs,
            environments.observation_layout,
            environments.action_layout,
        )
        shape = (rows, num_steps)
        self.inputs: dict[str, Array] = {}
        if layout.size:
            self.inputs["flat"] = np.zeros((*shape, layout.size), np.float32)
        for i, image in enumerate(layout.image_shapes):
            self.inputs[f"image{i}"] = np.zeros((*shape, *image), np.uint8)
        self.raw = (
            np.zeros_like(self.inputs["flat"]) if keep_raw else self.inputs.get("flat", np.zeros((*shape, 0)))
        )
        self.actions = np.zeros((*shape, actions.num_columns), np.float32)
        self.logp = np.zeros(shape, np.float32)
        self.rewards = np.zeros(shape, np.float64)
        self.terminated, self.truncated = np.zeros(shape, bool), np.zeros(shape, bool)
        self.mask = np.ones(shape, bool)
        self.ended = np.zeros(shape, bool)
        self.last: dict[str, Array] = {}
        self.finals: list[tuple[int, Array, dict[str, Array]]] = []
        self.episodes: list[tuple[float, int, bool]] = []
        self.reward_statistics_taken = False
        self.env_seconds = 0.0

    @property
    def steps(self) -> int:
        """How many transitions there are."""
        return int(self.mask.sum())


class Collector:
    """Fills rollouts; carries observations, and the return and length of running episodes, from one to the
    next.
    """

    def __init__(
        self, environments: Environments, normalisers: Normalisers, rng: np.random.Generator
    ) -> None:
        self.environments, self.normalisers, self.rng = environments, normalisers, rng
        self._rollout: Rollout | None = None
        self._uniform = np.concatenate(
            [np.full(c.width, c.kind != "gaussian") for c in environments.action_layout.components]
        )
        self._step_count = 0

    def reset(self, seed: int, step: int = 0) -> None:
        """Begin all episodes anew at an agent step, with seeds of (seed, step) alone; those that were running
        are cut: their last step was bootstrapped, and they are not counted.
        """
        self._inputs, self._action_mask = self.environments.reset(reset_seed(seed, step))
        self._returns = np.zeros(self.environments.num_envs)
        self._lengths = np.zeros(self.environments.num_envs, np.int64)
        if self.normalisers.rewards is not None:
            self.normalisers.rewards.restart(self.environments.num_envs)

    def state(self) -> dict[str, Any] | None:
        """The running episodes, as JSON can hold them; None when the environments cannot give their state."""
        if not self.environments.gives_state:
            return None
        names = ("_inputs", "_action_mask", "_returns", "_lengths")
        own = {name: states.pack(getattr(self, name)) for name in names}
        return {**own, "environments": self.environments.get_state()}

    def restore(self, seed: int, step: int, state: dict[str, Any]) -> None:
        """Go on with the episodes of a `state`."""
        self.environments.reset(reset_seed(seed, step))
        self.environments.set_state(state["environments"])
        for name in ("_inputs", "_action_mask", "_returns", "_lengths"):
            setattr(self, name, states.unpack(state[name]))

    def noise(self, num_steps: int, rows: int, rng: np.random.Generator) -> Array:
        """[T, rows, A] float32: uniforms for categories and bits, standard normals for Gaussian columns."""
        shape = (num_steps, rows, len(self._uniform))
        if self._uniform.all():
            return rng.random(shape, dtype=np.float32)
        noise = rng.standard_normal(shape, dtype=np.float32)
        if self._uniform.any():
            noise[..., self._uniform] = rng.random(
                (num_steps, rows, int(self._uniform.sum())), dtype=np.float32
            )
        return noise

    def collect(self, engine: Any, num_steps: int) -> Rollout:
        """Step all environments ``num_steps`` times with the engine's policy; the memory is reused by the
        next call.
        """
        keep_raw = self.normalisers.observations is not None
        rollout = self._rollout
        if rollout is None or rollout.logp.shape[1] != num_steps:
            rollout = self._rollout = Rollout(self.environments, num_steps, keep_raw=keep_raw)
            if self._action_mask is not None:
                shape = (*rollout.logp.shape, self._action_mask.shape[1])
                rollout.inputs["action_mask"] = np.ones(shape, bool)
        rollout.mask.fill(True)
        rollout.finals, rollout.reward_statistics_taken = [], False
        noise = self.noise(num_steps, self.environments.num_envs, self.rng)
        engine.begin_rollout(self.environments.num_envs, self.rng)
        waves = self.environments.waves
        inputs, action_mask, t, env_seconds = self._inputs, self._action_mask, 0, 0.0
        try:
            for t in range(num_steps):
                if action_mask is not None:
                    rollout.inputs["action_mask"][:, t] = action_mask
                if keep_raw:
                    rollout.raw[:, t] = inputs["flat"]
                for rows in waves:
                    engine.act(inputs, self.normalisers.observations, action_mask, noise[t], rollout, rows, t)
                    self.environments.begin(rows, rollout.actions[rows, t])
                before = perf_counter()
                step = self.environments.finish()
                env_seconds += perf_counter() - before
                inputs, action_mask = step.inputs, step.action_mask
                rollout.rewards[:, t] = step.rewards
                rollout.terminated[:, t] = step.terminated
                rollout.truncated[:, t] = step.truncated
                if step.phantom is not None:
                    np.logical_not(step.phantom, out=rollout.mask[:, t])
                if step.final_rows is not None and step.final_inputs is not None:
                    rollout.finals.append((t, step.final_rows, step.final_inputs))
        except Exception:
            self._check_numbers(
                rollout, t + 1
            )  # a NaN observation is the likelier cause of what failed after it
            raise
        self._inputs, self._action_mask, rollout.env_seconds = inputs, action_mask, env_seconds
        self._check_numbers(rollout, num_steps)
        rollout.last = self.normalisers.encode(inputs)
        rollout.finals = [(t, rows, self.normalisers.encode(x)) for t, rows, x in rollout.finals]
        np.logical_or(rollout.terminated, rollout.truncated, out=rollout.ended)
        rollout.episodes = self._count_episodes(rollout)
        self._step_count += num_steps
        return rollout

    def _check_numbers(self, rollout: Rollout, num_steps: int) -> None:
        """Raise BadNumbers naming environment, step and index of the first NaN or infinity, if there is
        one.
        """
        rows, start = np.arange(len(rollout.logp)), self._step_count
        checks = [("observation", rollout.raw[:, :num_steps], rows, start)]
        checks += [("reward", rollout.rewards[:, :num_steps, None], rows, start)]
        if "flat" in self._inputs:
            checks.append(("observation", self._inputs["flat"][:, None], rows, start + num_steps))
        for t, final_rows, x in rollout.finals:
            if "flat" in x:
                checks.append(("final observation", x["flat"][:, None], final_rows, start + t + 1))
        for what, numbers, which, first in checks:
            good = np.isfinite(numbers)
            if good.all():
                continue
            row, t, index = np.argwhere(~good)[0]
            where = f"step {first + t}" + ("" if what == "reward" else f", index {index}")
            raise BadNumbers(
                f"Environment {which[row]} of {self.environments.spec_id} returned "
                f"{what} = {numbers[row, t, index]} at {where}; expected finite "
                "numbers. The policy was not updated with it. Mend the environment, or clip and check its "
                "state there."
            )

    def _count_episodes(self, rollout: Rollout) -> list[tuple[float, int, bool]]:
        """(return, length, terminated) of every episode that ended in the rollout, in order of its column."""
        running = np.cumsum(np.where(rollout.mask, rollout.rewards, 0.0), axis=1) + self._returns[:, None]
        lengths = np.cumsum(rollout.mask, axis=1) + self._lengths[:, None]
        found = []
        self._returns, self._lengths = running[:, -1].copy(), lengths[:, -1].copy()
        for row in np.flatnonzero(rollout.ended.any(axis=1)):
            ends = np.flatnonzero(rollout.ended[row])
            totals, counts = running[row, ends], lengths[row, ends]
            for k, t in enumerate(ends):
                before = (totals[k - 1], counts[k - 1]) if k else (0.0, 0)
                flag = bool(rollout.terminated[row, t])
                found.append((int(t), float(totals[k] - before[0]), int(counts[k] - before[1]), flag))
            self._returns[row] -= totals[-1]
            self._lengths[row] -= counts[-1]
        return [episode[1:] for episode in sorted(found, key=lambda episode: episode[0])]


def next_values(values: Array, rollout: Rollout, engine: Any) -> Array:
    """V of the true next observation of every step [B, T]: also at a truncation and at the end of the
    rollout.
    """
    following = np.empty_like(values)
    following[:, :-1] = values[:, 1:]
    following[:, -1] = engine.values(rollout.last)
    if rollout.finals:
        names = rollout.finals[0][2]
        finals = engine.values({n: np.concatenate([x[n] for _, _, x in rollout.finals]) for n in names})
        columns = np.concatenate([np.full(len(rows), t) for t, rows, _ in rollout.finals])
        following[np.concatenate([rows for _, rows, _ in rollout.finals]), columns] = finals
    return following


def to_batch(rollout: Rollout, engine: Any, normalisers: Normalisers, settings: UpdateSettings) -> Batch:
    """Values, advantages and returns of a rollout, as the Batch [B, T] that the update rules take."""
    if normalisers.rewards is None:
        rewards = rollout.rewards.astype(np.float32)
    else:
        if (
            float(normalisers.rewards.moments.count) == 0
        ):  # nothing to scale the very first rollout by but itself
            normalisers.rewards.update(rollout.rewards, rollout.ended, rollout.mask)
            rollout.reward_statistics_taken = True
        rewards = normalisers.rewards(rollout.rewards)
    flat = {name: x.reshape(-1, *x.shape[2:]) for name, x in rollout.inputs.items()}
    values = engine.values(flat).reshape(rollout.logp.shape)
    following, mask = next_values(values, rollout, engine), rollout.mask
    if isinstance(settings, ReinforceSettings) and not settings.baseline:
        mask = mask & finished(rollout.ended)
        values, following = np.zeros_like(values), np.zeros_like(values)
    ends = (rollout.terminated, rollout.ended, mask)
    advantages = engine.gae(rewards, values, following, *ends, settings.gamma, settings.gae_lambda)
    numbers = {
        "actions": rollout.actions,
        "old_logp": rollout.logp,
        "old_values": values,
        "advantages": advantages,
        "returns": advantages + values,
        "mask": mask,
    }
    tensors = {name: torch.from_numpy(x).to(engine.device) for name, x in numbers.items()}
    inputs = {name: torch.from_numpy(x).to(engine.device) for name, x in rollout.inputs.items()}
    return Batch(inputs=inputs, **tensors)


def finished(ended: Array) -> Array:
    """True [B, T] for steps whose episode ends inside the rollout: some end at or after them."""
    return np.logical_or.accumulate(ended[:, ::-1], axis=1)[:, ::-1]
