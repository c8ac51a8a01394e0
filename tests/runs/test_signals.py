"""SIGINT and SIGTERM in real processes: their exceptions, and the messages of a stopped run."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tightrope.cli.main import main
from tightrope.cli.train_commands import farewell
from tightrope.runs import signals

BOTH = pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])


@BOTH
def test_a_signal_stops_at_once_with_its_exit_code(number, code):
    before = signal.getsignal(number)
    with pytest.raises(signals.Stopped) as caught, signals.stoppable(), signals.stoppable():
        os.kill(os.getpid(), number)
        time.sleep(5)
        pytest.fail("it went on")
    assert caught.value.code == code
    assert signal.getsignal(number) == before


def test_a_save_is_finished_first():
    steps = []
    with pytest.raises(signals.Stopped), signals.stoppable(), signals.uninterrupted():
        with signals.uninterrupted():
            os.kill(os.getpid(), signal.SIGTERM)
            steps.append("inner")
        steps.append("outer")
    assert steps == ["inner", "outer"]


def test_a_second_signal_does_not_wait():
    with pytest.raises(signals.Stopped) as caught, signals.stoppable(), signals.uninterrupted():
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGINT)
        pytest.fail("it went on")
    assert caught.value.code == 130


def test_what_can_be_left_at_any_moment_is_left_at_once():
    steps = []
    with pytest.raises(signals.Stopped), signals.stoppable(), signals.uninterrupted():
        with signals.interruptible():
            os.kill(os.getpid(), signal.SIGTERM)
            pytest.fail("it went on")
        steps.append("after")
    assert not steps
    with pytest.raises(signals.Stopped), signals.stoppable(), signals.uninterrupted():
        os.kill(os.getpid(), signal.SIGTERM)
        with signals.interruptible():
            pytest.fail("it began")


@pytest.mark.parametrize("before", [False, True], ids=["inside", "just before"])
@pytest.mark.parametrize(
    ("seconds", "can_undo", "waits", "told"),
    [
        (3.0, True, True, "about 3 s more"), (3.0, False, True, "about 3 s more"), (0.5, True, True, ""),
        (1000.0, True, False, ""), (1000.0, False, True, "about 1,000 s more"),
        (None, True, False, ""), (None, False, True, "finished first. A second"),
    ],
)  # fmt: skip
def test_work_is_waited_for_unless_it_is_long_and_can_be_undone(
    capsys, seconds, can_undo, waits, told, before
):
    steps = []
    with pytest.raises(signals.Stopped), signals.stoppable(), signals.uninterrupted():
        if before:
            os.kill(os.getpid(), signal.SIGINT)
        with signals.uninterrupted("the update under way", seconds, can_undo=can_undo):
            if not before:
                os.kill(os.getpid(), signal.SIGINT)
            steps.append("done")
    assert bool(steps) == waits
    said = capsys.readouterr().err
    assert told in said and bool(said) == bool(told)


def test_what_swallows_a_signal_is_stopped_at_the_next_update():
    with pytest.raises(signals.Stopped), signals.stoppable():
        with contextlib.suppress(BaseException):  # as a reward function may
            os.kill(os.getpid(), signal.SIGINT)
        signals.raise_if_stopped()
    signals.raise_if_stopped()  # outside, and later, nothing is left of it


def test_before_a_run_and_without_a_checkpoint(tmp_path):
    error = signals.Stopped(signal.SIGTERM)
    assert farewell(error, None, 0, "steps", "") == "Stopped by SIGTERM before the run began."
    said = farewell(KeyboardInterrupt(), str(tmp_path), 1200, "responses", "tightrope resume r")
    assert said.startswith("Stopped at response 1,200. There is no checkpoint yet: all 1,200 responses")


def test_a_second_signal_in_the_first_evaluation_tells_which_steps_were_done(tmp_path, monkeypatch, capsys):
    def stopped(*arguments, **keywords):
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr("tightrope.control.train.evaluate_agent", stopped)
    monkeypatch.setattr("tightrope.runs.run.Run.save", stopped)
    words = ["--num-envs", "2", "--num-steps", "64", "--minibatch-size", "64", "--total-steps", "512"]
    assert main(["train", "CartPole-v1", *words, "--run-dir", str(tmp_path / "run")]) == 130
    said = capsys.readouterr().err
    assert (
        "Stopped by SIGINT at step 128. There is no checkpoint yet: all 128 steps will be repeated." in said
    )


# ---------------------------------------------------------------------------- real processes

SLOW = """
import os, pkgutil, sys, time
path, word, seconds = os.environ["SLOW"].split()
owner, name = path.rsplit(".", 1)
place = pkgutil.resolve_name(owner)
real = getattr(place, name)
def slow(*arguments, **keywords):
    print(word, flush=True)
    time.sleep(float(seconds))
    return real(*arguments, **keywords)
