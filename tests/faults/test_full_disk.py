"""A disk error during training: a run continues without a checkpoint in the middle, but never without its
last one or its records. Control, language, and the command line.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from language.tiny import saved

from tightrope.cli.main import main
from tightrope.control.resolve import resolve
from tightrope.control.train import resume, train
from tightrope.language import align
from tightrope.language.alignment.align import resume_align
from tightrope.language.settings import AlignSettings, SFTSettings
from tightrope.language.supervised.sft import resume_sft, train_sft
from tightrope.runs import checkpoint
from tightrope.runs.durable import CannotWrite
from tightrope.runs.run import Run
from tightrope.training.events import Message

SMALL = {"total_steps": 256, "num_envs": 2, "num_steps": 32, "evaluate_every": None, "engine": "torch"}
FACTS = [{"text": f"{a} is {b}."} for a, b in zip("abcdefgh", "ponmlkji", strict=True)]
MORE = {"checkpoint_every": 0.25, "threads": 1}


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> str:
    return saved(tmp_path_factory.mktemp("models") / "llama")


def run_control(folder: Path, report: Any, model: str) -> Any:
    settings = resolve("CartPole-v1", "ppo", {**SMALL, **MORE, "minibatch_size": 64})
    return train(settings, run_dir=folder, listeners=[report])


def run_sft(folder: Path, report: Any, model: str) -> Any:
    settings = SFTSettings(model=model, held_out=0.0, minibatch_size=2, max_tokens=32, **MORE)
    return train_sft(settings, data=FACTS, run_dir=folder, listeners=[report])


def lengths(prompts: list[str], completions: list[str], **columns: Any) -> list[float]:
    return [float(len(text)) for text in completions]


def run_align(folder: Path, report: Any, model: str) -> Any:
    settings = AlignSettings(model=model, total_episodes=16, batch_size=4, max_new_tokens=3, **MORE)
    values = {"minibatch_size": 4, "num_epochs": 1}
    return align(settings, prompts=["a", "b"], reward=lengths, run_dir=folder, listeners=[report], **values)


STORIES = {
    "control": (run_control, lambda folder: resume(folder)),
    "sft": (run_sft, lambda folder: resume_sft(folder, data=FACTS)),
    "align": (run_align, lambda folder: resume_align(folder, prompts=["a", "b"], reward=lengths)),
}
EVERY = pytest.mark.parametrize("story", STORIES)


def refusing(patch: pytest.MonkeyPatch, saves: set[int]) -> None:
    """The disk is full at these saves of checkpoints, counted from 1."""
    real, count = checkpoint.save, [0]

    def save(folder: Path, *args: Any) -> Path:
        count[0] += 1
        if count[0] not in saves:
            return real(folder, *args)
        raise CannotWrite(folder, OSError(28, "No space left on device"))

    patch.setattr(checkpoint, "save", save)


def steps(folder: Path) -> list[int]:
    return sorted(map(checkpoint.step_of, (folder / "checkpoints").iterdir()))


@EVERY
def test_a_failed_checkpoint_in_the_middle_is_reported_and_training_continues(
    tmp_path: Path, model: str, monkeypatch: pytest.MonkeyPatch, story: str
) -> None:
    run, _ = STORIES[story]
    told: list[str] = []
    report = lambda event: told.append(str(event) if isinstance(event, Message) else "")  # noqa: E731
    run(tmp_path / "whole", lambda event: None, model)
    with monkeypatch.context() as patch:
        refusing(patch, {2, 3})
        run(tmp_path / "run", report, model)
    warned = [text for text in told if text.startswith("warning: No checkpoint at step")]
    assert len(warned) == 2 and all("No space left" in text and "Make room" in text for text in warned)
    assert len(steps(tmp_path / "run")) == 2 and (tmp_path / "run" / "summary.json").exists()
    assert len(steps(tmp_path / "whole")) == 3  # of four
    rows = [Run.open(tmp_path / name).read_metrics() for name in ("whole", "run")]
    bare = [
        [{k: v for k, v in row.items() if k[:4] not in ("seco", "time")} for row in each] for each in rows
    ]
    assert bare[0] == bare[1]  # a missing checkpoint changes no bit


@EVERY
def test_the_last_checkpoint_must_be_written_and_the_run_can_go_on(
    tmp_path: Path, model: str, monkeypatch: pytest.MonkeyPatch, story: str
) -> None:
    run, go_on = STORIES[story]
    with monkeypatch.context() as patch:
        refusing(patch, {4})
        with pytest.raises(CannotWrite, match=r"step-.* cannot be written \(No space left"):
            run(tmp_path / "run", lambda event: None, model)
    assert len(steps(tmp_path / "run")) == 3 and not (tmp_path / "run" / "summary.json").exists()
    go_on(tmp_path / "run")
    assert (tmp_path / "run" / "summary.json").exists()
    seen = [row["step"] for row in Run.open(tmp_path / "run").read_metrics()]
    assert seen == sorted(set(seen)) and steps(tmp_path / "run")[-1] == seen[-1]


def test_the_command_line_prints_one_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "train",
        "CartPole-v1",
        "--run-dir",
        str(tmp_path / "run"),
        "--quiet",
        "--checkpoint-every",
        "0.5",
    ]
    for name, value in {**SMALL, "minibatch_size": 64}.items():
        words += [f"--{name.replace('_', '-')}", "none" if value is None else str(value)]
    with monkeypatch.context() as patch:
        refusing(patch, {2})
        assert main(words) == 74  # EX_IOERR: not the code of a mistake in the words
    seen = capsys.readouterr()
    assert seen.out == ""
    assert seen.err.count("\n") == 1 and "Traceback" not in seen.err
    assert "cannot be written (No space left on device)" in seen.err
    assert (
        f"Make room on the disk and try again; the run continues with: tightrope resume {tmp_path}/run"
        in seen.err
    )
    with Run.open(tmp_path / "run").lock():
        assert main(["resume", str(tmp_path / "run"), "--quiet"]) == 2
    assert "is being written by this process" in capsys.readouterr().err
    assert main(["resume", str(tmp_path / "run"), "--quiet", "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["steps"] == 256
