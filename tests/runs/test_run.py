"""A run folder has all documented files, in JSON that every reader accepts, and is never overwritten."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tightrope.control.settings import TrainSettings
from tightrope.control.train import train
from tightrope.runs import checkpoint
from tightrope.runs.checkpoint import CheckpointError
from tightrope.runs.durable import TEMPORARY
from tightrope.runs.lock import WriterLock
from tightrope.runs.records import dumps, plain, read_json, read_lines, signed, write_json
from tightrope.runs.run import Run
from tightrope.training.events import Started, Updated
from tightrope.training.tensorboard import TensorBoard

SETTINGS = {"env": "CartPole-v1", "hidden": (64, 64), "clip": 0.2}


def strict(text: str) -> object:
    def refuse(literal: str) -> None:
        raise AssertionError(f"{literal} is not JSON")

    return json.loads(text, parse_constant=refuse)


def test_settings_are_there_before_the_first_step(tmp_path: Path) -> None:
    run = Run.create(tmp_path / "a", SETTINGS, "name")
    found = json.loads((run.path / "settings.json").read_text())
    assert found.pop("sha256") and found == {**SETTINGS, "hidden": [64, 64]}
    run.close()
    with Run.open(run.path, own=True) as again:
        assert again.settings == run.settings


def test_a_changed_digit_of_the_settings_is_found(tmp_path: Path) -> None:
    """Readers accept them; a resume does not."""
    run = Run.create(tmp_path / "a", {"clip": 0.25, "steps": 3000, "lr": 1e-3}, "name")
    file = run.path / "settings.json"
    text, found = file.read_text(), 0
    run.close()
    for place, letter in enumerate(text):
        if letter.isdigit() and place < text.index("sha256"):
            file.write_text(text[:place] + str((int(letter) + 1) % 10) + text[place + 1 :])
            with pytest.raises(ValueError, match=r"settings.json is not as the run wrote it.*--settings"):
                Run.open(run.path, own=True)
            assert "sha256" not in Run.open(run.path).settings
            found += 1
    assert found >= 7
    run.update_settings({"steps": 7000})
    run.close()
    with Run.open(run.path, own=True) as again:
        assert again.settings == {"steps": 7000}


def test_a_resume_reads_the_settings_after_taking_the_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The previous writer changes the settings at the last moment: no process sees the old ones."""
    run = Run.create(tmp_path / "a", {"steps": 3000}, "name")
    run.close()
    real = WriterLock.__init__

    def late(self: WriterLock, folder: Path) -> None:
        real(self, folder)
        write_json(folder / "settings.json", signed({"steps": 7000}))

    with monkeypatch.context() as patch:
        patch.setattr(WriterLock, "__init__", late)
        with Run.open(run.path, own=True) as again:
            assert again.settings == {"steps": 7000}


def test_default_folders_differ_and_are_safe_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    paths = {Run.create(None, {}, "module:ALE/Pong-v5-ppo-1").path for _ in range(3)}
    assert len(paths) == 3
    for path in paths:
        assert path.parent == tmp_path / "runs"  # absolute: an environment may change the folder
        assert path.name.startswith("module-ALE-Pong-v5-ppo-1-2")


def test_a_folder_with_something_in_it_is_never_used(tmp_path: Path) -> None:
    (tmp_path / "note.txt").write_text("mine")
    for path in (tmp_path, tmp_path / "note.txt"):
        with pytest.raises(ValueError, match=r"not (empty|a folder).*--run-dir"):
            Run.create(path, SETTINGS, "name")
    assert [p.name for p in tmp_path.iterdir()] == ["note.txt"]


def test_metrics_and_episodes_are_readable_at_once(tmp_path: Path) -> None:
    run = Run.create(tmp_path / "a", SETTINGS, "name")
    run.record(2048, 1.5, {"train/approx_kl": np.float32(0.25), "rollout/ep_rew_mean": float("nan")})
    run.record_episodes([{"step": 9, "return": 1.0, "length": 3}, {"step": 12, "return": 2.0, "length": 4}])
    run.record_episodes([])
    text = (run.path / "metrics.jsonl").read_text()
    wanted = {"step": 2048, "seconds": 1.5, "train/approx_kl": 0.25, "rollout/ep_rew_mean": None}
    assert strict(text) == wanted
    assert Run.open(run.path).read_metrics() == [wanted]
    assert [row["return"] for row in run.read_episodes()] == [1.0, 2.0]
    run.close()
    run.record(4096, 3.0, {})
    assert [row["step"] for row in run.read_metrics()] == [2048, 4096]
    run.close()


