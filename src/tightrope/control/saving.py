"""Agents from a run folder, or from a folder that ``agent.save`` wrote."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tightrope.control.agent import AGENTS, Agent
from tightrope.control.environments.tasks import EnvSource
from tightrope.control.environments.vector import is_vector_env
from tightrope.control.policy.policy import OwnPolicy
from tightrope.control.resolve import anywhere
from tightrope.control.settings import TrainSettings
from tightrope.runs import checkpoint
from tightrope.runs.durable import present
from tightrope.runs.folders import require_kind
from tightrope.runs.records import retyped
from tightrope.runs.retention import Checkpoint


def load(
    path: str | Path,
    *,
    env: EnvSource | None = None,
    env_kwargs: Mapping[str, object] | None = None,
    policy: OwnPolicy | None = None,
    best: bool = False,
    device: str | None = None,
    engine: str | None = None,
) -> Agent:
    """The agent of a run folder (its newest policy, ``best``: its best) or of a folder that ``save`` wrote.

    ``env``: needed when the saved one was no plain Gymnasium id; another id is a warm start.
    ``env_kwargs``: other arguments for the constructor, beside those of the run that they do not name;
    {}: none.
    ``policy``: needed when the saved policy was a module of your own.  ``engine``: who computes further
    updates (auto, fused, torch); with another ``device`` it is chosen again.
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
        python = f"load({str(path)!r}, env=...)"
        raise ValueError(name_again(path, settings.env, "evaluate", python, bool(state["own_environment"])))
    if env is not None:
        name = env if isinstance(env, str) else settings.env
        rows = env.num_envs if is_vector_env(env) else settings.num_envs
        settings = anywhere(settings, env, num_envs=rows).with_values(env=name)
    if env_kwargs:
        settings = settings.with_values(env_kwargs={**(settings.env_kwargs or {}), **env_kwargs})
    elif env_kwargs is not None:
        settings = settings.with_values(env_kwargs=None)
    agent = rebuild(settings.env if env is None else env, path, policy=policy, settings=settings)
    try:
        agent.require_spaces(state)
        with checkpoint.understood(folder):
            agent.restore(tensors, state)
        if env_kwargs is not None or (env is not None and not own_environment):
            agent.forget_episodes()  # a warm start on another task
    except BaseException:
        agent.close()
        raise
    return agent


def name_again(path: str | Path, env: str, command: str, python: str, made: bool) -> str:
    """What to type for a run whose task is the user's code: a file must not name what is imported.

    ``made``: the task was an object or a factory, whose wrappers and arguments no id tells.
    """
    if made:
        return (
            f"{path} was trained on an environment or a factory that was given in Python, called {env!r}. An "
            f"id alone is not the whole task: its wrappers would be missing. If it is yours, "
            f"name it again in Python:\n{python}"
        )
    registered = "" if ":" in env else " --env-module FILE.py"
    words = f"tightrope {command} {shlex.quote(str(path))} --env {retyped(env, 'ID')}{registered}"
    return (
        f"{path} was trained on {env!r}, a task of somebody's own code, which no file may import. If it is "
        f"yours, or you have read it, name it again:\n{words}\nIn Python: {python}"
    )


def rebuild(
    env: EnvSource, path: str | Path, *, settings: TrainSettings, command: str = "evaluate", **more: Any
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
    require_kind(path, run.settings, "train")
    if not best:
        return run.newest()
    if not present(run.best).is_dir():
        raise ValueError(f"{path} has no best policy: no evaluation took place. Leave --best out.")
    return Checkpoint(run.best, *checkpoint.load(run.best))
