"""Environments that do to the process what they should not: the run, its folder and its output survive, or
the command ends with a code that is not 0 and says who did it.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

TASKS = """
import ctypes, os, sys, threading, time
import gymnasium as gym, numpy as np

class Task(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (2,))
    action_space = gym.spaces.Discrete(2)
    count = 0
    def __init__(self, **_):
        self.made()
    def made(self):
        pass
    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}
    def step(self, action):
        self.count += 1
        return np.zeros(2, np.float32), 0.0, True, False, {}

class Moves(Task):
    def made(self):
        os.makedirs("elsewhere", exist_ok=True)
        os.chdir("elsewhere")
    def step(self, action):
        if self.count == 20:
            os.chdir("/")
        return super().step(action)

class ClosesStdin(Task):
    def made(self):
        sys.stdin.close()
        try:
            os.close(0)
        except OSError:
            pass

class Chatters(Task):
    def step(self, action):
        print("{not json}")
        os.write(1, b"nor this\\n")
        threading.Thread(target=time.sleep, args=(0.1,)).start()
        return super().step(action)

class HangsWhileMade(Task):
    def made(self):
        time.sleep(60)

class HangsInReset(Task):
    def reset(self, **_):
        time.sleep(60)

class HangsWhileClosed(Task):
    def close(self):
        time.sleep(60)

class EndsWhileMade(Task):
    def made(self):
        os._exit(0)

class EndsInStep(Task):
    def step(self, action):
        if self.count == 3:
            os._exit(0)
        return super().step(action)

class Crashes(Task):
    def step(self, action):
        ctypes.string_at(0)

class EndsLate(Task):
    def step(self, action):
        if self.count == 30:
            os._exit(0)
        return super().step(action)

for kind in list(Task.__subclasses__()):
    gym.register(f"rude/{kind.__name__}-v0", entry_point=kind)
"""
SMALL = (
    "--total-steps 256 --num-envs 2 --num-steps 16 --minibatch-size 16 --engine torch --checkpoint-every 0.2"
)


def tightrope(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """A command in a process of its own, with TASKS."""
    (folder / "tasks.py").write_text(TASKS)
    full = [sys.executable, "-m", "tightrope", *words, "--env-module", "tasks.py"]
    return subprocess.run(full, cwd=folder, capture_output=True, text=True, timeout=100)


def train(folder: Path, task: str, *more: str) -> subprocess.CompletedProcess[str]:
    return tightrope(folder, "train", f"rude/{task}-v0", *SMALL.split(), "--run-dir", "run", *more)


@pytest.mark.parametrize("backend", ["serial", "workers"])
@pytest.mark.parametrize("task", ["Moves", "ClosesStdin", "Chatters"])
def test_the_run_folder_and_the_json_survive(tmp_path: Path, task: str, backend: str) -> None:
    ended = train(tmp_path, task, "--json", "--vector-backend", backend)
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout)["steps"] == 256
    assert {"settings.json", "summary.json", "checkpoints", "best"} <= {
        p.name for p in (tmp_path / "run").iterdir()
    }
    again = tightrope(tmp_path, "evaluate", "run", "--episodes", "4", "--json")
    assert json.loads(again.stdout)["episodes"] == 4, again.stderr


def test_a_run_without_a_name_lies_where_the_command_was_typed(tmp_path: Path) -> None:
    ended = tightrope(tmp_path, "train", "rude/Moves-v0", *SMALL.split(), "--quiet")
    assert ended.returncode == 0, ended.stderr
    assert len(list((tmp_path / "runs").iterdir())) == 1


@pytest.mark.parametrize("backend", ["serial", "workers"])
@pytest.mark.parametrize(
    ("task", "words"),
    [
        ("HangsWhileMade", "Making environment 0 was not back after 2 s"),
        ("HangsInReset", "environment 0"),
        ("HangsWhileClosed", "Closing "),
    ],
)
def test_one_that_hangs_outside_its_steps_is_named(
    tmp_path: Path, task: str, words: str, backend: str
) -> None:
    begin = time.monotonic()
    more = ("--env-timeout", "2", "--vector-backend", backend, "--evaluate-every", "none")
    ended = train(tmp_path, task, *more)
    assert ended.returncode == 2
    assert words in ended.stderr
    assert "env_timeout" in ended.stderr
    assert time.monotonic() - begin < 30


@pytest.mark.skipif(sys.platform != "linux", reason="the child process is forked")
@pytest.mark.parametrize(
    ("task", "how"), [("EndsWhileMade", "exit code 0"), ("EndsInStep", "exit code 0"), ("Crashes", "SIGSEGV")]
)
def test_one_that_ends_its_process_at_once_is_named(tmp_path: Path, task: str, how: str) -> None:
    ended = train(tmp_path, task)
    assert ended.returncode == 2
    assert f"rude/{task}-v0 ended its process" in ended.stderr
    assert how in ended.stderr
    assert not (tmp_path / "run").exists()


def test_one_that_ends_the_run_later_is_told(tmp_path: Path) -> None:
    """In this process nothing can keep it alive; the code is not that of a finished run."""
    ended = train(tmp_path, "EndsLate", "--vector-backend", "serial", "--json")
    assert ended.returncode == 1 and not ended.stdout
    assert "os._exit(0) was called in tasks: the process ends and the run is not finished" in ended.stderr


def test_workers_hold_every_copy(tmp_path: Path) -> None:
    """Those that train, and those that evaluate."""
    ended = train(tmp_path, "EndsLate", "--vector-backend", "workers", "--evaluate-every", "none")
    assert ended.returncode == 2
    assert "has died (exit code 0)" in ended.stderr
