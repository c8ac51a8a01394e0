"""Agents on disk: everything an agent needs to act, learn on or be resumed, as tensors and JSON."""

from __future__ import annotations

import dataclasses
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tightrope.algorithms.optimise import optimiser_tensors, restore_optimiser
from tightrope.control.agent import AGENTS, Agent, anywhere
from tightrope.control.settings import TrainSettings
from tightrope.runs import checkpoint
from tightrope.runs.durable import present
from tightrope.runs.history import Checkpoint
from tightrope.runs.records import retyped


def save_agent(agent: Agent, folder: Path) -> Path:
    """Write the agent into ``folder`` as safetensors and JSON. Raises CannotWrite."""
    return checkpoint.save(folder, *snapshot(agent))


def snapshot(agent: Agent) -> tuple[dict[str, dict[str, torch.Tensor]], dict[str, Any]]:
    """Everything that `restore` needs, as tensors and JSON; the tensors are the agent's own."""
    tensors = {"policy": dict(agent.policy.state_dict()), "optimiser": optimiser_tensors(agent.optimiser)}
    normalisers = agent.normalisers.state()
    if normalisers:
        tensors["normalisers"] = normalisers
    state = {
        "settings": agent.settings.to_json(),
        "steps": agent.steps,
        "kl_beta": agent.kl_beta,
        "rollbacks": agent.rollbacks,
        "environment_restarts": agent.environments.restarts,
        "own_policy": agent.policy.own is not None,
        "own_environment": agent.env is not None and not isinstance(agent.env, str),
        "rng": {
            "sampling": agent.sampling_rng.bit_generator.state,
            "update": agent.update_rng.bit_generator.state,
        },
    }
    return tensors, state


def load(
    path: str | Path,
    *,
    env: Any = None,
    policy: Any = None,
    best: bool = False,
    device: str | None = None,
    engine: str | None = None,
) -> Agent:
    """The agent of a run folder (its newest policy, ``best``: its best) or of a folder that ``save`` wrote.

    ``env``: needed when the saved one was no plain Gymnasium id; another id is a warm start.  ``policy``:
    needed when the saved policy was a module of your own.  ``engine``: who computes further updates (auto,
    fused, torch); with another ``device`` it is chosen anew.
    """
    folder, tensors, state = read(Path(path), best=best)
    with checkpoint.understood(folder):
        settings, own_policy = TrainSettings.from_json(state["settings"]), bool(state["own_policy"])
        own_environment = bool(state["own_environment"]) or ":" in settings.env
    if device is not None and device != settings.device:
        settings = settings.with_values(device=device, engine="auto")
    if engine is not None:
        settings = settings.with_values(engine=engine)
    if own_policy and policy is None:
        raise ValueError(
            f"{path} holds a policy module of your own. Pass it again: load({str(path)!r}, policy=module)."
        )
    if env is None and own_environment:
        again = name_again(path, settings.env, "evaluate")
        raise ValueError(f"{again}\nIn Python: load({str(path)!r}, env=...)")
    if env is not None:
        name, rows = (
            env if isinstance(env, str) else settings.env,
            getattr(env, "num_envs", settings.num_envs),
        )
        settings = dataclasses.replace(anywhere(settings), env=name, num_envs=rows)
    agent = rebuild(settings.env if env is None else env, path, policy=policy, settings=settings)
    with checkpoint.understood(folder):
        restore(agent, tensors, state)
    return agent


def name_again(path: str | Path, env: str, command: str) -> str:
    """What to type about a run whose task is the user's own code: no file may say what is imported."""
    registered = "" if ":" in env else " --env-module FILE.py"
    words = f"tightrope {command} {shlex.quote(str(path))} --env {retyped(env, 'ID')}{registered}"
    return (
        f"{path} was trained on {env!r}, a task of somebody's own code, which no file may import. If it is "
        f"yours, or you have read it, name it again:\n{words}"
    )


