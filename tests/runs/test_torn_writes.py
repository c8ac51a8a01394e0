"""A save that is interrupted anywhere leaves the complete old checkpoint or the complete new one.

Every operation of a save is recorded. The folder is rebuilt as a crash after each operation may leave it:
with everything, without the unflushed bytes, or without the unflushed names (`disk.py`).
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
import torch
from disk import Disk

from tightrope.runs import checkpoint, durable, retention
from tightrope.runs.run import Run


def tensors(step: int) -> dict[str, dict[str, torch.Tensor]]:
    return {"policy": {"w": torch.full((5,), float(step)), "b": torch.arange(3)}}


def silent(text: str) -> None:
    raise AssertionError(text)


def test_cut_anywhere_a_fresh_save_leaves_the_older_or_the_newer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "checkpoints"
    checkpoint.save(checkpoint.step_folder(root, 100), tensors(100), {"step": 100})
    with monkeypatch.context() as patch:
        disk = Disk(patch, root)
        checkpoint.save(checkpoint.step_folder(root, 200), tensors(200), {"step": 200})
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)  # of the rebuilt folder
    found = []
    for count, lost, place in disk.states(tmp_path / "after"):
        point = retention.valid(place, silent)  # a torn one would be reported
        assert torch.equal(point.tensors["policy"]["w"], torch.full((5,), float(point.state["step"])))
        found.append((count, lost, point.state["step"]))
        durable.remove_leftovers(place)
        assert retention.valid(place, silent).state == point.state
        assert not [p.name for p in place.iterdir() if p.name.startswith(".")]
    assert {step for _, _, step in found} == {100, 200}
    assert {step for count, _, step in found if count == len(disk.log)} == {200}  # returned: it is safe
    assert len(found) > 60


@pytest.mark.parametrize("name", ["best", "step-000000000007"])
def test_cut_anywhere_a_replacement_leaves_the_old_or_the_new(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    root = tmp_path / "run"
    checkpoint.save(root / name, tensors(1), {"version": 1})
    with monkeypatch.context() as patch:
        disk = Disk(patch, root)
        checkpoint.save(root / name, tensors(2), {"version": 2})
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)
    found = []
    for count, lost, place in disk.states(tmp_path / "after"):
        found.append((count, lost, checkpoint.load(place / name)[1]["version"]))
        if name != "best":
            assert retention.valid(place, silent).state["version"] == found[-1][2]
        durable.remove_leftovers(place)
        assert checkpoint.load(place / name)[1]["version"] == found[-1][2]
        assert [p.name for p in place.iterdir()] == [name]
    assert {version for _, _, version in found} == {1, 2}
    assert {version for count, _, version in found if count == len(disk.log)} == {2}


def test_cut_anywhere_a_run_continues_with_no_row_twice_and_none_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, rows = tmp_path / "run", {}

    def go_on(run: Run, steps: list[int]) -> None:
        for step in steps:
            run.record(step, step / 10, {"time/fps": 1.0})
            run.record_episodes([{"step": step, "return": 1.0}] * (step // 10))
            rows[step] = [(root / name).read_bytes() for name in ("metrics.jsonl", "episodes.jsonl")]
            run.save(step, tensors(step), {"step": step}, keep=2, warn=silent)

    with Run.create(root, {"seed": 1}, "name") as run:
        go_on(run, [10, 20])
    with monkeypatch.context() as patch, Run.open(root) as run:
        disk = Disk(patch, root)
        go_on(run, [30, 40])  # pruning included
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)
    last = 0
    for count, lost, place in disk.states(tmp_path / "after"):
        with Run.open(place) as run:
            point = run.resume_point(silent, print)
            run.rewind(point)
            step = point.state["step"]
            assert [(place / n).read_bytes() for n in ("metrics.jsonl", "episodes.jsonl")] == rows[step]
        assert len(retention.steps_in(place / "checkpoints")) >= 2
        last = step if (count, lost) == (len(disk.log), "names") else last
    assert last == 40


def test_the_disk_of_these_tests_loses_what_is_not_synced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the fsyncs of a save the same test fails: it can detect the loss."""
    root = tmp_path / "checkpoints"
    checkpoint.save(checkpoint.step_folder(root, 100), tensors(100), {})
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        disk = Disk(patch, root)
        disk.log.clear()
        checkpoint.save(checkpoint.step_folder(root, 200), tensors(200), {})
    disk.log = [entry for entry in disk.log if entry[0] != "fsync"]
    torn = []
    for _, lost, place in disk.states(tmp_path / "after"):
        retention.valid(place, lambda text, lost=lost: torn.append(lost))
    assert {"bytes", "half of the bytes"} <= set(torn)
    shutil.rmtree(root)
