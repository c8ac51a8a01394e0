"""An alignment run that is killed at any moment and resumed ends bit for bit like an uninterrupted run."""

from __future__ import annotations

import json
import random
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from language.tiny import saved, tiny_llama

from tightrope.algorithms import descent
from tightrope.cli.flags import UsageError
from tightrope.cli.main import main
from tightrope.cli.options import training_options
from tightrope.language.alignment import align as alignment
from tightrope.language.alignment import iteration as trainer
from tightrope.language.alignment.align import align, resume_align
from tightrope.language.alignment.iteration import Trainer
from tightrope.language.compare import sample_run
from tightrope.language.settings import AlignSettings
from tightrope.runs import checkpoint, signals
from tightrope.runs.lock import RunInUse
from tightrope.runs.run import Run

PROMPTS = ["ab", "cde", "f", "ghij", "kl", "mno", "p"]
SMALL = {
    "total_episodes": 56, "batch_size": 8, "minibatch_size": 4, "max_new_tokens": 4, "lora_rank": 2,
    "seed": 1, "learning_rate": 1e-2, "checkpoint_every": 0.25, "evaluate_every": 0.3, "kl_goal": 1.0,
    "threads": 1, "kl_horizon": 50.0, "held_out_prompts": 1, "ptx_weight": 0.1, "critic": "adapter",
}  # fmt: skip


class Killed(BaseException):
    """Ends a run at once."""


def letters(completions: list[str], **_: Any) -> list[float]:
    return [sum(c in "abcdefghijklm" for c in text) / 4 for text in completions]


def vowels(completions: list[str], **_: Any) -> list[float]:
    return [sum(c in "aeiou" for c in text) / 4 for text in completions]


GIVEN = {"prompts": PROMPTS, "reward": letters, "gold": vowels}


