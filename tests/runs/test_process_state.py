"""Public functions restore the state of the process, even when they raise."""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import os
import random
import signal
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from language.tiny import saved, tiny_llama
from threadpoolctl import threadpool_info

import tightrope
from tightrope.control.evaluate import evaluate_run
from tightrope.control.record import record_run
from tightrope.control.settings import TrainSettings
from tightrope.control.train import resume, train
from tightrope.language.alignment.align import align, resume_align
from tightrope.language.compare import sample_run
from tightrope.language.settings import RewardSettings, SFTSettings
from tightrope.language.supervised.preferences import resume_reward, train_reward
from tightrope.language.supervised.sft import resume_sft, train_sft
from tightrope.training.events import Event, Updated

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGALRM, signal.SIGVTALRM, signal.SIGUSR1, signal.SIGUSR2)


def state() -> dict[str, Any]:
    """The state that a calling program relies on. Torch's random numbers may be used, never seeded."""
    numbers = np.random.get_state(legacy=False)  # noqa: NPY002
    pools = [(x["filepath"], x["num_threads"]) for x in threadpool_info()]
    return {
        "torch threads": torch.get_num_threads(),
        "BLAS threads": sorted(pools),
        "dtype": torch.get_default_dtype(),
        "device": torch.get_default_device(),
        "gradients": torch.is_grad_enabled(),
        "autocast": torch.is_autocast_enabled("cpu"),
        "deterministic": torch.are_deterministic_algorithms_enabled(),
        "precision": torch.get_float32_matmul_precision(),
        "torch seed": torch.initial_seed(),
        "numpy numbers": (numbers["state"]["pos"], numbers["state"]["key"].tolist()),
        "numpy errors": np.geterr(),
        "python numbers": random.getstate(),
        "warnings": list(warnings.filters),
        "shown by": warnings.showwarning,
        "logging": {
            name: (logger.level, logger.disabled)
            for name, logger in [("", logging.getLogger()), *logging.root.manager.loggerDict.items()]
            if isinstance(logger, logging.Logger) and logger.level != logging.NOTSET
        },
        "environment": dict(os.environ),
        "folder": Path.cwd(),
        "signals": [signal.getsignal(number) for number in SIGNALS],
    }


@contextlib.contextmanager
def unchanged() -> Iterator[None]:
    torch.set_num_threads(2)  # left by an earlier run
    before = state()
    yield
    after = state()
    assert {k: (v, after[k]) for k, v in before.items() if after[k] != v} == {}


class Enough(Exception):
    """Ends a run in the middle."""


def stopping(event: Event) -> None:
    if isinstance(event, Updated):
        raise Enough


@pytest.fixture(scope="module", autouse=True)
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


CONTROL = TrainSettings(env="CartPole-v1", num_envs=2, total_steps=256, threads=1).with_values(num_steps=64)


