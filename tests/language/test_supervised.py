"""Runs of stages one and two: they print their memory needs first, and they can be resumed."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from language.test_reward_model import preferences
from language.tiny import saved, tiny_llama, tokenizer

from tightrope.cli.main import main
from tightrope.language import memory
from tightrope.language.memory import DoesNotFit, amount, job_of, ledger
from tightrope.language.settings import RewardSettings, SFTSettings
from tightrope.language.supervised import fit as fitting
from tightrope.language.supervised import prepare
from tightrope.language.supervised.fit import minibatches
from tightrope.language.supervised.preferences import resume_reward, train_reward
from tightrope.language.supervised.sft import resume_sft, train_sft
from tightrope.runs.checkpoint import step_of
from tightrope.runs.run import Run
from tightrope.training.events import Message, Started, Updated
from tightrope.training.learner import crosses

FACTS = [f"{a} is {b}." for a, b in zip("abcdefgh", "ponmlkji", strict=True)]
STAGES = {
    "sft": (train_sft, resume_sft, SFTSettings, [{"text": fact} for fact in FACTS]),
    "reward": (train_reward, resume_reward, RewardSettings, preferences(8)),
}
BOTH = pytest.mark.parametrize("stage", STAGES)
FAST = {"max_tokens": 32, "minibatch_size": 2, "learning_rate": 1e-2, "threads": 1, "num_epochs": 3}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> str:
    return saved(tmp_path_factory.mktemp("models") / "llama")


class Cut(Exception):
    """Stops a run."""


def stopping(step: int):
    """A reporter that stops the run after this step."""

    def report(event):
        if isinstance(event, Updated) and event.step == step:
            raise Cut

    return report


def rows_of(run_dir) -> list[dict]:
    """The metrics without clock times."""
    rows = Run.open(run_dir).read_metrics()
    return [{k: v for k, v in row.items() if k != "seconds" and not k.startswith("time/")} for row in rows]


def same_end(a, b) -> bool:
    """Whether two runs end with the same bits: the models, and every tensor of their last checkpoints."""
    names = [path.relative_to(a) for path in a.rglob("*.safetensors") if "checkpoints" not in path.parts]
    assert names and all((a / name).read_bytes() == (b / name).read_bytes() for name in names)
    (first, state), (second, other) = (Run.open(run).newest()[1:] for run in (a, b))
    assert {key for group in first.values() for key in group if key.endswith("exp_avg_sq")}
    assert state["seen"] == other["seen"]
    return all(torch.equal(first[group][key], second[group][key]) for group in first for key in first[group])


# ---------------------------------------------------------------------------------------------- going on


@BOTH
@pytest.mark.parametrize("tune", ["lora", "full"])
@pytest.mark.parametrize("stop", [2, 8, 11])
def test_a_resumed_run_ends_like_an_uninterrupted_one(tmp_path, folder, stage, tune, stop):
    """Bit for bit, in the middle of an epoch (8), after one (11), and before the first checkpoint (2)."""
    train, resume, kind, data = STAGES[stage]
    settings = kind(model=folder, tune=tune, held_out=0.25, checkpoint_every=0.45, **FAST)
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    summary = train(settings, data=data, run_dir=whole)
    assert len(rows_of(whole)) == 10  # 3 minibatches of 6 examples, three times, and the rows before
    with pytest.raises(Cut):
        train(settings, data=data, run_dir=broken, listeners=[stopping(min(stop, 9))])
    events = []
    again = resume(broken, data=data, listeners=[lambda event: events.append(event)])
    begin = {2: 0, 8: 5, 11: 5}[stop]
    assert [event.step for event in events if isinstance(event, Started)] == [begin]
    assert [event.step for event in events if isinstance(event, Updated)] == list(range(begin + 1, 10))
    assert rows_of(broken) == rows_of(whole)
    assert again["final"] == summary["final"]
    assert same_end(whole, broken)


def test_saves_lie_on_a_grid_of_the_run_and_at_its_end(tmp_path, folder):
    assert [step for step in range(1, 13) if crosses(step - 1, step, 12, 0.25)] == [3, 6, 9, 12]
    assert [step for step in range(1, 4) if crosses(step - 1, step, 3, 0.1)] == [1, 2, 3]
    assert not any(crosses(step - 1, step, 12, None) for step in range(1, 13))
    for every, wanted in ((0.5, [6, 12]), (None, [12])):
        run = tmp_path / str(every)
        settings = SFTSettings(model=folder, held_out=0.0, checkpoint_every=every, **FAST)
        train_sft(settings, data=FACTS, run_dir=run)
        assert sorted(map(step_of, (run / "checkpoints").iterdir())) == wanted


def test_each_epoch_has_its_own_order_which_depends_only_on_the_seed():
    def orders(epochs: int, seed: int = 0) -> list[list[int]]:
        settings = SFTSettings(num_epochs=epochs, minibatch_size=3, seed=seed)
        flat = [item for part in minibatches(range(10), settings) for item in part]
        return np.reshape(flat, (epochs, 10)).tolist()

    first, second, _ = orders(3)
    assert first != second and sorted(first) == sorted(second) == list(range(10))
    assert orders(2) == [first, second] and orders(1, seed=1) != [first]


@BOTH
def test_a_finished_run_only_writes_its_model_again(tmp_path, folder, stage):
    train, resume, kind, data = STAGES[stage]
    summary = train(kind(model=folder, held_out=0.25, **FAST), data=data, run_dir=tmp_path / "run")
    before = (tmp_path / "run" / "model" / "model.safetensors").read_bytes()
    again = resume(tmp_path / "run", data=data, listeners=[stopping(1)])
    assert again == summary
    assert (tmp_path / "run" / "model" / "model.safetensors").read_bytes() == before


@BOTH
def test_a_file_is_read_again_and_an_object_is_given_again(tmp_path, folder, stage):
    train, resume, kind, data = STAGES[stage]
    settings, file, other = kind(model=folder, **FAST), tmp_path / "rows.jsonl", tmp_path / "fewer.jsonl"
    for path, rows in ((file, data), (other, data[:4])):
        path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    for name, source in (("file", file), ("object", data)):
        with pytest.raises(Cut):
            train(
                settings, data=source, validation=data[:2], run_dir=tmp_path / name, listeners=[stopping(5)]
            )
    assert Run.open(tmp_path / "file").settings["data"] == str(file)
    assert Run.open(tmp_path / "object").settings["data"] == "<list>"
    with pytest.raises(
        ValueError, match=r"data of .* was <list>.*data=.* or tightrope resume .* --data FILE"
    ):
        resume(tmp_path / "object", validation=data[:2])
    with pytest.raises(ValueError, match="validation of .* was <list>.* Give it again: validation=... in Py"):
        resume(tmp_path / "file")
    with pytest.raises(ValueError, match="was learning from 8 examples, the data now have 4"):
        resume(tmp_path / "file", data=other, validation=data[:2])
    assert Run.open(tmp_path / "file").settings["data"] == str(file)
    resume(tmp_path / "file", validation=data[:2])
    resume(tmp_path / "object", data=data, validation=data[:2])
    assert same_end(tmp_path / "file", tmp_path / "object")


@BOTH
def test_a_model_in_memory_is_given_again(tmp_path, stage):
    train, resume, kind, data = STAGES[stage]
    settings = kind(held_out=0.0, **FAST)
    train(settings, data=data, model=(tiny_llama(), tokenizer()), run_dir=tmp_path / "whole")
    with pytest.raises(Cut):
        train(settings, data=data, model=(tiny_llama(), tokenizer()), run_dir=tmp_path / "broken",
              listeners=[stopping(7)])  # fmt: skip
    with pytest.raises(ValueError, match="The model of .* was <LlamaForCausalLM>"):
        resume(tmp_path / "broken", data=data)
    resume(tmp_path / "broken", data=data, model=(tiny_llama(), tokenizer()))
    assert same_end(tmp_path / "whole", tmp_path / "broken")


def test_a_run_of_another_command_is_named(tmp_path, folder):
    train_sft(SFTSettings(model=folder, **FAST), data=FACTS, run_dir=tmp_path / "run")
    with pytest.raises(ValueError, match="is a run of tightrope sft, expected one of tightrope reward"):
        resume_reward(tmp_path / "run", data=FACTS)
    with pytest.raises(ValueError, match="not a run folder"):
        resume_sft(tmp_path / "absent")


@BOTH
def test_the_command_finds_the_kind_of_run(tmp_path, folder, stage, capsys):
    data, run = tmp_path / "rows.jsonl", str(tmp_path / "run")
    data.write_text("".join(json.dumps(row) + "\n" for row in STAGES[stage][3]))
    words = ["--model", folder, "--data", str(data), "--max-tokens", "32", "--threads", "1"]
    assert main([stage, *words, "--run-dir", run, "--json"]) == 0
    summary = json.loads(capsys.readouterr().out.splitlines()[-1])
    data.rename(tmp_path / "moved.jsonl")
    assert main(["resume", run, "--json"]) == 2
    assert "no file" in capsys.readouterr().err
    assert main(["resume", run, "--data", str(tmp_path / "moved.jsonl"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == summary
    for option in ("--total-steps", "--reward"):
        assert main(["resume", run, option, "9"]) == 2
        assert f"run of {stage}, which has no {option}" in capsys.readouterr().err


def test_ctrl_c_prints_the_command(tmp_path, folder, capsys, monkeypatch):
    data, run = tmp_path / "facts.txt", str(tmp_path / "run")
    data.write_text("\n".join(FACTS))

    def interrupted(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(fitting, "take_step", interrupted)
        words = ["--model", folder, "--data", str(data), "--max-tokens", "32", "--threads", "1"]
        assert main(["sft", *words, "--run-dir", run]) == 130
    assert f"all 0 steps will be repeated. Go on with:\n  tightrope resume {run}\n" in capsys.readouterr().err
    assert main(["resume", run]) == 0


# ------------------------------------------------------------------------------------------------ memory


@BOTH
def test_memory_is_printed_first_and_a_job_that_cannot_fit_loads_nothing(
    tmp_path, folder, stage, monkeypatch
):
    train, _, kind, data = STAGES[stage]
    settings, events = kind(model=folder, tune="full", **FAST), []
    train(settings, data=data, run_dir=tmp_path / "run", listeners=[lambda event: events.append(event)])
    said = next(event.text for event in events if isinstance(event, Message))
    assert (
        isinstance(events[0], Message)
        and "model: Adam's two moments" in said
        and "memory at the peak" in said
    )
    loaded = []
    monkeypatch.setattr(memory, "available_memory", lambda device: 1000)
    monkeypatch.setattr(prepare, "load_causal", lambda *arguments: loaded.append(arguments))
    with pytest.raises(DoesNotFit, match="--gradient-checkpointing"):
        train(settings, data=data, run_dir=tmp_path / "other")
    assert not loaded and not (tmp_path / "other").exists()


@BOTH
def test_a_model_that_is_given_counts_by_its_config_and_is_there_already(tmp_path, stage, monkeypatch):
    train, _, kind, data = STAGES[stage]
    model, settings = tiny_llama(), kind(tune="full", **FAST)
    need = ledger(model.config, job_of(settings)).total
    there = sum(parameter.nbytes for parameter in model.parameters())
    monkeypatch.setattr(memory, "available_memory", lambda device: int(need / 0.9) - there - 100)
    with pytest.raises(DoesNotFit, match=f"needs about {amount(need)}"):
        train(settings, data=data, model=(model, tokenizer()), run_dir=tmp_path / "run")
    monkeypatch.setattr(memory, "available_memory", lambda device: int(need / 0.9) - there + 100)
    train(settings, data=data, model=(model, tokenizer()), run_dir=tmp_path / "run")
