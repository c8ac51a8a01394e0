"""Rollback to the newest checkpoint after a NaN: bounded, counted, with new random numbers, for all runs."""

import json

import pytest
import torch
from language.tiny import saved

from tightrope.algorithms.nonfinite import NonFiniteError
from tightrope.control.settings import TrainSettings
from tightrope.control.train import train
from tightrope.language import SFTSettings, align, train_sft
from tightrope.training.events import Message

CONTROL = {
    "num_envs": 2, "num_steps": 32, "minibatch_size": 64, "num_epochs": 1, "hidden": (8,), "total_steps": 640,
    "checkpoint_every": 0.2, "evaluate_every": None, "vector_backend": "serial", "max_rollbacks": 2,
}  # fmt: skip


def poison(monkeypatch, times):
    """An advantage of NaN in the fifth update and in its repetitions after a rollback."""
    from tightrope.control import agent as module

    whole, calls, seen = module.to_batch, [0, 0], []

    def poisoned(rollout, *arguments, **more):
        batch = whole(rollout, *arguments, **more)
        calls[0] += 1
        if calls[0] >= 5 and calls[1] < times:
            calls[1] += 1
            seen.append(rollout.actions.copy())
            batch.advantages[0, 0] = torch.nan
            calls[0] = 4  # the run returns to the checkpoint of the fourth
        return batch

    monkeypatch.setattr(module, "to_batch", poisoned)
    return seen


@pytest.mark.parametrize("engine", ["torch", "fused"])
def test_control_rolls_back_continues_and_counts(engine, monkeypatch, tmp_path):
    seen, lines = poison(monkeypatch, 2), []
    settings = TrainSettings().with_values(**CONTROL, engine=engine)

    def report(event):
        if isinstance(event, Message):
            lines.append(event.text)

    summary = train(settings, run_dir=tmp_path / "run", listeners=[report])
    assert summary["steps"] == 640
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [64 * k for k in range(1, 11)]  # none twice, none missing
    assert [row.get("train/rollbacks", 0.0) for row in rows] == [0.0] * 4 + [2.0] * 6
    told = [line for line in lines if "Going back to the checkpoint of step 256" in line]
    assert len(told) == 2 and "advantage" in told[0] and "2 of 2 times at most" in told[1]
    assert not (seen[0] == seen[1]).all()  # not the same bits again


def test_control_ends_when_it_went_back_often_enough(monkeypatch, tmp_path):
    poison(monkeypatch, 99)
    settings = TrainSettings().with_values(**CONTROL, engine="torch")
    with pytest.raises(NonFiniteError, match="advantage"):
        train(settings, run_dir=tmp_path / "run")


def test_without_a_checkpoint_it_ends_and_reports_it(monkeypatch, tmp_path):
    poison(monkeypatch, 1)
    settings = TrainSettings().with_values(**{**CONTROL, "checkpoint_every": None}, engine="torch")
    with pytest.raises(NonFiniteError, match="advantage.*There is no checkpoint to go back to"):
        train(settings, run_dir=tmp_path / "run")


def test_language_rolls_back_continues_and_counts(monkeypatch, tmp_path):
    from tightrope.language.alignment import iteration as module

    model, whole, calls, texts = saved(tmp_path / "model"), module.batch_of, [0], []

    def poisoned(experience, *arguments):
        batch = whole(experience, *arguments)
        calls[0] += 1
        if calls[0] in (3, 4):
            texts.append(experience.ids)
        if calls[0] == 3:
            batch.advantages[0, 0] = torch.nan
        return batch

    monkeypatch.setattr(module, "batch_of", poisoned)
    lines = []
    run = align(
        model=model, prompts=["ab", "cd"], reward="length", run_dir=tmp_path / "run", total_episodes=32,
        batch_size=8, minibatch_size=8, max_new_tokens=4, lora_rank=2, checkpoint_every=0.5, max_rollbacks=1,
        normalise_advantages=False, listeners=[lambda event: lines.append(str(event))],
    )  # fmt: skip
    rows = run.metrics
    assert [row["step"] for row in rows] == [8, 16, 24, 32]
    assert [row.get("train/rollbacks", 0.0) for row in rows] == [0.0, 0.0, 1.0, 1.0]
    assert any("The advantage" in line and "checkpoint of step 16" in line for line in lines)
    assert texts[0] != texts[1]


def test_only_bad_numbers_are_gone_back_for(monkeypatch, tmp_path):
    from tightrope.control import agent as module

    monkeypatch.setattr(module, "to_batch", lambda *_, **__: int("something else"))
    settings = TrainSettings().with_values(**CONTROL, engine="torch")
    with pytest.raises(ValueError, match="something else"):
        train(settings, run_dir=tmp_path / "run")


@pytest.mark.parametrize("limit", [0, 1])
def test_sft_goes_back_too(limit, monkeypatch, tmp_path):
    from tightrope.language.supervised import fit as module

    real, batches = module.take_step, []

    def poisoned(objective, minibatch, *arguments):
        batches.append([row.tokens.tolist() for row in minibatch])
        if len(batches) == 4:
            raise NonFiniteError("The loss is nan.")
        return real(objective, minibatch, *arguments)

    monkeypatch.setattr(module, "take_step", poisoned)
    settings = SFTSettings(
        model=saved(tmp_path / "model"), num_epochs=1, minibatch_size=2, checkpoint_every=0.2, held_out=0.0,
        max_tokens=8, max_rollbacks=limit, lora_rank=2,
    )  # fmt: skip
    data, lines = [{"text": "abcdefghijklmnop"[k : k + 4]} for k in range(10)], []
    given = {"data": data, "run_dir": tmp_path / "run", "listeners": [lambda event: lines.append(str(event))]}
    if not limit:
        with pytest.raises(NonFiniteError):
            train_sft(settings, **given)
        return
    train_sft(settings, **given)
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [1, 2, 3, 4, 5]
    assert [row.get("train/rollbacks", 0.0) for row in rows] == [0.0] * 3 + [1.0] * 2
    assert any("Going back to the checkpoint of step 3, 1 of 1 times" in line for line in lines)
    assert batches[3] != batches[4]
