"""Collecting rollouts: step the environments with the policy."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from time import perf_counter
from typing import Any

import numpy as np
from torch import nn

from tightrope.algorithms.nonfinite import NonFiniteError, first_bad
from tightrope.control.engine.base import Acted, Engine
from tightrope.control.environments import state as states
from tightrope.control.environments.base import Environments
from tightrope.control.environments.episode import Start
from tightrope.control.environments.faults import (
    FLOAT32_MAX,
    EnvironmentFault,
    FailedEpisode,
    action_text,
    circumstances,
    first_unusable,
    float_parts,
)
from tightrope.control.policy.normalise import Normalisers
from tightrope.control.rollout import replay
from tightrope.control.rollout.replay import Boundary
from tightrope.control.rollout.rollout import Rollout
from tightrope.control.spaces.structure import Array, Inputs
from tightrope.errors import TightropeError
from tightrope.runs.records import plain


class BadNumbers(TightropeError, ValueError):
    """An environment returned a NaN or an infinity; nothing was learned from it."""


class Collector:
    """Fills rollouts; carries observations and running episodes from one to the next."""

    def __init__(
        self,
        environments: Environments,
        normalisers: Normalisers,
        rng: np.random.Generator,
        replay_limit: int = 20_000,
    ) -> None:
        self.environments = environments
        self.normalisers = normalisers
        self.rng = rng
        self._rollout: Rollout | None = None
        self._uniform = ~environments.action_layout.gaussian  # bool [A]: columns of uniform noise
        self._step_count = 0
        self._column = 0  # the step of the rollout that is under way
        self._broken = False  # a rollout ended with an error: only `close` is left
        self._restarts = 0  # those that earlier rollouts reported
        self.failed: FailedEpisode | None = None  # the episode in which an environment ended the rollout
        self.replay_limit = replay_limit

    def reset(self, seed: int, episode: int = 0) -> None:
        """Begin new episodes in all copies: number ``episode`` of each."""
        starts = [Start(episode)] * self.environments.num_envs
        self._begin_from(*self.environments.reset(seed, starts=starts))
        self._returns = np.zeros(self.environments.num_envs)
        self._lengths = np.zeros(self.environments.num_envs, np.int64)
        if self.normalisers.rewards is not None:
            self.normalisers.rewards.restart(self.environments.num_envs)

    def _begin_from(self, inputs: Inputs, action_mask: Array | None) -> None:
        self._inputs, self._action_mask = inputs, action_mask
        self._running = replay.begun(self.environments, inputs, action_mask)
        self._state = self.environments.get_state() if self.environments.gives_state else None

    def boundary(self) -> Boundary:
        """The running episodes, after a reset, a rollout or a `resume`."""
        seen = (self._inputs, self._action_mask, self._returns, self._lengths)
        return Boundary(*seen, self._running, self._state)

    def longest(self) -> int:
        """Steps of the longest running episode."""
        return int(self._lengths.max())

    def resume(
        self, seed: int, saved: dict[str, Any], logs: dict[str, Array], tell: Callable[[str], None]
    ) -> list[str]:
        """Continue the episodes of a boundary, as `saved` and its logs describe it; what differs from it,
        for people. ``tell``: of what takes long. ValueError for one of other environments.
        """
        environments = self.environments
        restarts, copies = environments.restarts, environments.num_envs
        returns, lengths = states.decode(saved["returns"]), states.decode(saved["lengths"])
        zeros = np.zeros(copies)
        for name, array, like in (("returns", returns, zeros), ("lengths", lengths, zeros.astype(np.int64))):
            _require_alike(name, array, like)
        differences: list[str] = []
        if environments.gives_state:
            first, mask = environments.reset(seed)
            inputs, action_mask = states.decode(saved["inputs"]), states.decode(saved["action_mask"])
            _require_alike("inputs", inputs, first)
            _require_alike("action_mask", action_mask, mask)
            environments.set_state(states.decode(saved["environments"]))
            self._begin_from(inputs, action_mask)
        else:
            origins = np.array(saved["origins"], np.int64).reshape(copies, 3)
            first_seen = np.array(saved["first"], np.uint32)
            _require_alike("first", first_seen, np.zeros(copies, np.uint32))
            was = replay.Running(origins, first_seen, [], saved["carried"])
            repeated = replay.replay(environments, seed, was, logs, tell)
            returns[repeated.renewed], lengths[repeated.renewed] = 0.0, 0
            if self.normalisers.rewards is not None:
                self.normalisers.rewards.running[repeated.renewed] = 0.0
            self._inputs, self._action_mask, differences = (
                repeated.inputs,
                repeated.mask,
                repeated.differences,
            )
            self._running, self._state = repeated.running, None
        self._returns, self._lengths = returns, lengths
        environments.count_from(restarts)
        return differences

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
        earlier: dict[str, Any] = {}  # what the warm-up counted
        for columns in (warm_up, num_steps) if warm_up else (num_steps,):
            rollout = self._collect(engine, columns)
            for name, counted in earlier.items():
                setattr(rollout, name, counted + getattr(rollout, name))
            if warm_up and not earlier:
                assert self.normalisers.observations is not None
                self.normalisers.observations.update(rollout.raw[rollout.mask])
                self.record(rollout)
                earlier = rollout.counts()
        return rollout

    def _collect(self, engine: Engine, num_steps: int) -> Rollout:
        rollout = self._cleared(num_steps)
        try:
            inputs = self._fill(rollout, engine)
        except Exception as error:
            self._broken = True
            # a NaN observation or a NaN weight is the likelier cause of what failed after it
            self._check(rollout, engine, self._column + 1, self._inputs)
            if isinstance(error, EnvironmentFault) and error.index >= 0:
                self.failed = self._failed(rollout, error.index, self._column, now=True)
            raise
        self._inputs = inputs
        self._check(rollout, engine, num_steps, inputs)
        rollout.last = self.normalisers.encode(inputs)
        rollout.finals = [(t, rows, self.normalisers.encode(x)) for t, rows, x in rollout.finals]
        rollout.ended |= rollout.terminated | rollout.truncated
        if self.environments.policy.restart:
            rollout.restarts = self.environments.restarts - self._restarts
            self._restarts = self.environments.restarts
        ended = self._count_episodes(rollout)
        cut = np.argwhere(rollout.ended & ~rollout.mask) if rollout.restarts else ()
        found = [self._failed(rollout, int(row), int(t)) for row, t in cut]
        rollout.failed = [episode for episode in found if episode is not None]
        rollout.episodes = [episode for _, episode, _ in ended]
        rollout.seeds = [seed for _, _, seed in ended]
        self._step_count += num_steps
        return rollout

    def _failed(
        self, rollout: Rollout, row: int, column: int, *, now: bool = False, seen: bool = False
    ) -> FailedEpisode | None:
        """The episode that ran in a row at a column; None for environments that do not replay.

        ``now``: the rollout goes no further.  ``seen``: what failed is the observation behind the step, which
        belongs to the next episode where the step ended one.
        """
        running, environments = self._running, self.environments
        if running is None:
            return None
        origin, earlier, begin = running.origins[row], running.parts[row], 0
        present = environments.origins()
        assert present is not None
        found = [(t, x) for t, x in rollout.origins if t < column + seen]
        for t, origins in [*found, *([(column, present)] if now else [])]:
            if origins[row, 0] != origin[0]:
                earlier, begin = [], t + 1
            origin = origins[row]
        layout, carried, lost = environments.action_layout, running.carried, False
        if carried is not None and begin:
            # known of the present episodes only, and workers do not answer after a fault
            lost = present[row, 0] != origin[0] or (self._broken and environments.backend != "serial")
            carried = None if lost else environments.carried()
        width = rollout.actions.shape[2]
        parts = [part[:, :width].view(np.float32) for part in earlier or ()]
        actions = np.concatenate([*parts, rollout.actions[row, begin : column + 1]])
        return FailedEpisode(
            row,
            environments.seeding.seed(row, int(origin[0])),
            int(origin[1]),
            None if carried is None else carried[row],
            bool(lost),
            len(actions),
            None if earlier is None else plain(layout.space.to_jsonable(list(layout.rows(actions)))),
        )

    def record(self, rollout: Rollout) -> None:
        """Record what running episodes need to continue after a rollout: what came before each copy's last
        seeded reset is forgotten, and a log of more than ``replay_limit`` steps is dropped.

        After the update: one that is not complete is collected again, from what was recorded before it.
        """
        if self.environments.gives_state:
            self._state = self.environments.get_state()
        running = self._running
        if running is None:
            return
        copies, num_steps, width = rollout.actions.shape
        observed = {name: x for name, x in rollout.inputs.items() if name not in ("flat", "action_mask")}
        if rollout.raw.size:
            observed["flat"] = rollout.raw
        seen = np.empty((copies, num_steps + 1), np.uint32)  # before each step, and behind the last
        seen[:, :-1], seen[:, -1] = replay.of_observations(observed, 2), replay.of_observations(self._inputs)
        present, rest = seen, replay.of_steps(rollout.rewards, rollout.terminated, rollout.truncated)
        if self._action_mask is not None:
            before, behind = rollout.inputs["action_mask"], self._action_mask
            masks = np.column_stack([replay.of_masks(before, 2), replay.of_masks(behind)])
            present, rest = seen ^ masks, rest | masks[:, 1:]
        rows = np.empty((copies, num_steps, width + replay.PRINTS), np.int32)
        rows[:, :, :width] = rollout.actions.view(np.int32)
        rows[:, :, width], rows[:, :, width + 1] = seen[:, 1:].view(np.int32), rest.view(np.int32)

        origins, first = running.origins + np.array((0, 0, num_steps)), running.first
        carried, ended = running.carried, None
        if rollout.origins:
            last, after = rollout.origins[-1]
            origins = after + np.array((0, 0, num_steps - 1 - last))
            carried = None if carried is None else self.environments.carried()
            over = next((t for t, x in rollout.origins if x[0, 0] != running.origins[0, 0]), None)
            if over is not None and rollout.mask[0, over]:  # not cut by a fault
                ended = running.of_first_copy(rows[0, : over + 1])
            begins = np.maximum(num_steps - origins[:, 2], 0)
            first = np.where(begins > 0, present[np.arange(copies), begins], first)
        parts: list[list[Array] | None] = []
        for row, length in enumerate(origins[:, 2].tolist()):
            earlier = [] if length < num_steps else running.parts[row]
            outgrown = carried is not None and isinstance(carried[row], str)
            if earlier is None or length > self.replay_limit or outgrown:
                parts.append(None)
            else:
                parts.append([*earlier, rows[row, -length:]] if length else [])
        self._running = replay.Running(origins, first, parts, carried, ended)

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
            if step.origins is not None:
                rollout.origins.append((t, step.origins))
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
        checks += [("reward", rollout.rewards[:, :num_steps, None], rows, first_step + 1, 0)]
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
            self.failed = failed = self._failed(rollout, row, column + t, seen=what == "observation")
            # by now the copy may be in another episode
            seed = environments.seed_of(row) if failed is None else failed.seed
            action = None
            if column + t >= 0 and (failed is None or failed.steps):
                chosen = rollout.actions[row, column + t]
                action = action_text(environments.action_layout.to_env_single(chosen))
            raise BadNumbers(
                f"Environment {row} of {environments.spec_id} returned {what} = {numbers[place, t, index]} "
                f"at {where}{circumstances(environments.worker_of(row), seed, action)}; "
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

    def _count_episodes(
        self, rollout: Rollout
    ) -> list[tuple[int, tuple[float, int, bool], tuple[int | None, int]]]:
        """Every episode that ended in the rollout, by column: (column, (return, length, terminated), seed).

        One that a fault cut is not an episode. The seed: see Update.
        """
        running = np.cumsum(np.where(rollout.mask, rollout.rewards, 0.0), axis=1) + self._returns[:, None]
        lengths = np.cumsum(rollout.mask, axis=1) + self._lengths[:, None]
        found = []
        self._returns = running[:, -1].copy()
        self._lengths = lengths[:, -1].copy()
        origins = [] if self._running is None else [self._running.origins, *(x for _, x in rollout.origins)]
        columns = [t for t, _ in rollout.origins]  # the last step before each of these origins but the first
        for row in np.flatnonzero(rollout.ended.any(axis=1)):
            ends = np.flatnonzero(rollout.ended[row])
            totals, counts = running[row, ends], lengths[row, ends]
            for k, t in enumerate(ends):
                before = (totals[k - 1], counts[k - 1]) if k else (0.0, 0)
                if not rollout.mask[row, t]:
                    continue
                seed: tuple[int | None, int] = (None, 0)
                if origins:
                    number, after = origins[bisect_left(columns, t)][row, :2].tolist()
                    seed = (self.environments.seeding.seed(int(row), number), after)
                total, length = float(totals[k] - before[0]), int(counts[k] - before[1])
                found.append((int(t), (total, length, bool(rollout.terminated[row, t])), seed))
            self._returns[row] -= totals[-1]
            self._lengths[row] -= counts[-1]
        return sorted(found, key=lambda ended: ended[0])


def _require_alike(name: str, found: object, like: object) -> None:
    if not states.alike(found, like):  # the compiled engine would read beyond it
        raise ValueError(f"{name} of the episodes have another shape than here")
