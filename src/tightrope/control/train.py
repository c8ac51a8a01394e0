"""``tightrope train`` and ``tightrope resume``: an agent in the training loop, which leaves a run folder."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from tightrope.control.agent import AGENTS, Agent
from tightrope.control.environments.faults import EnvironmentFault, FailedEpisode
from tightrope.control.environments.make import Environments
from tightrope.control.environments.tasks import EnvSource
from tightrope.control.policy.policy import OwnPolicy
from tightrope.control.repetition import Repetition
from tightrope.control.resolve import resolve, without_effect
from tightrope.control.rollout.collector import BadNumbers
from tightrope.control.rollout.evaluation import (
    cut_text,
    evaluate_agent,
    evaluation_environments,
    step_limit,
)
from tightrope.control.saving import name_again, rebuild
from tightrope.control.settings import TrainSettings
from tightrope.runs import signals
from tightrope.runs.checkpoint import read_manifest, step_of, understood
from tightrope.runs.durable import CannotWrite, present
from tightrope.runs.folders import require_kind
from tightrope.runs.records import write_json
from tightrope.runs.retention import Checkpoint
from tightrope.runs.run import Run
from tightrope.training import loop
from tightrope.training.events import Listener, Listeners
from tightrope.training.learner import Update, crosses
from tightrope.training.loop import continue_from, newest_point
from tightrope.training.parameters import Tensors
from tightrope.training.tensorboard import require_tensorboard

__all__ = ["resolve", "resume", "train"]


@signals.stoppable()
def train(
    settings: TrainSettings,
    *,
    run_dir: str | Path | None = None,
    listeners: Sequence[Listener] = (),
    env: EnvSource | None = None,
    policy: OwnPolicy | None = None,
) -> dict[str, Any]:
    """Train from the start; returns the summary that is also written to the run folder."""
    home, report = Path.cwd(), Listeners(listeners)
    for risk in settings.risks():
        report.warn(risk)
    require_tensorboard(settings.tensorboard)
    source = settings.env if env is None else env
    agent = AGENTS[settings.algorithm](source, policy=policy, settings=settings, notify=report.info)
    own = agent.policy.own is not None
    for text in without_effect(settings, agent.environments.action_layout, own_policy=own):
        report.warn(text)
    settings = agent.settings
    name = f"{settings.env}-{settings.algorithm}-{settings.seed}"
    with contextlib.closing(agent):
        agent.require_enough(settings.total_steps)  # before there is a folder of a run that cannot begin
        with Run.create(run_dir, settings.to_json(), name, home) as run:
            learner = AgentLearner(agent, run, report)
            if own or not isinstance(source, str):
                # settings.json is not enough to make these first weights again
                tensors, state = learner.snapshot()
                run.save(0, tensors, state, keep=settings.keep_checkpoints, warn=report.warn)
            with contextlib.closing(learner):
                return loop.train(learner, run, report)


@signals.stoppable()
def resume(
    run_dir: str | Path,
    *,
    total_steps: int | None = None,
    listeners: Sequence[Listener] = (),
    env: EnvSource | None = None,
    policy: OwnPolicy | None = None,
) -> dict[str, Any]:
    """Continue from the newest checkpoint, or from the start where there is none yet; the end is that of an
    uninterrupted run, bit for bit (docs/resume.md names the conditions).

    ``total_steps`` extends a finished run: schedules and grid run over the new budget from here on.
    """
    with Run.open(run_dir, own=True) as run:
        return _resume(run, total_steps, Listeners(listeners), env, policy)


def _resume(
    run: Run, total_steps: int | None, listeners: Listeners, env: EnvSource | None, policy: OwnPolicy | None
) -> dict[str, Any]:
    run_dir = run.path
    require_kind(run_dir, run.settings, "train")
    point = newest_point(run, listeners)
    state: dict[str, Any] = {} if point is None else point.state
    with understood(run_dir if point is None else point.folder):
        saved = run.settings if point is None else state["settings"]
        settings = TrainSettings.from_json(saved)
        own_environment = bool(state.get("own_environment")) or ":" in settings.env
        own_policy = bool(state.get("own_policy"))
    if "reseed_after" not in saved:
        versions = {} if point is None else read_manifest(present(point.folder))["versions"]
        raise ValueError(
            f"{run_dir} was written by tightrope {versions.get('tightrope', 'of an unknown version')}; its "
            "checkpoints do not hold what an exact resume by this version needs: resume it with that one, or "
            "learn on from its policy in Python, "
            f"tightrope.load({str(run_dir)!r}{', env=...' if own_environment else ''}).learn(n)."
        )
    if env is None and own_environment:
        python = f"resume({str(run_dir)!r}, env=...)"
        raise ValueError(
            name_again(run_dir, settings.env, "resume", python, bool(state.get("own_environment")))
        )
    if own_policy and policy is None:
        raise ValueError(
            f"{run_dir} holds a policy module of somebody's own, which no file may import. Continue in "
            f"Python: tightrope.control.train.resume({str(run_dir)!r}, policy=module)."
        )
    # of a run that was extended and stopped before its next checkpoint, only settings.json has the budget
    if total_steps is None:
        with understood(run_dir):
            total_steps = int(run.settings["total_steps"])
    settings = settings.with_values(total_steps=total_steps)
    source = settings.env if env is None else env
    agent = rebuild(
        source, run_dir, command="resume", policy=policy, settings=settings, notify=listeners.info
    )
    learner = AgentLearner(agent, run, listeners)
    with contextlib.closing(agent), contextlib.closing(learner):
        if point is not None:
            learner.restore(point)
        if learner.total < learner.position:
            raise ValueError(
                f"{run_dir} has done {learner.position:,} steps; expected total_steps of at least as many, "
                f"got {learner.total:,}."
            )
        continue_from(learner, run, point)
        if learner.complete:
            listeners.info(f"{run_dir} has its {learner.total} steps; --total-steps N continues from there.")
        return loop.train(learner, run, listeners)


class AgentLearner:
    """An agent in the training loop, a `Learner`: evaluated on other episodes, its best policy kept.

    There is no evaluation while training where the environment cannot be copied.
    """

    def __init__(self, agent: Agent, run: Run, listeners: Listeners) -> None:
        self.agent = agent
        self.changes = agent.changes
        self.run = run
        self.listeners = listeners
        self.seconds = 0.0
        self.pending: Update | None = None
        self.best = -math.inf
        self.best_limit = math.inf  # steps that cut an episode of the best evaluation; infinite: none was cut
        self.final: dict[str, float] = {}
        self._told_of_long_episodes = False
        self._repetition = Repetition(agent, run, listeners)
        self.merit = None  # the newest checkpoints are kept; the best policy has its own folder
        self._environments: Environments | None = None
        self._told_of_cuts = False
        self._begin = (0, 0.0)

    @property
    def settings(self) -> TrainSettings:
        """Those of the agent, with what the run found out."""
        return self.agent.settings

    @property
    def position(self) -> int:
        """Agent steps so far."""
        return self.agent.steps

    @property
    def total(self) -> int:
        """Agent steps of the whole run."""
        return self.settings.total_steps

    @property
    def complete(self) -> bool:
        """Whether fewer steps are left than one in every environment."""
        return self.position + self.settings.num_envs > self.total

    @property
    def rollbacks(self) -> int:
        """How often the run went back to a checkpoint."""
        return self.agent.rollbacks

    def begin(self) -> list[str]:
        """Make the environments for evaluation; the lines that describe engine and environments."""
        self._begin = (self.position, self.seconds)
        self._repetition.begin()
        if self.settings.evaluate_every is not None:
            self._open_evaluation()
        environments = self.agent.environments
        if not (environments.replays or environments.gives_state):
            why = "These environments can neither be repeated from seeds and actions nor give their state"
            if environments.repeatable:
                why = (
                    "With reseed_after none only first episodes have seeds, and later ones cannot be repeated"
                )
            self.listeners.info(
                f"{why}: when the run is resumed they begin new episodes, and its end has other bits than "
                "without a break."
            )
        workers = f" in {environments.num_workers} processes" if environments.num_workers > 1 else ""
        count = f"{environments.num_envs} x {self.settings.env}"
        return [self.agent.engine_line, f"environments: {count}, {environments.backend}{workers}"]

    def _open_evaluation(self) -> None:
        try:
            self._environments = evaluation_environments(
                self.agent.env, self.settings, self.settings.evaluation_episodes
            )
        except ValueError as error:
            self.listeners.info(f"no evaluation while training: {error}")

    def iterate(self) -> Iterator[Update]:
        """The agent's updates."""
        try:
            for update in self.agent.iterate(self.total, start=0):
                for episode in self.agent.failed:
                    self.listeners.info(f"Environment {episode.copy} was restarted. {self._kept(episode)}")
                self._repetition.after_update()
                yield update
        except (EnvironmentFault, BadNumbers) as error:
            if (failed := self.agent.collector.failed) is not None:
                error.args = (f"{error}\n{self._kept(failed)}",)
            raise

    def _kept(self, episode: FailedEpisode) -> str:
        """Write an episode that failed into the run folder; a sentence that says where."""
        if episode.actions is None:
            limit = f"replay_limit {self.settings.replay_limit:,}"
            return f"Its episode was longer than {limit}: no file holds its actions."
        environments, number = self.agent.environments, len(list(self.run.path.glob("fault-*.json"))) + 1
        path = self.run.path / f"fault-{number:04d}.json"
        task = {"id": environments.spec_id, "kwargs": environments.keywords}
        write_json(path, {**task, **episode._asdict()})
        lost = " But what the task kept from earlier episodes is not known." if episode.carried_lost else ""
        return (
            f"{path} holds the seed and the actions of the episode; docs/faults.md repeats it in three "
            f"lines.{lost}"
        )

    def evaluate(self, update: Update | None) -> dict[str, float]:
        """The evaluation at points of its grid; the one at the end is `conclude`'s."""
        if update is None:
            return {}
        last = min(update.step, self.total - 1)
        due = crosses(update.before, last, self.total, self.settings.evaluate_every)
        return self._evaluate() if due else {}

    def conclude(self) -> dict[str, float]:
        """The final evaluation."""
        self.final = self._evaluate()
        return self.final

    def _evaluate(self) -> dict[str, float]:
        if self._environments is None:
            return {}
        # restarts in evaluations must not count towards the limit: a resumed run does not know of them
        self._environments.count_from(0)
        limit = step_limit(self.settings, self._environments, self.agent.episodes.longest)
        count = self.settings.evaluation_episodes
        result = evaluate_agent(self.agent, self._environments, count, max_steps=limit)
        if (text := cut_text(result, limit)) and not self._told_of_cuts:
            self._told_of_cuts = True
            self.listeners.warn(f"{text} Later evaluations tell it as eval/cut_episodes.")
        # whole episodes return the same under every limit, one that was cut another under a larger one
        if result["mean_return"] > self.best or limit > self.best_limit:
            self._keep(result["mean_return"], limit if result["cut_episodes"] else math.inf)
        found = {
            "eval/mean_reward": result["mean_return"],
            "eval/std_reward": result["std_return"],
            "eval/mean_length": result["mean_length"],
            "eval/episodes": float(result["episodes"]),
        }
        if result["cut_episodes"]:
            found["eval/cut_episodes"] = float(result["cut_episodes"])
        if "success_rate" in result:
            found["eval/success_rate"] = result["success_rate"]
        return found

    def _keep(self, mean: float, limit: float) -> None:
        """Save the policy as the best. If it cannot be written, the one before stays the best."""
        self.run.require_there()
        try:
            with signals.uninterrupted():
                self.agent.save(self.run.best)
        except CannotWrite as error:
            self.listeners.warn(
                f"The best policy is not saved: {error.what} {error.advice}. Training continues."
            )
        else:
            self.best, self.best_limit = mean, limit

    def snapshot(self) -> tuple[Tensors, dict[str, Any]]:
        """The agent, the best evaluation, and the episodes that are running where they can be continued."""
        self._repetition.before_save()
        tensors, state = self.agent.snapshot()
        episodes = state["episodes"] or {}
        outgrown = [text for text in episodes.get("carried") or () if isinstance(text, str)]
        if outgrown:
            self._repetition.give_up(outgrown[0])
        origins = () if outgrown else episodes.get("origins", ())
        if not self._told_of_long_episodes and any(steps < 0 for _, _, steps in origins):
            self._told_of_long_episodes = True
            self.listeners.info(
                f"An episode is longer than replay_limit {self.settings.replay_limit:,}: it goes on, but a "
                "resume begins a new one in that copy, and its end has other bits than without a break."
            )
        own = {"best": self.best, "best_limit": self.best_limit, "wall_seconds": self.seconds}
        return tensors, {**state, **own}

    def restore(self, point: Checkpoint) -> None:
        """Put back a checkpoint. CheckpointError when it is not what an agent of these settings saved."""
        self.agent.require_spaces(point.state)
        with understood(point.folder):
            self.agent.restore(point.tensors, point.state)
            if self.position != step_of(point.folder):
                raise ValueError(f"its steps are {self.position}, its name says {step_of(point.folder)}")
            best, limit = point.state.get("best"), point.state.get("best_limit")
            self.best = -math.inf if best is None else float(best)
            self.best_limit = math.inf if limit is None else float(limit)
            self.seconds = float(point.state.get("wall_seconds", 0.0))
            lines = self.agent.begin_episodes()
        for line in lines:
            self.listeners.warn(line)
        if lines:
            self._repetition.give_up()

    def roll_back(self, point: Checkpoint) -> None:
        """Put back a checkpoint of this run; the best policy stays."""
        self.agent.roll_back(point.tensors, point.state)

    def finish(self, run: Run) -> dict[str, Any]:
        """The summary."""
        step, seconds = self._begin
        return {
            "env": self.settings.env,
            "algorithm": self.settings.algorithm,
            "seed": self.settings.seed,
            "engine": self.settings.engine,
            "steps": self.position,
            "wall_seconds": self.seconds,
            "steps_per_second": (self.position - step) / max(self.seconds - seconds, 1e-9),
            "run_dir": str(run.path),
            "final": self.final,
            "best_mean_reward": self.best if math.isfinite(self.best) else None,
        }

    def close(self) -> None:
        """Close the environments for evaluation."""
        if self._environments is not None:
            self._environments.close()
