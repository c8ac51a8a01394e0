"""A video of the policy at work: rendered off screen, written as mp4."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from tightrope.control.environments import tasks
from tightrope.control.environments.masks import find_source
from tightrope.control.environments.tasks import EnvSource
from tightrope.control.policy.policy import OwnPolicy
from tightrope.control.settings import EVALUATION_SEED, TrainSettings

if TYPE_CHECKING:
    from tightrope.control.agent import Agent

MAX_FRAMES = 10_000
DEFAULT_FPS = 30


def record_run(
    path: str | Path,
    *,
    out: str | Path | None = None,
    best: bool = False,
    episodes: int = 1,
    seed: int | None = None,
    env: EnvSource | None = None,
    env_kwargs: Mapping[str, object] | None = None,
    policy: OwnPolicy | None = None,
) -> dict[str, Any]:
    """Record ``episodes`` deterministic episodes of a run or saved folder; gives path, frames, returns.

    ``out`` None: ``RUN/videos/step-<step>.mp4``. Raises ValueError naming the package or the system library
    that is missing, or when the environment cannot render.
    """
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        raise ValueError("Writing mp4 needs imageio-ffmpeg. Install it: pip install 'tightrope[video]'.")
    from tightrope.control.saving import load

    # absolute: an environment may change the working directory
    whole, target = Path(path).absolute(), None if out is None else Path(out).absolute()
    with (
        _headless(),
        contextlib.closing(
            load(path, env=env, env_kwargs=env_kwargs, policy=policy, best=best, engine="torch")
        ) as agent,
    ):
        task = _renderable(agent.env, agent.settings)
        target = whole / "videos" / f"step-{agent.steps:012d}.mp4" if target is None else target
        target.parent.mkdir(parents=True, exist_ok=True)
        returns, frames = _play(agent, task, target, episodes, EVALUATION_SEED if seed is None else seed)
    return {"path": str(target), "frames": frames, "returns": returns, "step": agent.steps}


@contextlib.contextmanager
def _headless() -> Iterator[None]:
    """On Linux without a display, pygame and MuJoCo draw without one inside; the environment variables that
    say so go again afterwards.
    """
    ours: dict[str, str] = {}
    if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        wanted = {
            "SDL_VIDEODRIVER": "dummy",
            "MUJOCO_GL": "egl",
        }  # MuJoCo's is read when it is first imported
        ours = {name: value for name, value in wanted.items() if name not in os.environ}
    os.environ.update(ours)
    try:
        yield
    finally:
        for name in ours:
            os.environ.pop(name, None)


def _renderable(env: EnvSource, settings: TrainSettings) -> gym.Env:
    """A fresh environment that renders to arrays."""
    name, keywords = settings.env, settings.env_kwargs or {}
    if isinstance(env, str) and env.startswith("ALE/"):
        raise ValueError(
            f"{name} was trained on Atari's vector version (stacked, grey, 84 x 84), which cannot render. "
            "Recording it is not supported yet."
        )
    if isinstance(env, str):
        try:
            return tasks.make_by_id(env, **{**keywords, "render_mode": "rgb_array"})
        except (gym.error.Error, TypeError, ImportError) as error:
            raise _cannot(name, error) from error
    task = env(**keywords) if callable(env) and not isinstance(env, gym.Env) else env
    if isinstance(task, gym.vector.VectorEnv) or getattr(task, "render_mode", None) != "rgb_array":
        raise ValueError(
            f"{name} has render_mode {getattr(task, 'render_mode', None)!r}; recording needs a single "
            "environment made with render_mode='rgb_array'."
        )
    return task


def _cannot(name: str, error: Exception) -> ValueError:
    text = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
    low = str(error).lower()
    if "pygame" in low:
        advice = "Install pygame: pip install 'tightrope[video]'."
    elif any(word in low for word in ("egl", "opengl", "osmesa", "glfw", "gladload", "libgl")):
        advice = (
            "The system library libEGL is missing or cannot be used. Install it (Debian, Ubuntu: apt install "
            "libegl1 libgl1), or OSMesa (apt install libosmesa6) and set MUJOCO_GL=osmesa."
        )
    else:
        advice = "Does the environment support render_mode='rgb_array'?"
    return ValueError(f"{name} cannot be rendered ({text}). {advice}")


def _play(agent: Agent, task: gym.Env, target: Path, episodes: int, seed: int) -> tuple[list[float], int]:
    """Play and write; the file appears only when it is complete."""
    import imageio_ffmpeg

    fps = int(task.metadata.get("render_fps") or DEFAULT_FPS)
    temporary = target.with_name(f".{target.name}.part.mp4")
    writer, size, returns, frames = None, (0, 0), [], 0
    try:
        for episode in range(episodes):
            observation, info = task.reset(seed=seed + episode)
            observed = agent.environments.observation_layout.has_mask
            masks = find_source(task, info, observed, agent.environments.action_layout.num_logits)
            total, over = 0.0, False
            while not over and frames < MAX_FRAMES:
                frame = _frame(task, agent.settings.env)
                if writer is None:
                    size = (frame.shape[1], frame.shape[0])
                    writer = imageio_ffmpeg.write_frames(str(temporary), size, fps=fps, macro_block_size=2)
                    writer.send(None)
                if (frame.shape[1], frame.shape[0]) != size:
                    raise ValueError(
                        f"{agent.settings.env} rendered {frame.shape[1]} x {frame.shape[0]} pixels after a "
                        f"frame of {size[0]} x {size[1]}; a video needs one size; let render() keep it."
                    )
                writer.send(np.ascontiguousarray(frame))
                frames += 1
                action, _ = agent.predict(observation, action_masks=masks.read(observation, info))
                observation, reward, terminated, truncated, info = task.step(action)
                total, over = total + float(reward), bool(terminated or truncated)
            returns.append(total)
    finally:
        if writer is not None:
            writer.close()
        task.close()
        if len(returns) < episodes:
            temporary.unlink(missing_ok=True)
    temporary.replace(target)
    return returns, frames


def _frame(task: gym.Env, name: str) -> np.ndarray:
    try:
        frame = task.render()
    except Exception as error:  # renderers fail in as many ways as there are drivers
        raise _cannot(name, error) from error
    if not isinstance(frame, np.ndarray) or frame.ndim != 3 or frame.shape[2] != 3:
        raise ValueError(
            f"{name} rendered {type(frame).__name__}; expected an RGB array of shape (height, width, 3)."
        )
    return frame.astype(np.uint8, copy=False)