def test_an_undeclared_metric_is_refused_and_not_written(tmp_path: Path) -> None:
    with Run.create(tmp_path / "a", SETTINGS, "name") as run:
        with pytest.raises(ValueError, match="Did you mean 'time/fps'"):
            run.record(1, 1.0, {"time/fsp": 3.0})
        assert run.read_metrics() == []


def saved(path: Path, *steps: int, **more: Any) -> Run:
    """A run with an update, an episode and a checkpoint at each of these steps."""
    with Run.create(path, SETTINGS, "name") as run:
        for step in steps:
            run.record(step, step / 10, {"time/fps": 1.0})
            run.record_episodes([{"step": step - 1, "return": 0.0, "length": 1}])
            run.save(step, {"policy": {"w": torch.ones(3) * step}}, {"at": step}, **{**KEEP, **more})
    return run


def fail(text: str) -> None:
    raise AssertionError(text)


KEEP: dict[str, Any] = {"keep": None, "warn": fail}


def test_rewind_forgets_what_came_after_the_checkpoint(tmp_path: Path) -> None:
    """To the byte: rows of the checkpoint's own step that were recorded after it are also removed."""
    with saved(tmp_path / "a", 10, 20) as run:
        wanted = [(run.path / name).read_bytes() for name in ("metrics.jsonl", "episodes.jsonl")]
        run.record_episodes([{"step": 20, "return": 1.0}])
        run.record(30, 3.0, {"time/fps": 1.0})
        run.record_samples([{"step": 30}])
        (run.checkpoints / f"{TEMPORARY}step").mkdir()
        (run.path / f"{TEMPORARY}settings.json-0").write_text("{")
        with open(run.path / "metrics.jsonl", "a") as file:
            file.write('{"step": 40, "sec')  # a crash in the middle of a line
        point = run.resume_point(fail, fail)
        assert (point.folder, point.state["at"]) == (run.checkpoint_folder(20), 20)
        run.rewind(point)
        assert [(run.path / n).read_bytes() for n in ("metrics.jsonl", "episodes.jsonl")] == wanted
        assert (run.path / "samples.jsonl").read_bytes() == b""
        run.record(25, 2.5, {})
        assert [row["step"] for row in run.read_metrics()] == [10, 20, 25]
        assert [row["step"] for row in run.read_episodes()] == [9, 19]
        left = {p.name for parent in (run.path, run.checkpoints) for p in parent.iterdir()}
        assert not [name for name in left if name.startswith(".")]


def test_without_a_checkpoint_a_run_starts_over(tmp_path: Path) -> None:
    with Run.create(tmp_path / "a", SETTINGS, "name") as run:
        run.record(10, 1.0, {})
        run.rewind(None)
        assert run.read_metrics() == []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: text[: len(text) // 2], "the checkpoint counts on"),
        (lambda text: text.replace("1.0", "9.0"), "another file"),
        (lambda text: text[1:] + "x", "another file"),
    ],
)
def test_records_that_are_not_the_checkpoints_lead_to_an_older_one_or_a_clear_error(
    tmp_path: Path, change: Any, said: str
) -> None:
    with saved(tmp_path / "a", 10, 20) as run:
        path, told = run.path / "metrics.jsonl", list[str]()
        first, second = path.read_text().splitlines(keepends=True)
        path.write_text(first + change(second))
        point = run.resume_point(told.append, told.append)
        assert point.state["at"] == 10
        assert said in told[0] and "metrics.jsonl" in told[0] and "step-000000000020" in told[0]
        path.write_text(change(first))
        with pytest.raises(CheckpointError, match=r"no valid checkpoint.*metrics\.jsonl"):
            run.resume_point(told.append, told.append)
        path.unlink()
        with pytest.raises(CheckpointError, match=r"metrics\.jsonl has 0 bytes"):
            run.resume_point(told.append, told.append)


def test_a_checkpoint_that_was_passed_over_is_put_aside(tmp_path: Path) -> None:
    """It is not mistaken for the newest later, and the step can be saved again."""
    with saved(tmp_path / "a", 10, 20) as run:
        (run.checkpoint_folder(20) / "state.json").write_text("{}")
        told: list[str] = []
        point = run.resume_point(told.append, told.append)
        assert [text[:10] for text in told] == ["Checkpoint"] and "state.json" in told[0]
        run.rewind(point)
        assert (run.checkpoints / "unusable-step-000000000020" / "state.json").read_text() == "{}"
        run.save(20, {}, {"at": "again"}, **KEEP)
        assert run.newest().state["at"] == "again"


