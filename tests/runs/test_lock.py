"""A run has one writer, named in a second writer's error; a killed one does not block; readers never wait."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tightrope.runs.lock import NAME, RunInUse
from tightrope.runs.retention import valid
from tightrope.runs.run import Run

WRITER = """
import sys, time
from pathlib import Path
from tightrope.runs.run import Run

run = Run.open(sys.argv[1]).lock()
if sys.argv[2] == "fork":
    import os
    child = os.fork()
    if child == 0:
        time.sleep(60)
    print("child", child, flush=True)
print("locked", flush=True)
step = 10
while sys.argv[2] == "write":
    run.record(step, 1.0, {"time/fps": 1.0})
    run.save(step, {}, {"step": step}, keep=2, warn=print)
    step += 10
time.sleep(60)
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    with Run.create(tmp_path / "run", {"seed": 1}, "name") as run:
        run.record(5, 1.0, {})
        run.save(5, {}, {"step": 5}, keep=2, warn=print)
    return tmp_path / "run"


def writer(path: Path, what: str = "wait") -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path), what], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    while (line := process.stdout.readline().strip()) != "locked":
        assert line.startswith("child"), line
        process.child = int(line.split()[1])  # type: ignore[attr-defined]
    return process


def end(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.wait()
    assert process.stdout is not None
    process.stdout.close()


def test_a_second_writer_is_refused_with_the_name_of_the_first(path: Path) -> None:
    first = writer(path)
    try:
        before = {p.name: p.read_bytes() for p in path.iterdir() if p.is_file()}
        for write in (
            lambda run: run.lock(),
            lambda run: run.record(10, 1.0, {}),
            lambda run: run.save(10, {}, {}, keep=2, warn=print),
            lambda run: run.rewind(None),
            lambda run: run.resume_point(print, print),
            lambda run: run.update_settings({}),
            lambda run: run.finish({}),
        ):
            with pytest.raises(RunInUse, match=rf"process {first.pid} on .* since 20.*one writer"):
                write(Run.open(path))
        assert {p.name: p.read_bytes() for p in path.iterdir() if p.is_file()} == before
        assert Run.open(path).newest().state["step"] == 5  # readers need no lock
        assert len(Run.open(path).read_metrics()) == 1
    finally:
        end(first)


def test_a_killed_writers_lock_is_stale_at_once_and_recognised(path: Path) -> None:
    first = writer(path)
    end(first)
    told: list[str] = []
    with Run.open(path) as run:
        run.resume_point(told.append, told.append)
        assert len(told) == 1 and f"left without an end by process {first.pid}" in told[0]
    told.clear()
    with Run.open(path) as run:
        run.resume_point(told.append, told.append)
    assert told == []  # the last one gave it back
    assert (path / NAME).read_text() == ""


def test_a_child_that_outlives_a_killed_writer_holds_nothing(path: Path) -> None:
    first = writer(path, "fork")
    end(first)
    child: int = first.child  # type: ignore[attr-defined]
    try:
        os.kill(child, 0)
        begin = time.monotonic()
        while True:
            try:
                Run.open(path).lock().close()
                break
            except RunInUse:  # the child releases the lock when it first runs, which a busy machine may delay
                if time.monotonic() - begin > 10:
                    raise
                time.sleep(0.05)
    finally:
        os.kill(child, signal.SIGKILL)


@pytest.mark.parametrize("content", [None, "", "{", '{"env": "CartPole-v1"}'])
def test_resume_on_the_command_line_names_the_writer_for_any_settings(
    path: Path, content: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    """The process that holds the lock may have written half of their file."""
    from tightrope.cli.main import main

    with Run.open(path).lock():
        if content is not None:
            (path / "settings.json").write_text(content)
        assert main(["resume", str(path)]) == 2
        assert "is being written by this process" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["control", "sft", "reward", "align"])
def test_a_resume_names_the_writer_before_it_reads_anything(path: Path, name: str) -> None:
    """With the lock held by another writer nothing in the folder may be trusted yet."""
    from tightrope.control.train import resume
    from tightrope.language.alignment.align import resume_align
    from tightrope.language.supervised.preferences import resume_reward
    from tightrope.language.supervised.sft import resume_sft

    again = {"control": resume, "sft": resume_sft, "reward": resume_reward, "align": resume_align}[name]
    with Run.open(path).lock():
        (path / "settings.json").write_text("{")
        with pytest.raises(RunInUse, match="this process"):
            again(path)


def test_one_process_has_one_writer_too(path: Path) -> None:
    with Run.open(path).lock() as run:
        run.lock()
        with pytest.raises(RunInUse, match="this process"):
            Run.open(path).lock()
    Run.open(path).lock().close()


def test_a_run_that_is_let_go_is_free_again(path: Path) -> None:
    Run.open(path).lock()  # not closed: no process holds it any more
    Run.open(path).lock().close()


def test_the_lock_is_no_link(path: Path, tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("mine")
    (path / NAME).unlink()
    run = Run.open(path)
    (path / NAME).symlink_to(tmp_path / "precious")
    with pytest.raises(OSError, match=NAME):
        run.lock()
    with pytest.raises(ValueError, match=f"{NAME} is a link"):
        Run.open(path)
    assert (tmp_path / "precious").read_text() == "mine"


def test_a_folder_with_only_a_lock_is_free(tmp_path: Path) -> None:
    (tmp_path / NAME).write_text("")
    Run.create(tmp_path, {"seed": 1}, "name").close()
    with pytest.raises(ValueError, match="not empty"):
        Run.create(tmp_path, {"seed": 1}, "name")


def test_readers_read_while_it_is_written(path: Path) -> None:
    """Checkpoints come and go: each read is complete, and newer than the previous one."""
    first = writer(path, "write")
    try:
        seen, rows, until = [5], 1, time.monotonic() + 60
        while len(set(seen)) < 12 and time.monotonic() < until:
            point = valid(path / "checkpoints", lambda text: pytest.fail(text))
            assert point.state["step"] >= seen[-1]
            seen.append(point.state["step"])
            found = Run.open(path).read_metrics()
            assert [row["step"] for row in found] == [5, *range(10, 10 * len(found), 10)]
            assert len(found) >= rows
            rows = len(found)
        assert first.poll() is None and len(set(seen)) >= 12
    finally:
        end(first)
    with Run.open(path) as run:
        point = run.resume_point(print, print)
        run.rewind(point)
        assert run.read_metrics()[-1]["step"] == point.state["step"]


def test_a_killed_writer_with_the_number_of_this_process_is_not_called_this_process(path: Path) -> None:
    """In containers every run is process 1."""
    note = {"pid": os.getpid(), "host": "box", "started": "2026-01-01 00:00:00"}
    (path / "writer.lock").write_text(json.dumps(note))
    told: list[str] = []
    with Run.open(path, own=True) as run:
        run.resume_point(told.append, told.append)
    assert told == [
        f"the run was left without an end by process {os.getpid()} on box since 2026-01-01 00:00:00"
    ]


@pytest.mark.parametrize("kind", ["pipe", "file"])
def test_a_run_folder_that_is_no_folder(tmp_path: Path, kind: str) -> None:
    place = tmp_path / "run"
    os.mkfifo(place) if kind == "pipe" else place.write_text("x")
    with pytest.raises(ValueError, match="run is there and is not a folder. Give another --run-dir"):
        Run.create(place, {}, "name")
    with pytest.raises(ValueError, match="is not a run folder: it is not a folder"):
        Run.open(place)