def rebuild(
    env: Any, path: str | Path, *, settings: TrainSettings, command: str = "evaluate", **more: Any
) -> Agent:
    """An agent for saved settings; a task that is not registered (any more) is answered with what to type."""
    try:
        return AGENTS[settings.algorithm](env, settings=settings, **more)
    except ValueError as error:
        if not str(error).startswith("unknown environment id"):
            raise
        raise ValueError(
            f"{error} {path} was trained on it: where your own code registers it, name that code again: "
            f"tightrope {command} {shlex.quote(str(path))} --env-module FILE.py, or import it in Python."
        ) from error


def read(path: Path, *, best: bool = False) -> Checkpoint:
    """The checkpoint of a run, also while it is written, or of a folder that ``save`` wrote. ValueError where
    there is none.
    """
    if (present(path) / "manifest.json").is_file():
        return Checkpoint(path, *checkpoint.load(path))
    from tightrope.runs.run import Run

    run = Run.open(path)
    if not best:
        return run.newest()
    if not present(run.best).is_dir():
        raise ValueError(f"{path} has no best policy: no evaluation took place. Leave --best out.")
    return Checkpoint(run.best, *checkpoint.load(run.best))


def restore(agent: Agent, tensors: dict[str, dict[str, torch.Tensor]], state: dict[str, Any]) -> None:
    """Put saved tensors and counters into an agent of the same settings."""
    agent.policy.load_state_dict(tensors["policy"])
    restore_optimiser(agent.optimiser, tensors["optimiser"])
    normalisers = dict(tensors.get("normalisers", {}))
    running = normalisers.get("rewards.running")
    if running is not None and len(running) != agent.environments.num_envs:
        normalisers["rewards.running"] = torch.zeros(agent.environments.num_envs, dtype=torch.float64)
    agent.normalisers.load(normalisers)
    beta = state["kl_beta"]
    agent.steps, agent.kl_beta = int(state["steps"]), None if beta is None else float(beta)
    agent.rollbacks = int(state.get("rollbacks", 0))  # none in a run begun before they were
    agent.collector.count_from(max(0, int(state.get("environment_restarts", 0))))
    agent.sampling_rng.bit_generator.state = state["rng"]["sampling"]
    agent.update_rng.bit_generator.state = state["rng"]["update"]


def resume_episodes(agent: Agent, state: dict[str, Any]) -> list[str]:
    """Go on with the episodes that were running at a checkpoint, where its environments could give their
    state; else, in a line, that they begin anew, as they do at this step in a run without a break.
    """
    episodes, seed = state.get("episodes"), agent.settings.seed
    if not agent.steps:
        return []
    if episodes is not None and agent.environments.gives_state:
        agent.collector.restore(episodes)
        agent.fresh = False
        return []
    what = f"{agent.environments.num_envs} environments begin anew at step {agent.steps:,}"
    if episodes is not None:
        return [
            f"warning: {what}: the run's could give their state, these cannot, so that the end may differ."
        ]
    return [f"{what}, with seeds of (seed {seed}, step), as on every point of the checkpoint grid."]


def roll_back(agent: Agent, point: Checkpoint) -> int:
    """Put the agent back to a checkpoint of its own, with random generators on a stream that is a function of
    the seed, the step and the number of rollbacks; returns the step. Environments are as after `resume`;
    their restarts stay counted.
    """
    rollbacks, restarts = agent.rollbacks + 1, agent.environments.restarts
    restore(agent, point.tensors, point.state)
    agent.rollbacks, agent.fresh = rollbacks, True
    agent.collector.count_from(restarts)
    resume_episodes(agent, point.state)
    for k, rng in ((1, agent.sampling_rng), (2, agent.update_rng)):
        other = np.random.default_rng([agent.settings.seed, k, agent.steps, rollbacks])
        rng.bit_generator.state = other.bit_generator.state
    return agent.steps
