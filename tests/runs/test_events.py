"""The events of every command, and the requests of listeners."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from language.tiny import saved, tiny_llama

from tightrope.cli import display
from tightrope.control.settings import TrainSettings
from tightrope.control.train import resume, train
from tightrope.language.alignment.align import align
from tightrope.language.settings import RewardSettings, SFTSettings
from tightrope.language.supervised.preferences import train_reward
from tightrope.language.supervised.sft import train_sft
from tightrope.runs.run import Run
from tightrope.training.events import (
    Change,
    Evaluated,
    Event,
    Finished,
    Listeners,
    Message,
    Samples,
    Started,
    Stop,
    Updated,
)


def control(folder: Path, sent: Any) -> None:
    settings = TrainSettings(env="CartPole-v1", num_envs=2, total_steps=256, engine="torch")
    settings = settings.with_values(num_steps=64, clip=0.9, evaluation_episodes=1)  # the clip is a risk
    train(settings, run_dir=folder, listeners=[sent])


def language(folder: Path, sent: Any) -> None:
    align(
        model=saved(folder.parent / "model", tiny_llama()), prompts=["ab", "cde"], reward=vowels,
        total_episodes=16, batch_size=8, minibatch_size=8, max_new_tokens=4, lora_rank=2, run_dir=folder,
        kl_beta=0.0, checkpoint_every=0.5, listeners=[sent],  # without a KL: a risk
    )  # fmt: skip


def sft(folder: Path, sent: Any) -> None:
    settings = SFTSettings(model=saved(folder.parent / "model", tiny_llama()), num_epochs=1, max_tokens=3)
    train_sft(settings, data=[{"prompt": "ab", "completion": "cd"}] * 4, run_dir=folder, listeners=[sent])


def reward(folder: Path, sent: Any) -> None:
    settings = RewardSettings(model=saved(folder.parent / "model", tiny_llama()), num_epochs=1, max_tokens=3)
    rows = [{"prompt": "ab", "chosen": "cd", "rejected": "e"}] * 4
    train_reward(settings, data=rows, run_dir=folder, listeners=[sent])


def vowels(completions: list[str], **_: Any) -> list[float]:
    return [sum(c in "aeiou" for c in text) / 4 for text in completions]


OWN: dict[Any, set[type]] = {control: {Evaluated}, language: {Samples}, sft: {Evaluated}, reward: {Evaluated}}


@pytest.mark.parametrize("run", OWN)
def test_what_a_run_sends(run: Any, tmp_path: Path) -> None:
    events: list[Event] = []
    run(tmp_path / "run", events.append)
    assert {type(event) for event in events} == {Message, Started, Updated, Finished} | OWN[run]
    rows = [row for row in Run.open(tmp_path / "run").read_metrics() if row["step"]]
    if run is control:  # the final evaluation is a row of its own
        final = next(event for event in reversed(events) if isinstance(event, Evaluated))
        assert {"step": final.step, **final.metrics}.items() <= rows.pop().items()
    updates = [event for event in events if isinstance(event, Updated)]
    assert [update.step for update in updates] == [row["step"] for row in rows]
    for update, row in zip(updates, rows, strict=True):
        assert set(update.metrics) == set(row) - {"step", "seconds"}
    last = events[-1]
    assert isinstance(last, Finished)
    assert set(last.summary) == set(json.loads((tmp_path / "run" / "summary.json").read_text()))
    warnings = [event.text for event in events if isinstance(event, Message) and event.level == "warning"]
    assert warnings and not any(text.startswith("warning") for text in warnings)


@pytest.mark.parametrize("quiet", [False, True])
def test_every_display_knows_a_warning_by_its_level(quiet: bool, capsys: pytest.CaptureFixture[str]) -> None:
    """The text of an information line may begin with any word; a warning's need not."""
    import sys

    for view in (display.CONTROL, display.SFT, display.REWARD, display.ALIGN):
        one = display.Display(view, sys.stdout, quiet=quiet)
        listeners = Listeners([one])
        listeners.warn("clip is high")
        listeners.info("warning: is the first word of a fact")
        listeners.warn("of a run\x1b")
        out, err = capsys.readouterr()
        assert err == "warning: clip is high\nwarning: of a run\\x1b\n"
        assert out == ("" if quiet else "warning: is the first word of a fact\n")


class Killed(Exception):
    pass


def change_at(step: int, die_at: int | None = None) -> Any:
    """A listener that changes the learning rate after one step and ends the run after another."""

    def listen(event: Event) -> Change | None:
        if isinstance(event, Updated) and event.step == die_at:
            raise Killed
        if isinstance(event, Updated) and event.step == step:
            return Change("learning_rate", 1e-3)
        return None

    return listen


TASK = TrainSettings(env="CartPole-v1", num_envs=2, total_steps=640, engine="torch").with_values(
    num_steps=32, checkpoint_every=0.2, evaluate_every=None, learning_rate_schedule="constant"
)


@pytest.mark.parametrize("step", [64, 128, 192])  # before a checkpoint, at one, and behind it
def test_a_changed_learning_rate_survives_a_resume(step: int, tmp_path: Path) -> None:
    train(TASK, run_dir=tmp_path / "whole", listeners=[change_at(step)])
    with pytest.raises(Killed):
        train(TASK, run_dir=tmp_path / "hops", listeners=[change_at(step, die_at=320)])
    resume(tmp_path / "hops", listeners=[change_at(step)])
    whole, hops = (Run.open(tmp_path / name) for name in ("whole", "hops"))
    rates = [row["train/learning_rate"] for row in whole.read_metrics()]
    assert rates == [TASK.update.learning_rate if k * 64 <= step else 1e-3 for k in range(1, 11)]
    assert [row["train/learning_rate"] for row in hops.read_metrics()] == rates
    row = {"step": step, "setting": "learning_rate", "value": 1e-3}
    assert whole.read_changes() == hops.read_changes() == [row]
    first, second = whole.newest().tensors, hops.newest().tensors
    assert all((first[a][b] == second[a][b]).all() for a in first for b in first[a])


def test_a_listener_stops_a_run(tmp_path: Path) -> None:
    def listen(event: Event) -> Stop | None:
        return Stop("enough") if isinstance(event, Updated) and event.step == 192 else None

    summary = train(TASK, run_dir=tmp_path / "run", listeners=[listen])
    assert summary["steps"] == 192 and Run.open(tmp_path / "run").newest().state["steps"] == 192
    assert resume(tmp_path / "run")["steps"] == 640


@pytest.mark.parametrize(
    ("asked", "words"),
    [(Change("seed", 1), "'seed' cannot change during a run; these can: learning_rate"),
     (Change("learning_rate", -1.0), "learning_rate"), (Change("clip", True), "expected a number")],
)  # fmt: skip
def test_what_cannot_be_changed_is_refused(asked: Change, words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=words):
        train(TASK, run_dir=tmp_path / "run", listeners=[lambda event: asked])
