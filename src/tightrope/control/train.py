"""``tightrope train`` and ``tightrope resume``: the loop around an agent that leaves a run folder behind."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tightrope.control.agent import AGENTS, Agent, Progress
from tightrope.control.evaluate import EVALUATION_SEED, evaluate_agent, evaluation_environments
from tightrope.control.resolve import resolve
from tightrope.control.saving import (
    name_again,
    rebuild,
    restore,
    resume_episodes,
    roll_back,
    save_agent,
    snapshot,
)
from tightrope.control.settings import TrainSettings
from tightrope.runs import signals
from tightrope.runs.checkpoint import step_of, understood
from tightrope.runs.durable import CannotWrite
from tightrope.runs.history import steps_in
from tightrope.runs.run import Run
from tightrope.training.grid import crosses
from tightrope.training.report import Reporter, say, silent, teller, warn
from tightrope.training.rollback import rolling_back

__all__ = ["resolve", "resume", "train"]


def train(
    settings: TrainSettings,
    *,
    run_dir: str | Path | None = None,
    report: Reporter = silent,
    env: Any = None,
    policy: Any = None,
) -> dict[str, Any]:
    """Train from the start; returns the summary that is also written to the run folder."""
    for risk in settings.risks():
        warn(report, risk)
    source = settings.env if env is None else env
    agent = AGENTS[settings.algorithm](source, policy=policy, settings=settings, notify=teller(report))
    settings = agent.settings
    name = f"{settings.env}-{settings.algorithm}-{settings.seed}"
    with Run.create(run_dir, settings.to_json(), name, tensorboard=settings.tensorboard) as run:
        if agent.policy.own is not None or not isinstance(source, str):
            # settings.json alone could not give these first weights again
            _save(agent, run, float("-inf"), 0.0, report)
        return _continue(agent, run, settings.total_steps, report, best=float("-inf"), wall=0.0)


def resume(
    run_dir: str | Path,
    *,
    total_steps: int | None = None,
    report: Reporter = silent,
    env: Any = None,
    policy: Any = None,
) -> dict[str, Any]:
    """Go on from the newest checkpoint, or from the start where there is none yet; the end is that of a run
    without a break, bit for bit (docs/resume.md says what that takes).

    ``total_steps`` extends a finished run: schedules and grid run over the new budget from here on.
    """
    with Run.open(run_dir, own=True) as run:
        return _resume(run, total_steps, report, env, policy)


def _resume(run: Run, total_steps: int | None, report: Reporter, env: Any, policy: Any) -> dict[str, Any]:
    run_dir = run.path
    if not steps_in(run.checkpoints) and run.read_metrics():
        warn(report, f"{run_dir} has rows and no checkpoint; it begins at step 0 again.")
    point = run.resume_point(teller(report)) if steps_in(run.checkpoints) else None
    state: dict[str, Any] = {} if point is None else point.state
    with understood(run_dir if point is None else point.folder):
        settings = TrainSettings.from_json(run.settings if point is None else state["settings"])
        own_environment = bool(state.get("own_environment")) or ":" in settings.env
        own_policy = bool(state.get("own_policy"))
        best = float("-inf") if state.get("best") is None else float(state["best"])
        wall = float(state.get("wall_seconds", 0.0))
    if env is None and own_environment:
        raise ValueError(name_again(run_dir, settings.env, "resume"))
    if own_policy and policy is None:
        raise ValueError(
            f"{run_dir} holds a policy module of somebody's own, which no file may import. Go on in Python: "
            f"tightrope.control.train.resume({str(run_dir)!r}, policy=module)."
        )
    # of a run that was extended and stopped before its next checkpoint, settings.json alone knows the budget
    if total_steps is None:
        with understood(run_dir):
            total_steps = int(run.settings["total_steps"])
    settings = settings.with_values(total_steps=total_steps)
    source = settings.env if env is None else env
    more = {"policy": policy, "settings": settings, "notify": teller(report)}
    agent = rebuild(source, run_dir, command="resume", **more)
    if point is not None:
        with understood(point.folder):
            restore(agent, point.tensors, state)
            if agent.steps != step_of(point.folder):
                raise ValueError(f"its steps are {agent.steps}, its name says {step_of(point.folder)}")
            lines = resume_episodes(agent, state)
        for line in lines:
            teller(report)(line)
    run.rewind(point)
    run.update_settings(agent.settings.to_json())
    if agent.steps + settings.num_envs > settings.total_steps:
        say(report, f"{run_dir} has its {settings.total_steps} steps; --total-steps N goes on from there.")
    return _continue(agent, run, settings.total_steps, report, best=best, wall=wall)


def _continue(
    agent: Agent, run: Run, total_steps: int, report: Reporter, *, best: float, wall: float
) -> dict[str, Any]:
    """The loop: update -> record -> evaluate -> save, until the budget is spent."""
    settings, begin, wall_before = agent.settings, agent.steps, wall
    evaluator = _Evaluator(agent, run, report, best)
    report("start", _start(agent, run, total_steps))
    try:
        with signals.stoppable():
            clock = time.perf_counter()
            for progress in _updates(agent, run, total_steps, report):
                wall += time.perf_counter() - clock
                signals.check()
                step, metrics = agent.steps, {**progress.metrics, "time/seconds": wall}
                last = min(step, total_steps - 1)
                if crosses(progress.before, last, total_steps, settings.evaluate_every):
                    metrics |= evaluator.evaluate()
                run.record_episodes(
                    {"step": step, "return": r, "length": n, "terminated": t} for r, n, t in progress.episodes
                )
                run.record(step, wall, metrics)
                report(
                    "update", {"step": step, "total_steps": total_steps, "metrics": metrics, "seconds": wall}
                )
                if progress.on_grid and step + settings.num_envs <= total_steps:  # the end has its own save
                    _save(agent, run, evaluator.best, wall, report)
                clock = time.perf_counter()
            final = evaluator.evaluate()
            _save(agent, run, evaluator.best, wall, report, final=True)
    finally:
        evaluator.close()
        agent.close()
    summary = _summary(agent, run, wall, (agent.steps - begin) / max(wall - wall_before, 1e-9))
    summary |= {"final": final, "best_mean_reward": evaluator.best if math.isfinite(evaluator.best) else None}
    run.finish(summary)
    report("finish", summary)
    return summary


def _updates(agent: Agent, run: Run, total_steps: int, report: Reporter) -> Iterator[Progress]:
    """The agent's updates; after a NaN or an infinity, from the newest checkpoint on, as often as allowed."""
    updates = rolling_back(
        lambda: agent.iterate(total_steps, start=0),
        run,
        lambda point: roll_back(agent, point),
        teller(report),
        taken=agent.rollbacks,
        limit=agent.settings.max_rollbacks,
    )
    for progress in updates:
        if agent.rollbacks:
            progress.metrics["train/rollbacks"] = float(agent.rollbacks)
        yield progress


