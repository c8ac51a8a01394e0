"""Rollouts: step the environments with the policy, and turn what came back into a Batch to learn from.

Memory is environment-major, [B, T, ...], allocated once and filled in place.
"""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np
import torch

from tightrope.algorithms.batch import Batch
from tightrope.algorithms.nonfinite import NonFiniteError, first_bad
from tightrope.algorithms.settings import ReinforceSettings, UpdateSettings
from tightrope.control.environments import state as states
from tightrope.control.environments.base import Environments
from tightrope.control.environments.faults import action_text, circumstances
from tightrope.control.policy.normalise import Normalisers

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
    With ``ended`` beside it: the step in which an environment failed and was made anew. Its input is the last
    observation of the episode that was cut, from whose value the step before it is bootstrapped.

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
        self.restarts: int | None = None  # environments made anew; None: the settings do not allow it

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
        self._step_count, self._restarts = 0, 0

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

    def restore(self, state: dict[str, Any]) -> None:
        """Go on with the episodes of a `state`. ValueError for one of other environments."""
        restarts = self.environments.restarts
        self.environments.count_from(0)  # the resets of then, and what failed in them, come once more
        inputs, action_mask = self.environments.set_state(state["environments"])
        self.environments.count_from(restarts)
        zeros = np.zeros(self.environments.num_envs)
        like = {"_inputs": inputs, "_action_mask": action_mask, "_returns": zeros}
        for name, fresh in {**like, "_lengths": zeros.astype(np.int64)}.items():
            found = states.unpack(state[name])
            if not states.alike(found, fresh):  # the compiled engine would read beyond it
                raise ValueError(f"{name.strip('_')} of the episodes have another shape than here")
            setattr(self, name, found)

    def count_from(self, restarts: int) -> None:
        """So many environments were made anew before; the rows so far have told of them."""
        self.environments.count_from(restarts)
        self._restarts = restarts

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
        rollout.ended.fill(False)
        rollout.finals, rollout.reward_statistics_taken = [], False
        noise = self.noise(num_steps, self.environments.num_envs, self.rng)
        engine.begin_rollout(self.environments.num_envs, self.rng)
        row_groups = self.environments.row_groups
        inputs, action_mask, t, env_seconds = self._inputs, self._action_mask, 0, 0.0
        try:
            for t in range(num_steps):
                if action_mask is not None:
                    rollout.inputs["action_mask"][:, t] = action_mask
                if keep_raw:
                    rollout.raw[:, t] = inputs["flat"]
                for rows in row_groups:
                    engine.act(inputs, self.normalisers.observations, action_mask, noise[t], rollout, rows, t)
                    self.environments.send(rows, rollout.actions[rows, t])
                before = perf_counter()
                step = self.environments.receive()
                env_seconds += perf_counter() - before
                inputs, action_mask = step.inputs, step.action_mask
                rollout.rewards[:, t] = step.rewards
                rollout.terminated[:, t] = step.terminated
                rollout.truncated[:, t] = step.truncated
                if step.phantom is not None:
                    np.logical_not(step.phantom, out=rollout.mask[:, t])
                if step.cut is not None:
                    rollout.mask[step.cut, t], rollout.ended[step.cut, t] = False, True
                if step.final_rows is not None and step.final_inputs is not None:
                    rollout.finals.append((t, step.final_rows, step.final_inputs))
        except Exception:
            # a NaN observation or a NaN weight is the likelier cause of what failed after it
            self._check_numbers(rollout, t + 1)
            self._check_policy(rollout, t + 1, engine)
            raise
        self._inputs, self._action_mask, rollout.env_seconds = inputs, action_mask, env_seconds
        self._check_numbers(rollout, num_steps)
        self._check_policy(rollout, num_steps, engine)
        rollout.last = self.normalisers.encode(inputs)
        rollout.finals = [(t, rows, self.normalisers.encode(x)) for t, rows, x in rollout.finals]
        rollout.ended |= rollout.terminated | rollout.truncated
        if self.environments.policy.restart:
            rollout.restarts = self.environments.restarts - self._restarts
            self._restarts = self.environments.restarts
        rollout.episodes = self._count_episodes(rollout)
        self._step_count += num_steps
        return rollout

    def _check_numbers(self, rollout: Rollout, num_steps: int) -> None:
        """Raise BadNumbers naming environment, step and index of the first NaN or infinity, if there is
        one.
        """
        rows, start = np.arange(len(rollout.logp)), self._step_count
        checks = [("observation", rollout.raw[:, :num_steps], rows, start, -1)]
        checks += [("reward", rollout.rewards[:, :num_steps, None], rows, start, 0)]
        if "flat" in self._inputs:
            last = self._inputs["flat"][:, None]
            checks.append(("observation", last, rows, start + num_steps, num_steps - 1))
        for t, final_rows, x in rollout.finals:
            if "flat" in x:
                checks.append(("final observation", x["flat"][:, None], final_rows, start + t + 1, t))
        for what, numbers, which, first, column in checks:  # ``column``: of the action that led there
            good = np.isfinite(numbers)
            if good.all():
                continue
            row, t, index = np.argwhere(~good)[0]
            where = f"step {first + t}" + ("" if what == "reward" else f", index {index}")
            raise BadNumbers(
                f"Environment {which[row]} of {self.environments.spec_id} returned "
                f"{what} = {numbers[row, t, index]} at {where}"
                f"{self._circumstances(rollout, int(which[row]), int(column + t))}; expected finite "
                "numbers. The policy was not updated with it. Mend the environment, or clip and check its "
                "state there; --on-env-fault restart makes it anew and goes on."
            )

    def _check_policy(self, rollout: Rollout, num_steps: int, engine: Any) -> None:
        """NonFiniteError when the policy gave a log-probability that is not finite; a bad weight is named."""
        bad = ~np.isfinite(rollout.logp[:, :num_steps])
        if not bad.any():
            return
        row, t = np.argwhere(bad)[0]
        weight = first_bad((f"the weight {name}", p) for name, p in engine.policy.named_parameters())
        raise NonFiniteError(
            f"The policy gave the log-probability {rollout.logp[row, t]} to its action in environment {row} "
            f"at step {self._step_count + t}; expected a finite number"
            + (f", but {weight}. " if weight else ": its logits overflow. ")
            + "It was not updated with this rollout. Look for a learning rate that is too high."
        )

    def _circumstances(self, rollout: Rollout, row: int, column: int) -> str:
        """Worker, seed and action of a row, in words."""
        environments, action = self.environments, None
        if column >= 0:
            chosen = rollout.actions[row, column]
            action = action_text(environments.action_layout.to_env_single(chosen, environments.squash))
        return circumstances(environments.worker_of(row), environments.seed_of(row), action)

    def _count_episodes(self, rollout: Rollout) -> list[tuple[float, int, bool]]:
        """(return, length, terminated) of every episode that ended in the rollout, in order of its column;
        one that a fault cut is none.
        """
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
                if rollout.mask[row, t]:
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
        mask = mask & finished(rollout.ended, mask)
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


def finished(ended: Array, mask: Array) -> Array:
    """True [B, T] for steps whose episode ends inside the rollout, and not in a fault that cut it (``ended``
    where ``mask`` is False).
    """
    found, whole = np.zeros_like(ended), np.zeros(len(ended), bool)
    for t in range(ended.shape[1] - 1, -1, -1):
        whole = np.where(ended[:, t], mask[:, t], whole)
        found[:, t] = whole
    return found