@pytest.fixture(scope="module")
def values(tmp_path_factory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("model")
    texts = folder / "texts.txt"
    texts.write_text("abc.\ndef.\nghi.\n")
    return {**SMALL, "model": saved(folder / "llama", tiny_llama(2)), "ptx_data": str(texts)}


@pytest.fixture(scope="module")
def whole(tmp_path_factory, values) -> Any:
    return align(run_dir=tmp_path_factory.mktemp("whole") / "run", **GIVEN, **values)


def rows_of(run: Path, name: str) -> list[dict]:
    rows = [json.loads(line) for line in (run / name).read_text().splitlines()]
    return [{k: v for k, v in row.items() if k != "seconds" and not k.startswith("time/")} for row in rows]


def state_of(run: Path) -> tuple[Any, dict]:
    _, tensors, state = Run.open(run).newest()
    state["newest"] = {k: v for k, v in state["newest"].items() if not k.startswith("time/")}
    return tensors, {**state, "seconds": 0, "records": None}


def assert_same_end(a: Path, b: Path) -> None:
    """Weights, critic, optimiser, generators, KL controller, monitor, metrics, and every sampled token."""
    (tensors, state), (others, other) = state_of(a), state_of(b)
    assert state == other
    assert all(torch.equal(x, others[g][k]) for g, group in tensors.items() for k, x in group.items())
    assert rows_of(a, "metrics.jsonl") == rows_of(b, "metrics.jsonl")
    assert rows_of(a, "samples.jsonl") == rows_of(b, "samples.jsonl")
    final, same = (json.loads((x / "summary.json").read_text())["final"] for x in (a, b))
    assert final == same and final


def killed(run: Path, values: dict, patch: Any, place: Any, name: str, call: int) -> None:
    real, count = getattr(place, name), 0

    def dying(*arguments: Any, **keywords: Any) -> Any:
        nonlocal count
        count += 1
        if count == call:
            raise Killed
        return real(*arguments, **keywords)

    with patch.context() as inner, pytest.raises(Killed):
        inner.setattr(place, name, dying)
        if (run / "settings.json").exists():
            resume_align(run, **GIVEN)
        else:
            align(run_dir=run, **GIVEN, **values)


PHASES = {
    "first sampling": (trainer, "gather", 1),
    "scores": (trainer, "rewards_of", 4),
    "update": (descent, "check_first_ratios", 5),
    "row": (Run, "record", 3),
    "samples": (Run, "record_samples", 5),
    "save": ("tightrope.runs.checkpoint", "write_file", 4),
    "model": (trainer, "save_model", 1),
}


@pytest.mark.parametrize("phase", PHASES)
def test_every_phase_can_be_the_last(tmp_path, monkeypatch, values, whole, phase):
    place, name, call = PHASES[phase]
    killed(tmp_path, values, monkeypatch, checkpoint if isinstance(place, str) else place, name, call)
    resume_align(tmp_path, **GIVEN)
    assert_same_end(whole.path, tmp_path)


def test_five_hops_end_where_none_does(tmp_path, monkeypatch, values, whole):
    draw = random.Random(2)
    for _ in range(5):
        killed(tmp_path, values, monkeypatch, Trainer, "_one_iteration", draw.choice([1, 2, 2]))
    resume_align(tmp_path, **GIVEN)
    assert_same_end(whole.path, tmp_path)


def test_a_run_that_its_budget_stopped_stays_stopped(tmp_path, monkeypatch, values):
    tight = {**values, "kl_budget": 1e-6}
    stopped = align(run_dir=tmp_path / "whole", **GIVEN, **tight)
    assert stopped.summary["stopped_early"] and stopped.summary["episodes"] < 56
    killed(tmp_path / "run", tight, monkeypatch, trainer, "save_model", 1)
    resume_align(tmp_path / "run", **GIVEN)
    assert_same_end(tmp_path / "whole", tmp_path / "run")


def test_the_command_names_the_judge_again(tmp_path, monkeypatch, values, capsys):
    """Stopped by SIGTERM: 143, what was saved, and a working command."""
    judge, prompts, run = tmp_path / "judge.py", tmp_path / "prompts.txt", tmp_path / "run"
    judge.write_text("def score(completions, **_):\n    return [float(len(c)) for c in completions]\n")
    prompts.write_text("\n".join(PROMPTS))
    words = ["--model", values["model"], "--data", str(prompts), "--reward", f"{judge}:score"]
    words += ["--run-dir", str(run), "--total-episodes", "32", "--batch-size", "8", "--minibatch-size", "8"]
    words += ["--max-new-tokens", "4", "--lora-rank", "2", "--checkpoint-every", "0.5", "--threads", "1"]
    real = Trainer._one_iteration

    def stop(self: Trainer, *arguments: Any) -> Any:
        if self.iteration == 3:
            raise signals.Stopped(15)
        return real(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "_one_iteration", stop)
        assert main(["align", *words]) == 143
    said = capsys.readouterr().err
    assert "Stopped by SIGTERM at response 24. It is saved in " in said
    assert "step-000000000024; what was under way is repeated." in said
    assert f"\n  tightrope resume {run} --reward {judge}:score\n" in said
    assert main(["resume", str(run), "--reward", f"{judge}:score", "--quiet"]) == 0


def test_a_function_must_be_named_again_whatever_its_name(tmp_path, values, monkeypatch):
    """It is mistaken neither for a reward of this package nor for a folder of the same name."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rewards").mkdir()
    for name in ("length", "rewards"):

        def own(completions: list[str], **_: Any) -> list[float]:
            return [-1.0] * len(completions)

        own.__name__ = name
        given = {**GIVEN, "reward": own}
        align(run_dir=tmp_path / name / "run", **given, **{**values, "total_episodes": 8})
        with pytest.raises(ValueError, match=f"The reward of .* was '<{name}>': code"):
            resume_align(tmp_path / name / "run", **{**given, "reward": None}, total_episodes=16)


def test_the_advice_names_every_reward_with_its_weight(tmp_path, values, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    settings = AlignSettings(
        model=values["model"],
        data="<list>",
        reward=("folder=2", "length=0.01", "judge.py:good=0.1", "<own>=3"),
    )
    typed = (
        "tightrope resume run --reward folder=2.0 --reward length=0.01 --reward judge.py:good=0.1 "
        "--reward FILE.py:function=3.0"
    )
    with pytest.raises(ValueError) as caught:
        alignment._require_what_no_file_gives("run", settings, PROMPTS, None, None)
    assert str(caught.value).endswith(typed)
    (tmp_path / "settings.json").write_text(json.dumps(settings.with_values(data="x.txt").to_json()))
    with pytest.raises(UsageError) as refused:
        training_options("align", ["--settings", "settings.json"])
    assert str(refused.value).endswith(typed.partition("run ")[2])


@pytest.mark.parametrize(
    ("was", "given", "same"),
    [
        (("length=0.5",), "length=0.5", True),
        (("length=0.5",), ["length"], False),
        (("length",), ["length=0.1"], False),
        (("<letters>",), letters, True),
        (("<letters>",), (letters, 0.5), False),
        (("<letters>=0.5",), (letters, 0.5), True),
        (("<letters>",), "judge.py:letters", True),
        (("<letters>",), "length", False),
        (("length",), letters, False),
        (("judge.py:good", "length=2"), ["moved/judge.py:good", ("length", 2)], True),
        (("judge.py:good", "length=2"), ["judge.py:good"], False),
        (("judge.py:good", "length=2"), ["length=2", "judge.py:good"], False),
        (("judge.py:good",), "judge.py:bad", False),
        (("runs/gone=2",), ["elsewhere/reward=2"], True),
    ],
)
def test_a_run_goes_on_with_the_rewards_and_weights_that_it_has(was, given, same):
    settings = AlignSettings(data="x.txt", reward=was)
    if same:
        alignment._require_what_no_file_gives("run", settings, PROMPTS, given, None)
        return
    with pytest.raises(ValueError, match="The reward of run was .*with the same weights"):
        alignment._require_what_no_file_gives("run", settings, PROMPTS, given, None)


def test_other_prompts_and_less_than_was_done_are_refused(tmp_path, values, whole):
    run = tmp_path / "run"
    shutil.copytree(whole.path, run)
    before = (run / "summary.json").read_bytes(), (run / "settings.json").read_bytes()
    with pytest.raises(ValueError, match="other prompts than these"):
        resume_align(run, **{**GIVEN, "prompts": [*PROMPTS[:-1], "q"]}, total_episodes=64)
    with pytest.raises(ValueError, match="has had 56 responses already"):
        resume_align(run, **GIVEN, total_episodes=24)
    assert ((run / "summary.json").read_bytes(), (run / "settings.json").read_bytes()) == before
    told = []
    again = resume_align(run, **GIVEN, listeners=[lambda event: told.append(str(event))])
    assert any("--total-episodes N continues" in text for text in told)
    assert again.summary["final"] == whole.summary["final"] and again.summary["wall_seconds"] > 0


def test_a_negative_seed_of_sampling_is_refused(whole):
    with pytest.raises(ValueError, match="seed is -1, expected 0 or more"):
        sample_run(whole.path, seed=-1)


@pytest.mark.parametrize("name", ["AlignSettings.from_json", "_require_what_no_file_gives", "Trainer"])
def test_a_run_that_somebody_writes_is_refused_before_its_settings_are_looked_at(
    tmp_path, whole, monkeypatch, name
):
    run = shutil.copytree(whole.path, tmp_path / "run")

    def looked(*_: Any, **__: Any) -> Any:
        raise AssertionError("looked at before the lock was ours")

    monkeypatch.setattr(f"{alignment.__name__}.{name}", looked)
    with Run.open(run).lock(), pytest.raises(RunInUse, match="this process"):
        resume_align(run, **GIVEN)
    with pytest.raises(AssertionError, match="looked at"):
        resume_align(run, **GIVEN)
    Run.open(run).lock().close()  # the failed call has released the lock
