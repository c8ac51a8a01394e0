"""Collecting rollouts: step the environments with the policy."""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np
from torch import nn

from tightrope.algorithms.nonfinite import NonFiniteError, first_bad
from tightrope.control.engine.base import Acted, Engine
from tightrope.control.environments import state as states
from tightrope.control.environments.base import Environments
from tightrope.control.environments.faults import (
    FLOAT32_MAX,
    action_text,
    circumstances,
    first_unusable,
)
from tightrope.control.policy.normalise import Normalisers
from tightrope.control.rollout.rollout import Rollout
from tightrope.control.spaces.structure import Array, Inputs, float_parts
from tightrope.errors import TightropeError


class BadNumbers(TightropeError, ValueError):
    """An environment returned a NaN or an infinity; nothing was learned from it."""


def reset_seed(seed: int, step: int) -> int:
    """The seed of a reset at an agent step; at step 0 that of the run. Single environment i adds i."""
    if step == 0:
        return seed
    return int(np.random.SeedSequence([seed, step]).generate_state(1)[0]) >> 2  # with i it fits 31 bits


class Collector:
    """Fills rollouts; carries observations and running episodes from one to the next."""

    def __init__(
        self, environments: Environments, normalisers: Normalisers, rng: np.random.Generator
    ) -> None:
        self.environments = environments
        self.normalisers = normalisers
        self.rng = rng
        self._rollout: Rollout | None = None
        self._uniform = ~environments.action_layout.gaussian  # bool [A]: columns of uniform noise
        self._step_count = 0
        self._column = 0  # the step of the rollout that is under way
        self._restarts = 0  # those that earlier rollouts reported

    def reset(self, seed: int, step: int = 0) -> None:
        """Start new episodes at an agent step, with seeds that depend only on (seed, step).

        Those that were running are cut: their last step was bootstrapped, and they are not counted.
        """
        self._inputs, self._action_mask = self.environments.reset(reset_seed(seed, step))
        self._returns = np.zeros(self.environments.num_envs)
        self._lengths = np.zeros(self.environments.num_envs, np.int64)
        if self.normalisers.rewards is not None:
            self.normalisers.rewards.restart(self.environments.num_envs)

    def state(self) -> dict[str, Any] | None:
        """The running episodes as JSON; None when the environments cannot give their state."""
        if not self.environments.gives_state:
            return None
        names = ("_inputs", "_action_mask", "_returns", "_lengths")
        episodes = {name: states.encode(getattr(self, name)) for name in names}
        return {**episodes, "environments": self.environments.get_state()}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue the episodes of a `state`. ValueError for one of other environments."""
        restarts = self.environments.restarts
        self.environments.count_from(0)  # the reset repeats the restarts of the first time
        inputs, action_mask = self.environments.set_state(state["environments"])
        self.environments.count_from(restarts)
        zeros = np.zeros(self.environments.num_envs)
        like = {"_inputs": inputs, "_action_mask": action_mask, "_returns": zeros}
        for name, fresh in {**like, "_lengths": zeros.astype(np.int64)}.items():
            found = states.decode(state[name])
            if not states.alike(found, fresh):  # the compiled engine would read beyond it
                raise ValueError(f"{name.strip('_')} of the episodes have another shape than here")
            setattr(self, name, found)

    def count_from(self, restarts: int) -> None:
        """Start the restart counter here; earlier rows already reported these."""
        self.environments.count_from(restarts)
        self._restarts = restarts

    def drop(self) -> None:
        """Forget the rollout under way: its restarts will be counted when it is collected again."""
        self.environments.count_from(self._restarts)

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

    def collect(self, engine: Engine, num_steps: int, warm_up: int = 0) -> Rollout:
        """Step all environments ``num_steps`` times with the engine's policy.

        ``warm_up``: so many steps go before, for the first statistics of observations; the rollout counts
        them and their episodes, and does not hold them. The next call reuses the arrays of the rollout that
        it returns.
        """
        if not warm_up:
            return self._collect(engine, num_steps)
        before = self._collect(engine, warm_up)
        assert self.normalisers.observations is not None
        self.normalisers.observations.update(before.raw[before.mask])
        rollout = self._collect(engine, num_steps)
        rollout.warm_up = before.steps
        rollout.episodes = before.episodes + rollout.episodes
        rollout.env_seconds += before.env_seconds
        if rollout.restarts is not None:
            rollout.restarts += before.restarts or 0
        return rollout

    def _collect(self, engine: Engine, num_steps: int) -> Rollout:
        rollout = self._cleared(num_steps)
        try:
            inputs = self._fill(rollout, engine)
        except Exception:
            # a NaN observation or a NaN weight is the likelier cause of what failed after it
            self._check(rollout, engine, self._column + 1, self._inputs)
            raise
        self._inputs = inputs
        self._check(rollout, engine, num_steps, inputs)
        rollout.last = self.normalisers.encode(inputs)
        rollout.finals = [(t, rows, self.normalisers.encode(x)) for t, rows, x in rollout.finals]
        rollout.ended |= rollout.terminated | rollout.truncated
        if self.environments.policy.restart:
            rollout.restarts = self.environments.restarts - self._restarts
            self._restarts = self.environments.restarts
        rollout.episodes = self._count_episodes(rollout)
        self._step_count += num_steps
        return rollout

    def _cleared(self, num_steps: int) -> Rollout:
        rollout = self._rollout
        if rollout is None or rollout.logp.shape[1] != num_steps:
            rollout = Rollout(self.environments, num_steps, has_masks=self._action_mask is not None)
            self._rollout = rollout
        rollout.clear()
        return rollout

    def _fill(self, rollout: Rollout, engine: Engine) -> Inputs:
        """Act and step in every column; the observations after the last one."""
        environments, normaliser = self.environments, self.normalisers.observations
        num_steps = rollout.logp.shape[1]
        self._column = 0
        noise = self.noise(num_steps, environments.num_envs, self.rng)
        engine.begin_rollout(environments.num_envs, self.rng)
        inputs, action_mask, env_seconds = self._inputs, self._action_mask, 0.0
        for t in range(num_steps):
            self._column = t
            if "flat" in inputs:
                rollout.raw[:, t] = inputs["flat"]
            for rows in environments.row_groups:
                seen = {name: x[rows, t] for name, x in rollout.inputs.items()}
                out = Acted(seen, rollout.actions[rows, t], rollout.logp[rows, t])
                engine.act(inputs, normaliser, action_mask, noise[t], rows, out)
                environments.send(rows, out.actions)
            before = perf_counter()
            step = environments.receive()
            env_seconds += perf_counter() - before
            inputs, action_mask = step.inputs, step.action_mask
            rollout.rewards[:, t] = step.rewards
            rollout.terminated[:, t] = step.terminated
            rollout.truncated[:, t] = step.truncated
            if step.phantom is not None:
                np.logical_not(step.phantom, out=rollout.mask[:, t])
            if step.success is not None:
                rollout.successes += step.success[~np.isnan(step.success)].tolist()
            if step.cut is not None:
                rollout.mask[step.cut, t] = False
                rollout.ended[step.cut, t] = True
            if step.final_rows is not None and step.final_inputs is not None:
                rollout.finals.append((t, step.final_rows, step.final_inputs))
        self._action_mask = action_mask
        rollout.env_seconds = env_seconds
        return inputs

    def _check(self, rollout: Rollout, engine: Engine, num_steps: int, last: Inputs) -> None:
        self._check_numbers(rollout, num_steps, last)
        self._check_policy(rollout, engine.policy, num_steps)

    def _check_numbers(self, rollout: Rollout, num_steps: int, last: Inputs) -> None:
        """Raise BadNumbers for the first NaN or infinity of an environment in ``num_steps`` columns.

        ``last``: observations after the last step, not normalised.
        """
        environments, first_step = self.environments, self._step_count
        rows = np.arange(len(rollout.logp))
        floats = [x for name, x in rollout.inputs.items() if name != "flat" and x.dtype.kind == "f"]
        seen = [rollout.raw, *(x.reshape(*x.shape[:2], -1) for x in floats)]
        after = first_step + num_steps
        # what, numbers [N, t, k], their rows, the step of the first, the column of the action that led there
        checks = [("observation", x[:, :num_steps], rows, first_step, -1) for x in seen]
        checks += [("reward", rollout.rewards[:, :num_steps, None], rows, first_step, 0)]
        checks += [("observation", x[:, None], rows, after, num_steps - 1) for x in float_parts(last)]
        for t, final_rows, final in rollout.finals:
            parts = float_parts(final)
            checks += [("final observation", x[:, None], final_rows, first_step + t + 1, t) for x in parts]
        for what, numbers, which, first, column in checks:
            found = first_unusable(numbers)
            if found is None:
                continue
            place, t, index = found
            row = int(which[place])
            where = f"step {first + t}" + ("" if what == "reward" else f", index {index}")
            action = None
            if column + t >= 0:
                chosen = rollout.actions[row, column + t]
                action = action_text(environments.action_layout.to_env_single(chosen))
            raise BadNumbers(
                f"Environment {row} of {environments.spec_id} returned {what} = {numbers[place, t, index]} "
                f"at {where}{circumstances(environments.worker_of(row), environments.seed_of(row), action)}; "
                f"expected finite numbers of at most {FLOAT32_MAX:.2g}. The policy was not updated with it. "
                "Fix the environment, or clip and check its state there; --on-env-fault restart restarts it "
                "and continues."
            )

    def _check_policy(self, rollout: Rollout, policy: nn.Module, num_steps: int) -> None:
        """NonFiniteError when the policy gave a log-probability that is not finite; a bad weight is named."""
        bad = ~np.isfinite(rollout.logp[:, :num_steps])
        if not bad.any():
            return
        row, t = np.argwhere(bad)[0]
        weight = first_bad((f"the weight {name}", p) for name, p in policy.named_parameters())
        raise NonFiniteError(
            f"The policy gave the log-probability {rollout.logp[row, t]} to its action in environment {row} "
            f"at step {self._step_count + t}; expected a finite number"
            + (f", but {weight}. " if weight else ": its logits overflow. ")
            + "It was not updated with this rollout. Look for a learning rate that is too high."
        )

    def _count_episodes(self, rollout: Rollout) -> list[tuple[float, int, bool]]:
        """(return, length, terminated) of every episode that ended in the rollout, by column.

        One that a fault cut is not an episode.
        """
        running = np.cumsum(np.where(rollout.mask, rollout.rewards, 0.0), axis=1) + self._returns[:, None]
        lengths = np.cumsum(rollout.mask, axis=1) + self._lengths[:, None]
        found = []
        self._returns = running[:, -1].copy()
        self._lengths = lengths[:, -1].copy()
        for row in np.flatnonzero(rollout.ended.any(axis=1)):
            ends = np.flatnonzero(rollout.ended[row])
            totals, counts = running[row, ends], lengths[row, ends]
            for k, t in enumerate(ends):
                before = (totals[k - 1], counts[k - 1]) if k else (0.0, 0)
                flag = bool(rollout.terminated[row, t])
                if rollout.mask[row, t]:
                    found.append((int(t), float(totals[k] - before[0]), int(counts[k] - before[1]), flag))
            self._returns[row] -= totals[-1]
            self._lengths[row] -= counts[-1]
        return [episode[1:] for episode in sorted(found, key=lambda episode: episode[0])]
