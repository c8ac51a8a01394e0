"""The Python face of the control story: PPO(env).learn(n), iterate, predict, value, save, load."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from tightrope.algorithms import ppo
from tightrope.algorithms.batch import Batch
from tightrope.algorithms.nonfinite import require_restorable
from tightrope.algorithms.optimise import (
    make_optimiser,
    optimiser_tensors,
    restore_optimiser,
    set_learning_rates,
)
from tightrope.algorithms.settings import PPOSettings, UpdateSettings
from tightrope.control.engine.base import limited_threads
from tightrope.control.engine.choose import choose_engine, usable_device
from tightrope.control.environments.base import Environments
from tightrope.control.environments.faults import FailedEpisode, policy_of, require_finite
from tightrope.control.environments.make import make_environments
from tightrope.control.environments.processes import available_cores
from tightrope.control.environments.tasks import EnvSource
from tightrope.control.environments.vector import is_vector_env
from tightrope.control.policy.normalise import Normalisers
from tightrope.control.policy.policy import OwnPolicy, Policy
from tightrope.control.resolve import anywhere, require_room, resolve, resolved, without_effect
from tightrope.control.rollout.collector import Collector
from tightrope.control.rollout.replay import Before, begin
from tightrope.control.rollout.rollout import FinishedEpisodes, Rollout, cut_shares, to_batch
from tightrope.control.settings import TrainSettings
from tightrope.control.spaces.structure import Array, Inputs, Reading, bounds_of, structure
from tightrope.maths.values import explained_variance
from tightrope.runs import checkpoint, generators, signals
from tightrope.runs.growing import GROUP as ACTIONS
from tightrope.training.learner import Update, crosses
from tightrope.training.memory import DoesNotFit
from tightrope.training.parameters import Tensors, whole_update

WARM_UP_STEPS = 512  # for the first statistics of observations: the initial policy acts, nothing is learnt
USUAL = 1_000  # steps of an episode that is not unusually long, where the task has no time limit
MIN_COLUMNS = 16  # ten epochs on fewer steps than this would only add noise to a finished policy


class Agent:
    """A policy that learns on an environment. Use PPO, A2C or Reinforce.

    ``env``: a Gymnasium id, an environment, a factory or a vector environment.  ``policy``: a torch module of
    your own (see Policy).  ``notify`` gets messages, such as that the engine is compiled.  Every other
    argument is a field of TrainSettings or of the algorithm's settings; defaults come from the task's preset.
    """

    algorithm: ClassVar[str]

    def __init__(
        self,
        env: EnvSource,
        *,
        policy: OwnPolicy | None = None,
        settings: TrainSettings | None = None,
        notify: Callable[[str], None] = lambda text: print(text, file=sys.stderr),
        **values: object,
    ) -> None:
        self.settings = settings or resolve(env, self.algorithm, values)
        self.env = env
        require_room(self.settings)
        present = self.settings
        with signals.stoppable(only_ctrl_c=True), generators.apart(present.seed):  # what constructors draw
            self.environments = _environments(env, present)
        torch_device = usable_device(present.device)
        layouts = (self.environments.observation_layout, self.environments.action_layout)
        try:
            require_room(present, *layouts, own_policy=policy is not None)
        except DoesNotFit:
            self.environments.close()
            raise
        threads = present.threads or 1
        with limited_threads(threads), generators.apart(present.seed):  # QR's bits depend on the threads
            self.policy = Policy(*layouts, present, policy).to(torch_device)
        self.optimiser = make_optimiser(
            self.policy.parameters(), self.policy.critic_parameters(), present.update
        )
        self.normalisers = Normalisers.of(layouts[0].continuous, self.environments.num_envs, present)
        self.cores = available_cores()
        self.engine, self.engine_line = choose_engine(
            self.policy, self.optimiser, present, self.cores, notify
        )
        # three streams: what predict draws must not change what training draws
        seeds = ([present.seed, k] for k in (1, 2, 4))
        self.sampling_rng, self.update_rng, self.predict_rng = (np.random.default_rng(x) for x in seeds)
        self.collector = self._collector()
        self.steps, self.rollbacks, self.kl_beta = 0, 0, getattr(present.update, "kl_beta", None)
        self.changes: dict[str, Any] = {}  # of the update rule's settings, made by a listener
        self.episodes = FinishedEpisodes()
        self.begun, self.notify = False, notify
        self._fresh = True  # before the next rollout episodes begin: those of a checkpoint, or new ones
        self._saved: tuple[Any, Tensors] = (None, {})  # of a checkpoint: the running episodes and their logs
        self._before: Before | None = None  # the update that is under way
        self.failed: list[FailedEpisode] = []  # of environments that were restarted in the last update
        self._update_seconds: float | None = None  # of the newest update
        self.settings = resolved(present, self.environments, self.engine.name, threads)
        if settings is None:
            for text in without_effect(present, layouts[1], own_policy=policy is not None):
                notify(text)

    # ---------------------------------------------------------------------------------------------- learning

    def learn(self, total_steps: int | None = None) -> Agent:
        """Train for at most ``total_steps`` more agent steps (default: the settings'); schedules run over
        them.
        """
        for _ in self.iterate(total_steps):
            pass
        return self

    def iterate(self, total_steps: int | None = None, *, start: int | None = None) -> Iterator[Update]:
        """Learn, one update at a time: ``for report in agent.iterate(n): ...``.

        ``start``: the agent step at which this budget began (default: now). Ctrl-C drops a rollout at once
        and lets an update finish, or undoes a long one; the agent is then as it was between two updates.
        """
        given: Any = self.settings.total_steps if total_steps is None else total_steps
        given = int(given) if isinstance(given, float) and given.is_integer() else given  # learn(1e6)
        budget = self.settings.with_values(total_steps=given).total_steps
        start = self.steps if start is None else start
        if start == self.steps:
            self.require_enough(budget)
        for note in [] if self.steps else self.environments.action_layout.not_mapped():
            self.notify(note)
        if not self.begun:
            generators.seed(self.settings.seed, self.steps)
            self.begun = True
        while (sizes := self._next_columns(budget, start))[1] > 0:
            before = self.steps - start
            # BLAS threads beside the engine's two only spin: its products are too small to share
            threads = 1 if self.engine.name == "fused" else self.settings.threads or 1
            with limited_threads(threads), self._whole_updates():
                metrics, rollout = self._one_update(*sizes, before / budget)
                after = self.steps - start
                on_grid = crosses(before, after, budget, self.settings.checkpoint_every)
                self.failed = rollout.failed
            usual = self.environments.max_episode_steps or USUAL
            if line := self.episodes.silence(rollout, self.steps, budget, self.collector.longest(), usual):
                self.notify(line)
            yield Update(after, budget, metrics, before, on_grid, rollout.episodes, seeds=rollout.seeds)

    def require_enough(self, budget: int) -> None:
        """ValueError where a budget of agent steps is too small to learn from."""
        rows, ready = self.environments.num_envs, self.normalisers.ready
        least = rows if ready else 2 * rows
        if budget < least:
            why = "" if ready else ", and the first step of each only gives statistics of observations"
            raise ValueError(
                f"{budget} steps are too few: there are {rows} environments{why}. Expected at least {least}: "
                "give more steps, or fewer num_envs."
            )

    @contextlib.contextmanager
    def _whole_updates(self) -> Iterator[None]:
        """Around an update. What ends it before it is complete (a signal, a fault) drops its rollout: random
        generators and statistics go back to where they were, and the running episodes are repeated before the
        next one.
        """
        with signals.stoppable(only_ctrl_c=True), signals.uninterrupted():
            self._before = before = self._present()
            statistics = self.normalisers.state()
            try:
                with whole_update(self._update_seconds, self._learned, self._unlearn):
                    yield
            except BaseException:
                self.sampling_rng.bit_generator.state = before.rng["sampling"]
                self.update_rng.bit_generator.state = before.rng["update"]
                self.normalisers.load(statistics)
                self.collector.drop()
                self._fresh, self._saved = True, before.episodes()
                raise
            finally:
                self._before = None

    def _learned(self) -> Tensors:
        """What an update changes in place."""
        found = {"policy": dict(self.policy.state_dict()), "optimiser": optimiser_tensors(self.optimiser)}
        normalisers = self.normalisers.state()
        return {**found, "normalisers": normalisers} if normalisers else found

    def _unlearn(self, tensors: Tensors) -> None:
        """Put back what `_learned` gave."""
        self.policy.load_state_dict(tensors["policy"])
        restore_optimiser(self.optimiser, tensors["optimiser"])
        normalisers = dict(tensors.get("normalisers", {}))
        running = normalisers.get("rewards.running")
        if running is not None and len(running) != self.environments.num_envs:
            normalisers["rewards.running"] = torch.zeros(self.environments.num_envs, dtype=torch.float64)
        self.normalisers.load(normalisers)

    def _next_columns(self, budget: int, start: int) -> tuple[int, int]:
        """Columns of the warm-up, at most a tenth of what is left, and of the rollout behind it: whole
        rollouts; (.., 0) when too few are left to learn from.
        """
        rows, most, warm_up = self.environments.num_envs, self.settings.num_steps, 0
        left = (budget - (self.steps - start)) // rows
        if not self.normalisers.ready:
            warm_up = min(max(MIN_COLUMNS, -(-WARM_UP_STEPS // rows)), max(1, left // 10))
            warm_up -= max(0, warm_up % most - most // 2)
        columns = min(most - warm_up % most, left - warm_up)
        enough = self.steps == start or columns >= min(MIN_COLUMNS, most)
        return warm_up, columns if enough else 0

    def _one_update(self, warm_up: int, columns: int, progress: float) -> tuple[dict[str, float], Rollout]:
        """collect -> advantages -> update -> statistics."""
        present = self.settings.update.unchecked(**self.changes).at(progress)
        if isinstance(present, PPOSettings) and self.kl_beta is not None:
            present = present.unchecked(kl_beta=self.kl_beta)
        set_learning_rates(self.optimiser, present)
        begin = time.perf_counter()
        with signals.interruptible():
            for line in self.begin_episodes():
                self.notify(line)
            rollout = self.collector.collect(self.engine, columns, warm_up)
        collected = time.perf_counter()
        estimate = partial(to_batch, rollout, self.engine, self.normalisers, present)
        critic_lambda = self.settings.critic_lambda
        batch, metrics = estimate(critic_lambda, move=True), dict[str, float]()
        if bool(batch.mask.any()):
            metrics = self.engine.update(
                batch,
                present,
                self.update_rng,
                refresh=lambda _: estimate(critic_lambda).as_steps(),
                log_ratio_limit=self._log_ratio_limit(batch),
            )
            metrics["train/explained_variance"] = float(
                explained_variance(batch.old_values, batch.returns, batch.mask)
            )
        metrics |= self.normalisers.metrics() | cut_shares(rollout, self.environments, self.normalisers)
        kl = metrics.get("train/kl_after")
        if isinstance(present, PPOSettings) and present.kl_beta and present.kl_adapt and kl is not None:
            self.kl_beta = ppo.next_kl_beta(present.kl_beta, kl, present.kl_adapt)
        self.normalisers.update(rollout)
        self.collector.record(rollout)
        self.steps += rollout.steps
        finish = time.perf_counter()
        metrics |= _settings_metrics(present) | self.episodes.add(rollout)
        if rollout.restarts is not None:
            metrics["rollout/environment_restarts"] = float(rollout.restarts)
        metrics["time/env_seconds"] = rollout.env_seconds
        metrics["time/act_seconds"] = collected - begin - rollout.env_seconds
        metrics["time/update_seconds"] = self._update_seconds = finish - collected
        metrics["time/fps"] = rollout.steps / (finish - begin)
        return metrics, rollout

    def _log_ratio_limit(self, batch: Batch) -> float:
        """1e-5, times what rounding in float32 grows with: columns, the size of inputs, a small deviation;
        and a hundred after the first update, when the weights may have grown, or a thousand where the
        deviation comes from weights too.
        """
        grown = 100.0 if self.settings.std == "independent" else 1000.0
        scale = float(max(1, self.environments.action_layout.num_columns)) * (grown if self.steps else 1.0)
        if "flat" in batch.inputs:
            scale *= max(1.0, float(batch.inputs["flat"].abs().max()))
        if self.policy.log_std is not None:
            scale /= min(1.0, float(self.policy.log_std.detach().min().exp()))
        return 1e-5 * scale

    # ------------------------------------------------------------------------------------------------ acting

    def predict(
        self, observation: object, deterministic: bool = True, *, action_masks: object = None
    ) -> tuple[Any, None]:
        """Action(s) for one observation or a batch, in the task's own form; the second item is always None.

        ``deterministic``: the most likely action, else a sampled one.
        """
        layout, actions = self.environments.observation_layout, self.environments.action_layout
        batched = layout.is_batched(observation)
        inputs = layout.encode(observation, batched=batched)
        masks = layout.mask_of(observation) if action_masks is None else action_masks
        action_mask = actions.allowed(masks, len(next(iter(inputs.values()))))
        matrix = self.choose(inputs, action_mask, None if deterministic else self.predict_rng)
        return (actions.to_env(matrix) if batched else actions.to_env_single(matrix[0])), None

    def value(self, observation: object) -> Any:
        """The critic's V(s) in units of the return: a float for one observation, an array [N] for a batch."""
        layout = self.environments.observation_layout
        batched = layout.is_batched(observation)
        inputs = self.normalisers.encode(require_finite(layout.encode(observation, batched=batched)))
        values = self.policy.values(inputs).cpu()
        if self.normalisers.returns is not None:
            values = self.normalisers.returns.values(values)
        if self.normalisers.rewards is not None:
            values = values * self.normalisers.rewards.deviation
        return values.numpy() if batched else float(values[0])

    def choose(
        self, inputs: Inputs, action_mask: Array | None, rng: np.random.Generator | None = None
    ) -> Array:
        """Action matrix [N, A] for observations as their layout encodes them: sampled with ``rng``, without
        it the most likely actions. ``action_mask`` bool [N, L].
        """
        inputs = self.normalisers.encode(require_finite(inputs))
        if action_mask is not None:
            inputs = {**inputs, "action_mask": action_mask}
        if rng is None:
            return self.policy.mode(inputs).cpu().numpy()
        noise = self.collector.noise(1, len(next(iter(inputs.values()))), rng)[0]
        return self.policy.sample(inputs, noise, rng).cpu().numpy()

    # ------------------------------------------------------------------------------------- moving and saving

    def set_env(self, env: EnvSource) -> Agent:
        """Continue on another environment with the same spaces (a warm start); bounds of observations, which
        no network sees, may be others.

        Raises ValueError, with nothing changed, when the spaces differ.
        """
        rows = env.num_envs if is_vector_env(env) else self.settings.num_envs
        free = anywhere(self.settings, env, num_envs=rows)
        fresh, old = _environments(env, free), self.environments
        for name in ("observation_layout", "action_layout"):
            seen, expected = getattr(fresh, name).space, getattr(old, name)
            if not expected.fits(seen):
                fresh.close()
                raise ValueError(
                    f"The new environment has {name[:-7]}s {seen}; this policy was made for {expected.space}."
                )
        old.close()
        self.env, self.environments = env, fresh
        self.collector = self._collector()
        self.forget_episodes()
        self.episodes = FinishedEpisodes()
        named = dataclasses.replace(free, env=fresh.spec_id)
        self.settings = resolved(named, fresh, self.engine.name, free.threads)
        return self

    def save(self, path: str | Path) -> Path:
        """Write policy, optimiser, normalisers and random generators into the folder ``path``; nothing is
        pickled. Raises CannotWrite.
        """
        return checkpoint.save(Path(path), *self.snapshot())

    def snapshot(self) -> tuple[Tensors, dict[str, Any]]:
        """Everything that `restore` needs, as tensors and JSON. The tensors are not copied.

        While a rollout is collected it is still the state at the end of the update before.
        """
        tensors = self._learned()
        at = self._before or self._present()
        episodes, logs = at.episodes()
        state = {
            "settings": self.settings.to_json(),
            "steps": self.steps,
            "kl_beta": self.kl_beta,
            "rollbacks": self.rollbacks,
            "environment_restarts": at.restarts,
            "finished_episodes": self.episodes.state(),
            "spaces": self._spaces(),
            "own_policy": self.policy.own is not None,
            "own_environment": self.env is not None and not isinstance(self.env, str),
            "rng": at.rng,
            "episodes": episodes,
        }
        return tensors | logs, state

    def _present(self) -> Before:
        rng = {"sampling": self.sampling_rng, "update": self.update_rng}
        return Before(
            rng={name: generator.bit_generator.state for name, generator in rng.items()},
            restarts=self.environments.restarts,
            boundary=None if self._fresh else self.collector.boundary(),
            saved=self._saved,
        )

    def _spaces(self) -> dict[str, list[str]]:
        environments = self.environments
        return {
            "observations": structure(environments.observation_layout.space),
            "images": environments.observation_layout.pictures(),
            "actions": structure(environments.action_layout.space),
            "action bounds": bounds_of(environments.action_layout.space),
        }

    def require_spaces(self, state: Mapping[str, object]) -> None:
        """ValueError when a saved policy was trained on other observations or actions than there are here."""
        saved = state.get("spaces")  # missing in old runs
        for name, here in self._spaces().items():
            if isinstance(saved, dict) and saved.get(name, here) != here:
                raise ValueError(
                    f"The saved policy was trained on {name} {saved.get(name)}; this environment has {here}: "
                    f"{self.environments.observation_layout.space}. Give an environment with the same spaces."
                )

    def restore(self, tensors: Tensors, state: dict[str, Any]) -> None:
        """Put back what `snapshot` gave, into an agent of the same settings."""
        for name, parameter in self.policy.named_parameters():
            require_restorable(name, tensors["policy"][name], parameter)
        self._unlearn(tensors)
        beta = state["kl_beta"]
        self.steps = checkpoint.counted(state["steps"])
        self.kl_beta = None if beta is None else float(beta)
        if self.kl_beta is not None and not 0 <= self.kl_beta < math.inf:
            raise ValueError(f"kl_beta is {self.kl_beta}")
        self.rollbacks = checkpoint.counted(state.get("rollbacks", 0))  # missing in old runs
        self.collector.count_from(checkpoint.counted(state.get("environment_restarts", 0)))
        self.episodes.restore(state.get("finished_episodes", {}))  # missing in old runs
        self.sampling_rng.bit_generator.state = state["rng"]["sampling"]
        self.update_rng.bit_generator.state = state["rng"]["update"]
        self._fresh, self._before = True, None
        self._saved = (state.get("episodes"), {ACTIONS: tensors[ACTIONS]} if ACTIONS in tensors else {})

    def begin_episodes(self) -> list[str]:
        """Unless episodes are running: continue those of the checkpoint that was restored. New ones begin
        where there are none, or where they cannot be repeated, which the lines say.
        """
        if not self._fresh:
            return []
        saved, self._saved = self._saved, (None, {})
        differences = begin(self.collector, saved, self.settings.seed, self.steps, self.notify)
        self._fresh = False
        return differences

    def forget_episodes(self) -> None:
        """Begin new episodes with the next rollout."""
        self._fresh, self._saved = True, (None, {})

    def roll_back(self, tensors: Tensors, state: dict[str, Any]) -> None:
        """Go back to a checkpoint of this agent, with random generators that depend on the seed, the step and
        the number of rollbacks. Environments are as after a resume; restarts so far stay counted.
        """
        rollbacks, restarts = self.rollbacks + 1, self.environments.restarts
        self.restore(tensors, state)
        self.rollbacks = rollbacks
        self.collector.count_from(restarts)
        for k, rng in ((1, self.sampling_rng), (2, self.update_rng)):
            other = np.random.default_rng([self.settings.seed, k, self.steps, rollbacks])
            rng.bit_generator.state = other.bit_generator.state

    def _collector(self) -> Collector:
        limit = self.settings.replay_limit
        return Collector(self.environments, self.normalisers, self.sampling_rng, limit)

    def close(self) -> None:
        """Close the environments, and end their workers and the engine's thread."""
        self.environments.close()
        self.engine.close()


class PPO(Agent):
    """Proximal policy optimisation on a Gymnasium task."""

    algorithm = "ppo"


class A2C(Agent):
    """Synchronous advantage actor-critic on a Gymnasium task."""

    algorithm = "a2c"


class Reinforce(Agent):
    """REINFORCE, with (default) or without a baseline, on a Gymnasium task."""

    algorithm = "reinforce"


AGENTS: dict[str, type[Agent]] = {"ppo": PPO, "a2c": A2C, "reinforce": Reinforce}


def _environments(env: EnvSource | None, settings: TrainSettings) -> Environments:
    source = settings.env if env is None else env
    backend, workers, policy = settings.vector_backend, settings.num_workers, policy_of(settings)
    return make_environments(
        source,
        settings.num_envs,
        backend=backend,
        num_workers=workers,
        env_kwargs=settings.env_kwargs,
        policy=policy,
        reading=Reading.of(settings),
        reseed_after=settings.reseed_after,
        carried=settings.carried,
    )


def _settings_metrics(present: UpdateSettings) -> dict[str, float]:
    names = ("learning_rate", "critic_learning_rate", "clip", "entropy_weight", "kl_beta")
    found = {f"train/{name}": getattr(present, name, None) for name in names}
    return {name: value for name, value in found.items() if value is not None}
