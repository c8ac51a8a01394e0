"""``tightrope train`` and ``tightrope resume``: the loop around an agent that leaves a run folder behind."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tightrope.control.agent import AGENTS, Agent, Progress
from tightrope.control.evaluate import evaluate_agent, evaluation_environments
from tightrope.control.resolve import resolve
from tightrope.control.saving import rebuild, restore, save_agent, snapshot
from tightrope.control.settings import TrainSettings, settings_from_json, settings_to_json
from tightrope.runs.durable import CannotWrite
from tightrope.runs.run import Run, teller

__all__ = ["resolve", "resume", "train"]

Reporter = Callable[[str, dict[str, Any]], None]


def _silent(event: str, data: dict[str, Any]) -> None:
    """The reporter that says nothing."""


def _notice(report: Reporter) -> Callable[[str], None]:
    return lambda text: report("line", {"text": text})


def train(
    settings: TrainSettings,
    *,
    run_dir: str | Path | None = None,
    report: Reporter = _silent,
    env: Any = None,
    policy: Any = None,
) -> dict[str, Any]:
    """Train from the start; returns the summary that is also written to the run folder."""
    for risk in settings.risks():
        report("line", {"text": f"warning: {risk}"})
    source = settings.env if env is None else env
    agent = AGENTS[settings.algorithm](source, policy=policy, settings=settings, notify=_notice(report))
    settings = agent.settings
    name = f"{settings.env}-{settings.algorithm}-{settings.seed}"
    with Run.create(run_dir, settings_to_json(settings), name, tensorboard=settings.tensorboard) as run:
        return _continue(agent, run, settings.total_steps, report, best=float("-inf"), wall=0.0)


def resume(
    run_dir: str | Path,
    *,
    total_steps: int | None = None,
    report: Reporter = _silent,
    env: Any = None,
    policy: Any = None,
) -> dict[str, Any]:
    """Go on from the newest checkpoint: weights, optimiser, normalisers, random generators, schedules.

    ``total_steps`` extends a finished run. Episodes that were running at the checkpoint begin anew.
    """
    with Run.open(run_dir).lock() as run:
        return _resume(run, total_steps, report, env, policy)


def _resume(run: Run, total_steps: int | None, report: Reporter, env: Any, policy: Any) -> dict[str, Any]:
    run_dir, point = run.path, run.resume_point(teller(report))
    state = point.state
    settings = settings_from_json(state["settings"])
    if env is None and (state["own_environment"] or ":" in settings.env):
        raise ValueError(
            f"{run_dir} was trained on {settings.env!r}, which no file may import. Name your code again: "
            f"tightrope resume {run_dir} --env {settings.env}, with --env-module FILE.py where it is "
            "registered there."
        )
    if total_steps is not None:
        settings = settings.with_values(total_steps=total_steps)
    source = settings.env if env is None else env
    agent = rebuild(source, run_dir, policy=policy, settings=settings, notify=_notice(report))
    restore(agent, point.tensors, state)
    run.rewind(point)
    run.update_settings(settings_to_json(agent.settings))
    if agent.steps + settings.num_envs > settings.total_steps:
        report(
            "line",
            {"text": f"{run_dir} has its {settings.total_steps} steps; --total-steps N goes on from there."},
        )
    best = float("-inf") if state["best"] is None else state["best"]
    return _continue(agent, run, settings.total_steps, report, best=best, wall=state["wall_seconds"])


def _continue(
    agent: Agent, run: Run, total_steps: int, report: Reporter, *, best: float, wall: float
) -> dict[str, Any]:
    """The loop: update -> record -> evaluate -> save, until the budget is spent."""
    settings, begin, wall_before = agent.settings, agent.steps, wall
    evaluator = _Evaluator(agent, run, report, best)
    report("start", _start(agent, run))
    evaluate_at = _Grid(settings.evaluate_every, total_steps, begin)
    save_at = _Grid(settings.checkpoint_every, total_steps, begin)
    interrupt = Interrupt()
    try:
        clock = time.perf_counter()
        for progress in interrupt.between(agent.iterate(total_steps, start=0)):
            wall += time.perf_counter() - clock
            step, metrics = agent.steps, {**progress.metrics, "time/seconds": wall}
            if evaluate_at.due(step):
                metrics |= evaluator.evaluate()
            run.record_episodes(
                {"step": step, "return": r, "length": n, "terminated": t} for r, n, t in progress.episodes
            )
            run.record(step, wall, metrics)
            report("update", {"step": step, "total_steps": total_steps, "metrics": metrics, "seconds": wall})
            if save_at.due(step):
                _save(agent, run, evaluator.best, wall, report)
            clock = time.perf_counter()
        final = evaluator.evaluate()
        _save(agent, run, evaluator.best, wall, report, final=True)
    except KeyboardInterrupt:
        if not interrupt.torn:
            _save(agent, run, evaluator.best, wall, report, final=True)
        raise
    finally:
        evaluator.close()
        agent.close()
    summary = _summary(agent, run, wall, (agent.steps - begin) / max(wall - wall_before, 1e-9))
    summary |= {"final": final, "best_mean_reward": evaluator.best if math.isfinite(evaluator.best) else None}
    run.finish(summary)
    report("finish", summary)
    return summary


def _start(agent: Agent, run: Run) -> dict[str, Any]:
    settings, environments = agent.settings, agent.environments
    workers = f" in {environments.num_workers} processes" if environments.backend == "workers" else ""
    who = f"environments: {environments.num_envs} x {settings.env}, {environments.backend}{workers}"
    lines = [agent.engine_line, who]
    return {
        "settings": settings_to_json(settings),
        "run_dir": str(run.path),
        "lines": lines,
        "step": agent.steps,
    }


def _summary(agent: Agent, run: Run, wall: float, rate: float) -> dict[str, Any]:
    settings = agent.settings
    names = ("env", "algorithm", "seed", "engine")
    numbers = {"steps": agent.steps, "wall_seconds": wall, "steps_per_second": rate}
    return {**{name: getattr(settings, name) for name in names}, **numbers, "run_dir": str(run.path)}


class Interrupt:
    """Ctrl-C waits for the end of the update under way, so that what is saved is whole; a second one does not
    wait.
    """

    def __init__(self) -> None:
        self.asked, self.torn = False, False

    def _ask(self, number: int, frame: Any) -> None:
        if self.asked:
            self.torn = True  # in the middle of an update: what is there now must not be saved
            raise KeyboardInterrupt
        self.asked = True

    def between(self, updates: Iterator[Progress]) -> Iterator[Progress]:
        """The updates, and KeyboardInterrupt after the first that was under way when Ctrl-C came."""
        if threading.current_thread() is not threading.main_thread():
            yield from updates  # only the main thread may handle signals
            return
        before = signal.signal(signal.SIGINT, self._ask)
        try:
            for progress in updates:
                yield progress
                if self.asked:
                    raise KeyboardInterrupt
        finally:
            signal.signal(signal.SIGINT, before)


class _Evaluator:
    """Periodic evaluation, outside the clock; keeps the best policy. Off when the environment cannot be
    copied.
    """

    def __init__(self, agent: Agent, run: Run, report: Reporter, best: float) -> None:
        self.agent, self.run, self.report, self.best = agent, run, report, best
        self.environments = None
        if agent.settings.evaluate_every is None:
            return
        try:
            episodes = agent.settings.evaluation_episodes
            self.environments = evaluation_environments(agent.env, agent.settings, episodes)
        except ValueError as error:
            report("line", {"text": f"no evaluation while training: {error}"})

    def evaluate(self) -> dict[str, float]:
        if self.environments is None:
            return {}
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
            save_agent(self.agent, self.run.best)
        except CannotWrite as error:
            text = f"warning: The best policy is not saved: {error.what} {error.advice}. Training goes on."
            self.report("line", {"text": text})
        else:
            self.best = mean

    def close(self) -> None:
        if self.environments is not None:
            self.environments.close()


class _Grid:
    """Steps at which something is due: multiples of a fraction of the run, the end left out."""

    def __init__(self, fraction: float | None, total_steps: int, past: int) -> None:
        count = 0 if fraction is None else int(1.0 / fraction)
        points = [round(total_steps * (fraction or 0.0) * k) for k in range(1, count + 1)]
        self.ahead = [point for point in points if past < point < total_steps]

    def due(self, step: int) -> bool:
        """Whether a point has been reached; several passed at once count as one."""
        reached = bool(self.ahead) and step >= self.ahead[0]
        self.ahead = [point for point in self.ahead if point > step]
        return reached


def _save(agent: Agent, run: Run, best: float, wall: float, report: Reporter, *, final: bool = False) -> None:
    tensors, state = snapshot(agent)
    state |= {"best": best, "wall_seconds": wall}
    keep, say = agent.settings.keep_checkpoints, teller(report)
    run.save(agent.steps, tensors, state, keep=keep, say=say, final=final)