def _start(agent: Agent, run: Run, total_steps: int) -> dict[str, Any]:
    settings, environments = agent.settings, agent.environments
    workers = f" in {environments.num_workers} processes" if environments.backend == "workers" else ""
    who = f"environments: {environments.num_envs} x {settings.env}, {environments.backend}{workers}"
    lines = [agent.engine_line, who]
    return {
        "settings": settings.to_json(),
        "run_dir": str(run.path),
        "lines": lines,
        "step": agent.steps,
        "total_steps": total_steps,
    }


def _summary(agent: Agent, run: Run, wall: float, rate: float) -> dict[str, Any]:
    settings = agent.settings
    names = ("env", "algorithm", "seed", "engine")
    numbers = {"steps": agent.steps, "wall_seconds": wall, "steps_per_second": rate}
    return {**{name: getattr(settings, name) for name in names}, **numbers, "run_dir": str(run.path)}


class _Evaluator:
    """Periodic evaluation, outside the clock; keeps the best policy. Off when the environment cannot be
    copied.
    """

    def __init__(self, agent: Agent, run: Run, report: Reporter, best: float) -> None:
        self.agent, self.run, self.report, self.best = agent, run, report, best
        self.environments, self.first_state = None, None
        if agent.settings.evaluate_every is None:
            return
        try:
            episodes = agent.settings.evaluation_episodes
            self.environments = evaluation_environments(agent.env, agent.settings, episodes)
        except ValueError as error:
            say(report, f"no evaluation while training: {error}")
            return
        if self.environments.gives_state:
            # what a copy keeps from one evaluation to the next must not change what a resumed run sees
            self.environments.reset(EVALUATION_SEED)
            self.first_state = self.environments.get_state()

    def evaluate(self) -> dict[str, float]:
        if self.environments is None:
            return {}
        self.environments.count_from(0)  # what a resumed run has not seen must not end it sooner or later
        if self.first_state is not None:
            self.environments.set_state(self.first_state)
        result = evaluate_agent(self.agent, self.environments, self.agent.settings.evaluation_episodes)
        metrics = {
            "eval/mean_reward": result["mean_return"],
            "eval/std_reward": result["std_return"],
            "eval/mean_length": result["mean_length"],
            "eval/episodes": float(result["episodes"]),
        }
        self.report("evaluation", {"step": self.agent.steps, **metrics})
        if result["mean_return"] > self.best:
            self._keep(result["mean_return"])
        return metrics

    def _keep(self, mean: float) -> None:
        """Save the policy as the best; where the disk refuses, the best one is still the one before."""
        try:
            with signals.whole():
                save_agent(self.agent, self.run.best)
        except CannotWrite as error:
            warn(self.report, f"The best policy is not saved: {error.what} {error.advice}. Training goes on.")
        else:
            self.best = mean

    def close(self) -> None:
        if self.environments is not None:
            self.environments.close()


def _save(agent: Agent, run: Run, best: float, wall: float, report: Reporter, *, final: bool = False) -> None:
    tensors, state = snapshot(agent)
    state |= {"best": best, "wall_seconds": wall}
    state["episodes"] = agent.collector.state() if agent.steps else None
    keep, say = agent.settings.keep_checkpoints, teller(report)
    run.save(agent.steps, tensors, state, keep=keep, say=say, final=final)
