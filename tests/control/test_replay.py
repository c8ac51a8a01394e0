"""The file of actions stays small and can be lost; a replay tells how long it takes, and can be left."""

from __future__ import annotations

import os
import shutil
import signal
import time
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from control.test_resume import Killed, assert_same_end, killed, settings_for

import tightrope
from tightrope.cli.main import main
from tightrope.control import train
from tightrope.control.agent import Agent
from tightrope.control.environments.faults import EnvironmentFault
from tightrope.control.rollout import replay
from tightrope.runs import growing, signals
from tightrope.runs.run import Run


def fifth(real: Any) -> Any:
    """A function that ends the run at once in its fifth call."""
    calls = iter(range(1, 6))

    def wrapped(*arguments: Any) -> Any:
        if next(calls) == 5:
            raise Killed
        return real(*arguments)

    return wrapped


OFTEN = {"engine": "torch", "checkpoint_every": 0.01, "evaluate_every": None, "total_steps": 1300}


class Clock(gym.Env):
    """Episodes of 150 steps; what ``at`` holds is called in each step."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (3,), np.float32)
    at: Any = None

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.time = 0
        return self.np_random.normal(size=2).astype(np.float32), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.time += 1
        if Clock.at is not None:
            Clock.at(self)
        return self.np_random.normal(size=2).astype(np.float32), float(action[0]), self.time == 150, False, {}


@pytest.fixture(autouse=True)
def _nothing_happens() -> Any:
    yield
    Clock.at = None


@pytest.fixture
def dead(tmp_path, monkeypatch):
    """A run that was killed in the middle of episodes, and its settings."""
    settings = settings_for(Clock, **{**OFTEN, "total_steps": 600, "checkpoint_every": 0.3})
    killed(settings, tmp_path / "run", monkeypatch, Agent, "_one_update", 4, env=Clock)
    return tmp_path / "run", settings


def test_the_file_holds_no_more_than_twice_what_checkpoints_need(tmp_path, monkeypatch):
    settings = settings_for(Clock, **OFTEN)
    train.train(settings, run_dir=tmp_path / "whole", env=Clock)
    monkeypatch.setattr(growing, "SMALL", 1)
    sizes = []

    def look(event: Any) -> None:
        path = tmp_path / "small" / growing.FILE
        sizes.append(path.stat().st_size if path.exists() else 0)

    train.train(settings, run_dir=tmp_path / "small", env=Clock, listeners=[look])
    step = 4 * (3 + replay.PRINTS) * 4 / 3  # bytes of one copy's step
    # the episodes of the newest checkpoints may be two a copy; and as much again until it has doubled
    assert max(sizes) < 2 * 2 * 4 * 150 * 1.1 * step
    whole, small = (Run.open(tmp_path / name).newest() for name in ("whole", "small"))
    assert whole.state["growing"] == small.state["growing"] and growing.GROUP in small.tensors
    assert (tmp_path / "small" / growing.FILE).stat().st_size < (
        tmp_path / "whole" / growing.FILE
    ).stat().st_size


def test_a_file_that_was_made_smaller_serves_every_checkpoint(tmp_path, monkeypatch):
    settings = settings_for(Clock, **OFTEN)
    train.train(settings, run_dir=tmp_path / "whole", env=Clock)
    monkeypatch.setattr(growing, "SMALL", 1)
    run = tmp_path / "run"
    killed(settings, run, monkeypatch, Agent, "_one_update", 8, env=Clock)
    killed(settings, run, monkeypatch, Run, "_drop_rows", 2, env=Clock)
    newest = Run.open(run).newest().folder
    (newest / "state.json").write_text("{}")  # damaged: an older one serves
    train.resume(run, env=Clock)
    assert_same_end(tmp_path / "whole", run)


def test_a_run_without_its_file_can_be_used_and_learns_on_with_new_episodes(dead):
    run, _ = dead
    (run / growing.FILE).unlink()
    said: list[str] = []
    agent = tightrope.load(run, env=Clock)
    agent.notify = said.append
    agent.learn(100)
    agent.close()
    assert len(said) == 1 and "4 of 4 copies" in said[0] and "its actions are gone" in said[0]


@pytest.mark.parametrize("damage", ["gone", "changed"])
def test_a_resume_without_its_actions_uses_an_older_checkpoint(dead, damage):
    run, settings = dead
    path = run / growing.FILE
    if damage == "gone":
        path.unlink()
    else:
        text = path.read_text()
        place = text.index('"rows": "') + 12
        path.write_text(text[:place] + ("A" if text[place] != "A" else "B") + text[place + 1 :])
    said: list[str] = []
    train.resume(run, env=Clock, listeners=[lambda event: said.append(str(event))])
    told = [line for line in said if line.startswith("warning: Checkpoint passed over")]
    assert len(told) == 1 and "actions.jsonl does not hold the 50 rows of '0.0'" in told[0]
    train.train(settings, run_dir=run.with_name("whole"), env=Clock)
    assert_same_end(run.with_name("whole"), run)


def test_a_long_replay_is_told_once(dead, monkeypatch):
    run, settings = dead
    shutil.copytree(run, run.with_name("quick"))
    said: list[str] = []
    train.resume(run.with_name("quick"), env=Clock, listeners=[lambda event: said.append(str(event))])
    assert not [line for line in said if "repeated" in line]
    monkeypatch.setattr(replay, "TELL_AFTER", 0.0)
    monkeypatch.setattr(replay, "LONG", 0.0)
    train.resume(run, env=Clock, listeners=[lambda event: said.append(str(event))])
    told = [
        line for line in said if line.startswith("The running episodes are repeated, 50 steps in 4 copies")
    ]
    assert len(told) == 1
    train.train(settings, run_dir=run.with_name("whole"), env=Clock)
    assert_same_end(run.with_name("whole"), run)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_replay_at_once_and_loses_nothing(dead, number):
    run, settings = dead
    before = sorted(path.name for path in run.rglob("*"))
    steps = 0

    def strike(env: Clock) -> None:
        nonlocal steps
        steps += 1
        if steps == 30:
            os.kill(os.getpid(), number)

    Clock.at = strike
    with pytest.raises(signals.Stopped) as caught:
        train.resume(run, env=Clock)
    assert caught.value.code == 128 + number and steps == 30
    assert sorted(path.name for path in run.rglob("*")) == before
    Clock.at = None
    train.resume(run, env=Clock)
    train.train(settings, run_dir=run.with_name("whole"), env=Clock)
    assert_same_end(run.with_name("whole"), run)


def test_the_command_that_was_left_in_a_replay_says_how_to_go_on(tmp_path, monkeypatch, capsys):
    run = tmp_path / "run"
    words = ["--total-steps", "600", "--num-envs", "4", "--num-steps", "25", "--minibatch-size", "50"]
    words += ["--engine", "torch", "--checkpoint-every", "0.2", "--run-dir", str(run)]
    with pytest.raises(Killed), monkeypatch.context() as patch:
        patch.setattr(Agent, "_log_ratio_limit", fifth(Agent._log_ratio_limit))
        main(["train", "Pendulum-v1", *words])
    capsys.readouterr()
    with monkeypatch.context() as patch:
        patch.setattr(replay, "replay", lambda *arguments: os.kill(os.getpid(), signal.SIGINT))
        assert main(["resume", str(run)]) == 130
    said = capsys.readouterr().err
    assert "Stopped by SIGINT at step 400. It is saved in" in said
    assert said.endswith(f"Go on with:\n  tightrope resume {run}\n")


@pytest.mark.skipif(not hasattr(signal, "SIGALRM"), reason="interrupts the main thread")
def test_a_step_that_hangs_in_a_replay_ends_with_env_timeout(tmp_path, monkeypatch):
    settings = settings_for(Clock, **{**OFTEN, "env_timeout": 1.0})
    killed(settings, tmp_path / "run", monkeypatch, Agent, "_one_update", 4, env=Clock)
    Clock.at = lambda env: time.sleep(60) if env.time == 20 else None
    begin = time.monotonic()
    with pytest.raises(EnvironmentFault, match="env_timeout"):
        train.resume(tmp_path / "run", env=Clock)
    assert time.monotonic() - begin < 20


@pytest.mark.skipif(not hasattr(signal, "SIGALRM"), reason="interrupts the main thread")
def test_a_copy_that_hangs_in_the_test_of_a_run_ends_with_env_timeout(tmp_path):
    here = os.getpid()
    Clock.at = lambda env: time.sleep(60) if env.time == 60 and os.getpid() != here else None
    said: list[str] = []
    settings = settings_for(Clock, **{**OFTEN, "env_timeout": 1.0})
    begin = time.monotonic()
    train.train(settings, run_dir=tmp_path / "run", env=Clock, listeners=[lambda e: said.append(str(e))])
    told = [line for line in said if line.startswith("Whether episodes repeat is not tested")]
    assert len(told) == 1 and "env_timeout" in told[0]
    assert time.monotonic() - begin < 30
