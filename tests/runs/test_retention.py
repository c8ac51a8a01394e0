"""The newest checkpoints and the best one stay; none is deleted before a newer one has been read back."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest
import torch

from tightrope.runs import checkpoint, retention
from tightrope.runs.checkpoint import CheckpointError
from tightrope.runs.durable import CannotWrite
from tightrope.runs.run import Run


def steps(run: Run) -> list[int]:
    return [checkpoint.step_of(folder) for folder in retention.steps_in(run.checkpoints)]


def save(run: Run, step: int, told: list[str], **more: Any) -> None:
    run.save(
        step, {"policy": {"w": torch.ones(2)}}, {"step": step}, **{"keep": 2, "warn": told.append, **more}
    )


@pytest.fixture
def run(tmp_path: Path) -> Any:
    with Run.create(tmp_path / "run", {"seed": 1}, "name") as made:
        yield made


@pytest.mark.parametrize(("keep", "left"), [(2, [40, 50]), (3, [30, 40, 50]), (None, [10, 20, 30, 40, 50])])
def test_the_newest_are_kept(run: Run, keep: int | None, left: list[int]) -> None:
    for step in (10, 20, 30, 40, 50):
        save(run, step, [], keep=keep)
    assert steps(run) == left
    assert len(list(run.checkpoints.iterdir())) == len(left)


def test_the_best_is_kept_and_of_equals_the_first(run: Run) -> None:
    for step, merit in [(10, None), (20, 0.5), (30, 0.9), (40, 0.9), (50, float("nan")), (60, 0.1)]:
        save(run, step, [], merit=merit)
    assert steps(run) == [30, 50, 60]
    save(run, 70, [], merit=2.0)
    save(run, 80, [])
    save(run, 90, [])
    assert steps(run) == [70, 80, 90]


FAILURES = {
    "mkdir": "tightrope.runs.durable.Path.mkdir",
    "write": "os.write",
    "fsync": "os.fsync",
    "rename": "os.rename",
    "read back": "tightrope.runs.checkpoint.verify",
}


@pytest.mark.parametrize("where", FAILURES)
def test_a_save_that_fails_prunes_nothing(run: Run, monkeypatch: pytest.MonkeyPatch, where: str) -> None:
    def fail(*_args: Any, **_more: Any) -> None:
        raise CheckpointError("other bytes") if where == "read back" else OSError(28, "No space left")

    for step in (10, 20):
        save(run, step, [], merit=float(step == 10))
    told: list[str] = []
    for final in (False, True):
        with monkeypatch.context() as patch:
            patch.setattr(FAILURES[where], fail)
            if final:
                with pytest.raises(CannotWrite, match="step-000000000030 cannot be written"):
                    save(run, 30, told, final=True)
            else:
                save(run, 30, told)
        assert steps(run) == [10, 20]
        assert retention.valid(run.checkpoints, told.append).state["step"] == 20
    assert len(told) == 1 and told[0].startswith("No checkpoint at step 30")
    save(run, 30, told)
    save(run, 40, told)
    assert steps(run) == [10, 30, 40]  # 10 is the best
    assert not [p for p in run.checkpoints.iterdir() if p.name.startswith(".")]


def test_failures_at_random_never_cost_the_best_or_the_last(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thousand operations, one in nine refused: everything saved can be loaded, including the best."""
    draw, write, merits, saved = random.Random(3), checkpoint.write_file, dict[int, float](), list[int]()

    def sometimes(*args: Any, **more: Any) -> Any:
        if draw.random() < 1 / 9:
            raise OSError(28, "No space left")
        return write(*args, **more)

    monkeypatch.setattr("tightrope.runs.checkpoint.write_file", sometimes)
    for step in range(1, 60):
        told: list[str] = []
        merit = draw.random()
        save(run, step, told, merit=merit)
        if not told:
            merits[step] = merit
            saved.append(step)
        left = steps(run)
        assert left[-len(saved[-2:]) :] == saved[-2:]
        best = max((step for step in merits), key=lambda step: merits[step], default=None)
        assert best is None or best in left
        for folder in retention.steps_in(run.checkpoints):
            checkpoint.verify(folder)
    assert 5 < 59 - len(saved) < 40


def test_an_old_one_that_cannot_be_deleted_is_reported_and_is_no_failure(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    for step in (10, 20):
        save(run, step, told)

    def refuse(folder: Path) -> None:
        raise PermissionError(13, "Permission denied", str(folder))

    monkeypatch.setattr("tightrope.runs.retention.remove", refuse)
    save(run, 30, told, final=True)
    assert len(told) == 1 and "cannot be deleted" in told[0] and "step-000000000010" in told[0]
    assert steps(run) == [10, 20, 30]


@pytest.mark.parametrize("best", [False, True])
def test_a_reader_takes_the_newest_when_what_it_reads_is_replaced(
    run: Run, monkeypatch: pytest.MonkeyPatch, best: bool
) -> None:
    """Pruned, or replaced, between the manifest and the file: read again, not refused."""
    read, moments = checkpoint._verified, [0]

    def meanwhile(path: Path, entry: Any, **more: Any) -> bytes:
        moments[0] += 1
        if moments[0] == 2:
            if best:
                checkpoint.save(run.best, {"policy": {"w": torch.ones(7)}}, {"step": 2})
            else:
                for step in (20, 30, 40):
                    save(run, step, [])
        return read(path, entry, **more)

    save(run, 10, [])
    checkpoint.save(run.best, {"policy": {"w": torch.ones(3)}}, {"step": 1})
    monkeypatch.setattr(checkpoint, "_verified", meanwhile)
    if best:
        assert checkpoint.load(run.best)[1] == {"step": 2}
    else:
        assert retention.valid(run.checkpoints, lambda text: pytest.fail(text)).state["step"] == 40
    assert moments[0] > 2
