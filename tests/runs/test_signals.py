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


# ---------------------------------------------------------------------------- real processes

SLOW_SAVE = """
import os, sys, time
from tightrope.runs import durable
real = durable.put
def slow(temporary, folder):
    print("SAVING", flush=True)
    time.sleep(float(os.environ.get("SLOW", "0")))
    real(temporary, folder)
durable.put = slow
from tightrope.cli.main import main
sys.exit(main(sys.argv[1:]))
"""
TRAIN = [
    "train", "Pendulum-v1", "--total-steps", "2_000_000", "--num-envs", "4", "--num-steps", "50",
    "--minibatch-size", "100", "--engine", "torch", "--vector-backend", "workers", "--num-workers", "2",
    "--evaluate-every", "none", "--checkpoint-every", "0.0002",
]  # fmt: skip


def children(pid: int) -> list[int]:
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


@contextlib.contextmanager
def started(run: Path, slow: float) -> Iterator[subprocess.Popen]:
    """A run in its own process, which always ends with the test."""
    pipe, environment = subprocess.PIPE, {**os.environ, "SLOW": str(slow)}
    words = [sys.executable, "-c", SLOW_SAVE, *TRAIN, "--run-dir", str(run)]
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
    with started(run, slow=0.5) as process:
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
    said = re.search(r"Stopped by (\w+) at step ([\d,]+)\. The newest valid checkpoint is (.*); 0 steps", err)
    assert said is not None and said[1] == number.name and said[3].endswith(saved[-1]), err
    command = shlex.split(err.strip().splitlines()[-1])
    assert command == ["tightrope", "resume", str(run)]
    assert not any(alive(pid) for pid in workers)


def test_a_second_signal_leaves_the_older_checkpoint_and_no_temporaries(tmp_path):
    with started(tmp_path / "run", slow=600) as process:
        until(process, "SAVING")
        process.send_signal(signal.SIGTERM)
        time.sleep(0.5)
        assert process.poll() is None, "the first one waits for the save"
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate(timeout=300)
    assert process.returncode == 143 and "There is no checkpoint yet" in err
    assert not any((tmp_path / "run" / "checkpoints").iterdir())