@pytest.fixture(scope="module")
def control(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, so that all first imports and compilations have happened."""
    path = tmp_path_factory.mktemp("control") / "run"
    train(CONTROL, run_dir=path)
    return path


@pytest.mark.parametrize("engine", ["torch", "auto"])
def test_control(tmp_path: Path, control: Path, engine: str) -> None:
    run = tmp_path / "run"
    with unchanged(), pytest.raises(Enough):
        train(CONTROL.with_values(engine=engine), run_dir=run, listeners=[stopping])
    with unchanged(), pytest.raises(Enough):
        resume(run, listeners=[stopping])
    with unchanged():
        resume(run)
    with unchanged(), pytest.raises(ValueError, match="num_envs"):
        train(CONTROL.with_values(num_envs=0))
    with unchanged():
        agent = tightrope.PPO("CartPole-v1", num_envs=2, num_steps=64, threads=1, engine=engine)
        agent.learn(256)
        agent.close()
    with unchanged():
        tightrope.load(run).close()
    with unchanged():
        evaluate_run(run, episodes=2)


@pytest.mark.skipif(importlib.util.find_spec("imageio_ffmpeg") is None, reason="needs tightrope[video]")
def test_recording(control: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "SDL_VIDEODRIVER", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    with contextlib.suppress(ValueError):  # pygame is imported here, and may leave its own variables once
        record_run(control, out=tmp_path / "first.mp4")
    for name in ("SDL_VIDEODRIVER", "MUJOCO_GL"):
        assert name not in os.environ
    with unchanged():
        record_run(control, out=tmp_path / "second.mp4")
    with unchanged(), pytest.raises(ValueError, match="not a run folder|no .*checkpoint|no run"):
        record_run(tmp_path / "nothing")


class Grows(gym.Env):
    """Its frames change their size after two steps."""

    observation_space, action_space = gym.spaces.Box(-1, 1, (1,)), gym.spaces.Discrete(2)
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    render_mode = "rgb_array"

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        return np.zeros(1, np.float32), 1.0, self.t == 5, False, {}

    def render(self) -> Any:
        return np.zeros((32, 32 if self.t < 2 else 48, 3), np.uint8)


@pytest.mark.skipif(importlib.util.find_spec("imageio_ffmpeg") is None, reason="needs tightrope[video]")
def test_frames_that_change_their_size_are_refused(tmp_path: Path) -> None:
    with contextlib.closing(tightrope.PPO(Grows, num_envs=1, num_steps=16, minibatch_size=16)) as agent:
        agent.save(tmp_path / "agent")
    with pytest.raises(ValueError, match="48 x 32 pixels after a frame of 32 x 32"):
        record_run(tmp_path / "agent", env=Grows, out=tmp_path / "film" / "a.mp4")
    assert not list((tmp_path / "film").iterdir())


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> str:
    return saved(tmp_path_factory.mktemp("model"), tiny_llama())


def length(completions: list[str], **_: Any) -> list[float]:
    return [float(len(text)) for text in completions]


def test_alignment(model: str, tmp_path: Path) -> None:
    values = {
        "total_episodes": 16, "batch_size": 8, "minibatch_size": 8, "max_new_tokens": 4, "lora_rank": 2,
        "threads": 1, "checkpoint_every": 0.5, "model": model,
    }  # fmt: skip
    given = {"prompts": ["ab", "cde"], "reward": length}
    align(run_dir=tmp_path / "first", **given, **values)
    run = tmp_path / "run"
    with unchanged(), pytest.raises(Enough):
        align(run_dir=run, listeners=[stopping], **given, **values)
    with unchanged(), pytest.raises(Enough):
        resume_align(run, listeners=[stopping], **given)
    # resume_align itself must set the threads and restore them
    torch.set_num_threads(2)
    seen: list[int] = []
    with unchanged():
        resume_align(run, listeners=[lambda event: seen.append(torch.get_num_threads())], **given)
    assert set(seen) == {1}
    with unchanged(), pytest.raises(ValueError, match="no rows"):
        align(run_dir=tmp_path / "none", prompts=[], reward=length, **values)
    with unchanged():
        sample_run(run, count=2)


@pytest.mark.parametrize("stage", ["sft", "reward"])
def test_supervised(model: str, tmp_path: Path, stage: str) -> None:
    kind, first, again, data = {
        "sft": (SFTSettings, train_sft, resume_sft, [{"prompt": "ab", "completion": "cd"}] * 4),
        "reward": (
            RewardSettings, train_reward, resume_reward,
            [{"prompt": "ab", "chosen": "cd", "rejected": "e"}] * 4,
        ),
    }[stage]  # fmt: skip
    settings = kind(model=model, threads=1, num_epochs=1, minibatch_size=2, max_tokens=16, lora_rank=2)
    first(settings, data=data, run_dir=tmp_path / "first")
    run = tmp_path / "run"
    with unchanged(), pytest.raises(Enough):
        first(settings, data=data, run_dir=run, listeners=[stopping])
    with unchanged():
        again(run, data=data)
    with unchanged(), pytest.raises(ValueError, match="was <list>"):
        again(run)