setattr(place, name, slow)
from tightrope.__main__ import run
run()
"""
SAVING = "tightrope.runs.durable.put SAVING"
COLLECTING = "tightrope.control.environments.pool.EnvironmentPool.receive COLLECTING 0.01"
UPDATING = "tightrope.algorithms.ppo.update UPDATING 0.5"
EVALUATING = "tightrope.control.rollout.evaluation.evaluate_agent EVALUATING 600"
TRAIN = [
    "train", "Pendulum-v1", "--total-steps", "2_000_000", "--num-envs", "4", "--num-steps", "50",
    "--minibatch-size", "100", "--engine", "torch", "--vector-backend", "workers", "--num-workers", "2",
    "--keep-checkpoints", "none",
]  # fmt: skip


def children(pid: int) -> list[int]:
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


@contextlib.contextmanager
def started(run: Path, slow: str, *more: str) -> Iterator[subprocess.Popen]:
    """A run in its own process, which always ends with the test. ``slow``: a function, the word to print when
    it is called, and the seconds to wait there.
    """
    pipe, environment = subprocess.PIPE, {**os.environ, "SLOW": slow}
    more = more or ("--evaluate-every", "none", "--checkpoint-every", "0.0002")
    words = [sys.executable, "-c", SLOW, *TRAIN, "--run-dir", str(run), *more]
    with subprocess.Popen(words, stdout=pipe, stderr=pipe, text=True, env=environment) as process:
        try:
            yield process
        finally:
            process.kill()


def allowed(seconds: float) -> float:
    """Seconds on an idle machine, scaled to the load of this one."""
    return seconds * max(1.0, os.getloadavg()[0] / len(os.sched_getaffinity(0)))


def until(process: subprocess.Popen, word: str, times: int = 1) -> None:
    for line in process.stdout:
        times -= word in line
        if not times:
            return
    raise AssertionError(process.stderr.read())


@BOTH
def test_a_stopped_run_finishes_its_save_and_names_everything(tmp_path, number, code):
    run = tmp_path / "a run"
    with started(run, f"{SAVING} 0.5") as process:
        until(process, "SAVING", 2)
        workers = children(process.pid)
        assert workers
        process.send_signal(number)
        begin = time.monotonic()
        _, err = process.communicate(timeout=300)
    assert time.monotonic() - begin < allowed(10)
    assert process.returncode == code, err
    saved = sorted(path.name for path in (run / "checkpoints").iterdir())
    assert len(saved) == 2 and not list(run.rglob(".*")), "the save under way is whole, and nothing else is"
    said = re.search(r"Stopped by (\w+) at step ([\d,]+)\. It is saved in (.*); what was", err)
    assert said is not None and said[1] == number.name and said[3].endswith(saved[-1]), err
    assert "SIGINT: the save under way" in err or "SIGTERM: the save under way" in err
    command = shlex.split(err.strip().splitlines()[-1])
    assert command == ["tightrope", "resume", str(run)]
    assert not any(alive(pid) for pid in workers)


def test_a_second_signal_leaves_the_older_checkpoint_and_no_temporaries(tmp_path):
    with started(tmp_path / "run", f"{SAVING} 600") as process:
        until(process, "SAVING")
        process.send_signal(signal.SIGTERM)
        time.sleep(0.5)
        assert process.poll() is None, "the first one waits for the save"
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate(timeout=300)
    assert process.returncode == 143 and "There is no checkpoint yet" in err
    assert not any((tmp_path / "run" / "checkpoints").iterdir())


@pytest.mark.parametrize("phase", [COLLECTING, UPDATING, EVALUATING], ids=lambda phase: phase.split()[1])
def test_a_stopped_run_saves_its_newest_update(tmp_path, phase):
    run, word = tmp_path / "run", phase.split()[1]
    with started(run, phase, "--checkpoint-every", "none", "--evaluate-every", "0.0002") as process:
        until(process, word, {"COLLECTING": 70, "UPDATING": 2, "EVALUATING": 1}[word])
        process.send_signal(signal.SIGTERM)
        begin = time.monotonic()
        _, err = process.communicate(timeout=300)
    assert time.monotonic() - begin < allowed(10)
    assert process.returncode == 143, err
    step = 200 if word == "COLLECTING" else 400
    assert [path.name for path in (run / "checkpoints").iterdir()] == [f"step-{step:012d}"]
    assert f"Stopped by SIGTERM at step {step}. It is saved in {run}" in err


def test_ctrl_c_while_the_command_starts_prints_no_traceback():
    """From the first line of our own code on; what Python does before it is Python's."""
    script = (
        "import sys; from tightrope.__main__ import run; import os, signal, threading, time\n"
        "class Late:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'tightrope.cli.main':\n"
        "            os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Late())\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "run()\n"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300)
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "")


TASK = """
import threading, time
import gymnasium
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
class Threads(CartPoleEnv):
    def __init__(self):
        super().__init__()
        threading.Thread(target=time.sleep, args=(600,), name="left behind").start()
gymnasium.register("Threads-v0", Threads)
"""


def test_a_thread_that_an_environment_leaves_does_not_keep_the_process(tmp_path):
    (tmp_path / "task.py").write_text(TASK)
    words = ["train", "Threads-v0", "--total-steps", "64", "--num-envs", "1"]
    words += ["--num-steps", "64", "--minibatch-size", "64", "--engine", "torch", "--evaluate-every", "none"]
    words += ["--run-dir", str(tmp_path / "run"), "--json", "--env-module", str(tmp_path / "task.py")]
    script = "import tightrope.__main__ as m; m.SECONDS_TO_END = 0.2; m.run()"
    run = [sys.executable, "-c", script, *words]
    ended = subprocess.run(run, capture_output=True, text=True, timeout=300)
    assert ended.returncode == 0, ended.stderr
    assert '"steps": 64' in ended.stdout
    assert "the process ends without waiting for the threads left behind" in ended.stderr
