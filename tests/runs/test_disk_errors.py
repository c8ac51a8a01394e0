"""A full, read-only or forbidden disk does not cost anything already saved; the error gives advice."""

from __future__ import annotations

import contextlib
import errno
import os
import resource
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from tightrope.runs import checkpoint
from tightrope.runs.durable import CannotWrite
from tightrope.runs.run import Run

KEEP = {"keep": 2, "warn": lambda text: None}


def tensors(step: int, size: int = 600) -> dict[str, dict[str, torch.Tensor]]:
    return {"policy": {"w": torch.full((size,), float(step))}, "optimiser": {"m": torch.zeros(size)}}


def begun(path: Path) -> Run:
    run = Run.create(path, {"seed": 1}, "name")
    for step in (10, 20):
        update(run, step)
        run.save(step, tensors(step), {"step": step}, **KEEP)
    return run


def update(run: Run, step: int) -> None:
    run.record(step, 1.0, {"time/fps": 1.0})
    run.record_episodes([{"step": step, "return": 1.0}])


def check(run: Run, newest: int) -> None:
    """The run continues from ``newest``, with every row up to it once, and nothing half-written."""
    run.close()
    with Run.open(run.path) as again:
        point = again.resume_point(pytest.fail, pytest.fail)
        assert point.state["step"] == newest
        assert torch.equal(point.tensors["policy"]["w"], tensors(newest)["policy"]["w"])
        again.rewind(point)
        assert [row["step"] for row in again.read_metrics()] == list(range(10, newest + 1, 10))
        assert [row["step"] for row in again.read_episodes()] == list(range(10, newest + 1, 10))
        update(again, newest + 10)
        again.save(newest + 10, tensors(1), {"step": newest + 10}, **KEEP)
        names = [p.name for p in run.path.rglob("*")]
        assert not [name for name in names if name.startswith(".")]


@contextlib.contextmanager
def room(patch: pytest.MonkeyPatch, size: int) -> Iterator[None]:
    """The disk accepts ``size`` more bytes; the write that exceeds them is short, or refused."""
    write, left = os.write, [size]

    def refusing(descriptor: int, content: Any) -> int:
        if not left[0]:
            raise OSError(errno.ENOSPC, "No space left on device")
        count = write(descriptor, content[: left[0]])
        left[0] -= count
        return count

    with patch.context() as inside:
        inside.setattr(os, "write", refusing)
        yield


@pytest.mark.parametrize("part", range(4))
def test_a_disk_that_is_full_at_any_byte(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: int) -> None:
    """Fifty points, spread over all writes of an update and a save."""
    sizes = [200 * place + 3 for place in range(part, 52, 4)]
    failed = 0
    for size in sizes:
        run = begun(tmp_path / str(size))
        try:
            with room(monkeypatch, size):
                update(run, 30)
                run.save(30, tensors(30), {"step": 30}, **KEEP, final=True)
        except CannotWrite as error:
            failed += 1
            assert error.errno == errno.ENOSPC and str(run.path) in str(error)
            assert "No space left on device" in str(error) and "Make room on the disk" in str(error)
            check(run, 20)
        else:
            check(run, 30)
    assert len(sizes) > failed > len(sizes) // 2  # the last points are after the end


def test_a_line_that_found_no_room_leaves_whole_lines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = begun(tmp_path / "run")
    before = (run.path / "metrics.jsonl").read_bytes()
    with room(monkeypatch, 5), pytest.raises(CannotWrite, match=r"metrics\.jsonl cannot be written"):
        update(run, 30)
    assert (run.path / "metrics.jsonl").read_bytes() == before
    update(run, 30)
    assert [row["step"] for row in run.read_metrics()] == [10, 20, 30]
    run.close()


@contextlib.contextmanager
def small_disk(path: Path) -> Iterator[str]:
    """A real file system of 256 KB if this process may mount one, else a real file limit of 40 KB."""
    path.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(path)]
    try:
        mounted = subprocess.run(command, capture_output=True).returncode == 0
    except OSError:
        mounted = False
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    if not mounted:
        resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, before[1]))
    try:
        yield "No space left on device" if mounted else "File too large"
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        if mounted:
            subprocess.run(["umount", str(path)], check=True)


def test_a_small_disk_that_is_filled_by_a_save(tmp_path: Path) -> None:
    told: list[str] = []
    with small_disk(tmp_path / "disk") as reason:
        run = begun(tmp_path / "disk" / "run")
        update(run, 30)
        run.save(30, tensors(30, 50_000), {"step": 30}, keep=2, warn=told.append)
        assert len(told) == 1 and reason in told[0] and "step-000000000030 cannot be written" in told[0]
        with pytest.raises(CannotWrite, match=reason):
            run.save(30, tensors(30, 50_000), {"step": 30}, keep=2, warn=told.append, final=True)
        check(run, 20)


@pytest.mark.parametrize(
    ("number", "advice"), [(errno.EROFS, "mounted for writing"), (errno.EACCES, "permission")]
)
def test_a_folder_that_may_no_longer_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, advice: str
) -> None:
    """Refuses calls as the system does, because root may write anywhere."""
    run, opened = begun(tmp_path / "run"), os.open
    before = {p: p.read_bytes() for p in run.path.rglob("*") if p.is_file()}

    def refuse(*args: Any, **more: Any) -> Any:
        raise OSError(number, os.strerror(number), str(args[0]))

    def reading(path: Any, flags: int, *args: Any, **more: Any) -> int:
        return refuse(path) if flags & (os.O_WRONLY | os.O_RDWR) else opened(path, flags, *args, **more)

    told: list[str] = []
    with monkeypatch.context() as patch:
        patch.setattr(os, "open", reading)
        for name in ("mkdir", "rename", "replace", "unlink", "rmdir"):
            patch.setattr(os, name, refuse)
        run.save(30, tensors(30), {"step": 30}, keep=2, warn=told.append)
        assert len(told) == 1 and advice in told[0] and os.strerror(number) in told[0]
        for write in (
            lambda: run.save(30, tensors(30), {}, **KEEP, final=True),
            lambda: run.record_samples([{"step": 30}]),
            lambda: run.update_settings({"seed": 2}),
            lambda: Run.create(tmp_path / "new", {}, "name"),
            lambda: checkpoint.save(run.best, tensors(30), {}),
        ):
            with pytest.raises(CannotWrite, match=advice):
                write()
        with pytest.raises(CannotWrite, match=advice):
            run.finish({})
        assert not (run.path / "summary.json").exists()
        run.close()
        with pytest.raises(CannotWrite, match=advice):
            Run.open(run.path).lock()
        assert Run.open(run.path).newest().state["step"] == 20  # readers still work
    after = {p: p.read_bytes() for p in run.path.rglob("*") if p.is_file()}
    assert {p.name for p in after} == {p.name for p in before}
    assert {k: v for k, v in after.items() if k.name != "writer.lock"} == {
        k: v for k, v in before.items() if k.name != "writer.lock"
    }
    check(run, 20)