def test_a_damaged_best_is_put_aside_and_can_be_saved_again(tmp_path: Path) -> None:
    with saved(tmp_path / "a", 10) as run:
        checkpoint.save(run.best, {}, {"at": 10})
        run.resume_point(fail, fail)
        (run.best / "manifest.json").write_text("{}")
        told: list[str] = []
        assert run.resume_point(told.append, told.append).state["at"] == 10
        assert len(told) == 1 and "unusable-best" in told[0] and "manifest.json" in told[0]
        checkpoint.save(run.best, {}, {"at": 20})
        assert (run.path / "unusable-best").is_dir()


def test_what_a_checkpoint_took_is_a_metric_of_the_next_update(tmp_path: Path) -> None:
    with saved(tmp_path / "a", 10, 20) as run:
        first, second = run.read_metrics()
        assert not [name for name in first if "checkpoint" in name]
        size = sum(p.stat().st_size for p in run.checkpoint_folder(10).iterdir())
        assert second["time/checkpoint_megabytes"] == size / 1e6
        assert 0 < second["time/checkpoint_seconds"] < 60


def test_settings_and_records_lie_in_the_checkpoint(tmp_path: Path) -> None:
    with saved(tmp_path / "a", 10) as run:
        state = run.newest().state
        assert state["settings"] == run.settings
        assert set(state["records"]) == {"metrics.jsonl", "episodes.jsonl"}


def test_the_summary_ends_a_run(tmp_path: Path) -> None:
    run = Run.create(tmp_path / "a", SETTINGS, "name")
    run.finish({"steps": np.int64(5), "eval": {"mean": torch.tensor(1.5), "std": float("inf")}})
    assert strict((run.path / "summary.json").read_text()) == {"steps": 5, "eval": {"mean": 1.5, "std": None}}
    assert not [p for p in run.path.iterdir() if p.name.startswith(".")]


def test_what_is_no_run_is_named_with_a_near_one(tmp_path: Path) -> None:
    Run.create(tmp_path / "CartPole-1", SETTINGS, "name")
    with pytest.raises(ValueError, match=r"no such folder.*Did you mean .*CartPole-1\?"):
        Run.open(tmp_path / "CartPole-2")
    with pytest.raises(ValueError, match=r"no settings.json.*newest run is .*CartPole-1"):
        Run.open(tmp_path)
    (tmp_path / "CartPole-1" / "settings.json").write_text("[1]")
    with pytest.raises(ValueError, match="expected an object"):
        Run.open(tmp_path / "CartPole-1")
    (tmp_path / "CartPole-1" / "settings.json").write_text('{"clip": NaN}')
    with pytest.raises(ValueError, match="not readable as JSON"):
        Run.open(tmp_path / "CartPole-1")


def test_tensorboard_files_hold_the_scalars(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    listener = TensorBoard()
    listener(Started(str(tmp_path), {}, 0, 200, ()))
    listener(Updated(100, 200, 1.0, {"train/entropy": -0.5, "train/approx_kl": float("nan")}))
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert events.Tags()["scalars"] == ["train/entropy"]
    assert [(e.step, e.value) for e in events.Scalars("train/entropy")] == [(100, -0.5)]


def test_tensorboard_without_its_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(ValueError, match=r"pip install 'tightrope\[tensorboard\]'"):
        train(TrainSettings(env="CartPole-v1", tensorboard=True), run_dir=tmp_path / "a")
    assert list(tmp_path.iterdir()) == []


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@given(JSON)
def test_plain_values_return_as_they_are_on_one_line(value: object) -> None:
    text = dumps(value)
    assert strict(text) == value
    assert "\n" not in text


def test_no_literal_that_json_lacks() -> None:
    values = [
        float("nan"),
        float("inf"),
        -np.inf,
        np.float32("nan"),
        np.array([1.0, np.nan]),
        torch.tensor([np.inf]),
    ]
    assert plain(values) == [None, None, None, None, [1.0, None], [None]]
    assert strict(dumps({"a": values})) == {"a": plain(values)}
    assert plain({1: Path("a/b"), "b": np.bool_(True), "c": np.int8(3)}) == {"1": "a/b", "b": True, "c": 3}


def test_a_json_file_is_whole_or_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "x.json"
    write_json(path, {"a": 1})
    with monkeypatch.context() as patch:
        patch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError("crash")))
        with pytest.raises(OSError, match="crash"):
            write_json(path, {"a": 2})
    assert read_json(path) == {"a": 1}
    assert list(tmp_path.iterdir()) == [path]


def test_a_torn_line_is_left_out_at_the_end_only(tmp_path: Path) -> None:
    path = tmp_path / "x.jsonl"
    path.write_text('{"a": 1}\n{"a": 2}\n{"a"')
    assert read_lines(path) == [{"a": 1}, {"a": 2}]
    path.write_text('{"a": 1}\n{"a"\n{"a": 3}\n')
    with pytest.raises(ValueError, match="line 2"):
        read_lines(path)
