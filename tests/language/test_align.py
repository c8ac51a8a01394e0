"""The third stage end to end on a tiny model: it learns, saves and resumes, and mistakes are named."""

import asyncio
import json

import numpy as np
import pytest
import torch
from language.tiny import padded, saved, tiny_gpt2

from tightrope.algorithms import ppo
from tightrope.cli.main import main
from tightrope.language import align
from tightrope.language.alignment.align import resume_align
from tightrope.language.model.trunk import Trunk
from tightrope.language.settings import AlignSettings
from tightrope.training.events import Finished, Updated

PROMPTS = ["ab", "cde", "f", "ghij"]
FAST = {
    "total_episodes": 64, "batch_size": 16, "minibatch_size": 8, "max_new_tokens": 6, "lora_rank": 4,
    "learning_rate": 1e-2, "seed": 1,
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return saved(tmp_path_factory.mktemp("model"), chat=True)


def letters(prompts, completions, **columns):
    """The number of characters from a to m."""
    return [sum(c in "abcdefghijklm" for c in text) / 6 for text in completions]


def test_it_learns_what_is_rewarded(folder, tmp_path):
    values = {**FAST, "total_episodes": 640, "kl_beta": 0.01, "learning_rate": 2e-2}
    run = align(model=folder, prompts=PROMPTS, reward=letters, run_dir=tmp_path / "run", **values)
    scores = [row["objective/scores"] for row in run.metrics]
    assert np.mean(scores[-5:]) > np.mean(scores[:5]) + 0.25
    assert run.metrics[0]["objective/kl"] == pytest.approx(0, abs=1e-4)
    assert all(row["train/log_ratio_first"] <= 1e-4 for row in run.metrics)
    assert run.summary["episodes"] == 640 == run.metrics[-1]["step"]


@pytest.mark.parametrize(
    "values",
    [
        {"critic": "adapter", "lora_layers": 1},
        {"critic": "separate", "critic_warmup": 1},
        {"critic": "none", "samples_per_prompt": 4},
        {"tune": "full", "critic": "head", "learning_rate": 1e-3},
        {"kl": "exact-split"},
        {"kl": "k2-loss", "micro_batch_size": 3},
        {"kl": "exact-loss", "normalise_advantages": False},
        {"top_k": 5, "temperature": 0.7},
        {"truncation": "bootstrap", "missing_eos_penalty": 1.0, "ignore_eos": False},
        {"whiten_rewards": True, "reward_clip": 0.5, "reward_scale": 2.0},
        {"critic_lambda": 1.0, "lambda_alpha": 0.5},
        {"kl_goal": 1.0, "kl_horizon": 100.0},
        {"gradient_checkpointing": True},
        {"dtype": "bfloat16"},
    ],
    ids=lambda values: ",".join(f"{k}={v}" for k, v in values.items()),
)
def test_every_choice_runs(folder, tmp_path, values):
    seen = []
    run = align(model=folder, prompts=PROMPTS, reward=letters, run_dir=tmp_path / "run",
                listeners=[lambda event: seen.append(event)], **{**FAST, **values})  # fmt: skip
    assert len(run.metrics) == 4 and isinstance(seen[-1], Finished)
    assert all(np.isfinite(v) for row in run.metrics for v in row.values() if v is not None)
    if "kl_goal" in values:
        assert run.metrics[-1]["objective/kl_beta"] != run.metrics[0]["objective/kl_beta"]


def test_both_stories_call_the_one_update(folder, tmp_path, monkeypatch):
    import tightrope

    calls = []
    real = ppo.update

    def spy(*args, **keywords):
        calls.append(type(args[0]).__name__)
        return real(*args, **keywords)

    monkeypatch.setattr(ppo, "update", spy)
    align(
        model=folder,
        prompts=PROMPTS,
        reward=letters,
        run_dir=tmp_path / "run",
        **{**FAST, "total_episodes": 16},
    )
    tightrope.PPO(
        "CartPole-v1", engine="torch", num_envs=2, num_steps=32, minibatch_size=32, num_epochs=1
    ).learn(64)
    assert len(calls) == 2 and calls[0] == "PolicyModel"


def test_the_aligned_model_opens_elsewhere(folder, tmp_path):
    from transformers import AutoModelForCausalLM, AutoTokenizer

    run = align(model=folder, prompts=PROMPTS, reward=letters, run_dir=tmp_path / "run", **FAST)
    tokens, real, _ = padded()
    plain = AutoModelForCausalLM.from_pretrained(run.model)
    assert AutoTokenizer.from_pretrained(run.model).chat_template
    bare = AutoModelForCausalLM.from_pretrained(folder)
    a, b = (Trunk(model.eval()).hidden(tokens, real)[real] for model in (plain, bare))
    assert (a - b).abs().max() > 1e-3  # trained weights, not the initial ones
    names = {path.suffix for path in run.path.rglob("*") if path.is_file()}
    assert not names & {".bin", ".pt", ".pth", ".pkl"}
    peft = pytest.importorskip("peft")
    assert peft.PeftConfig.from_pretrained(str(run.path / "adapter")).r == 4


def test_gpt2_without_pad_token(tmp_path):
    """Learnt positions, transposed weights, EOS as the only special token."""
    folder = saved(tmp_path / "gpt2", tiny_gpt2())
    run = align(model=folder, prompts=PROMPTS, reward=letters, run_dir=tmp_path / "run", lora_layers=2,
                **{**FAST, "learning_rate": 1e-3})  # fmt: skip
    assert run.summary["episodes"] == 64


def vowels(completions, **_):
    return [sum(c in "aeiou" for c in text) / 6 for text in completions]


def test_a_resumed_run_ends_like_an_uninterrupted_one(folder, tmp_path):
    """Bit for bit: weights, optimiser, random numbers, prompt order, kl_beta, the gold judge's samples."""
    values = {**FAST, "checkpoint_every": 0.5, "kl_goal": 1.0, "kl_horizon": 100.0, "evaluate_every": 0.3}
    given = {"prompts": PROMPTS, "reward": letters, "gold": vowels}
    whole = align(model=folder, run_dir=tmp_path / "a", **given, **values)
    half = tmp_path / "b"

    class Cut(Exception):
        pass

    def stop(event):
        if isinstance(event, Updated) and event.step >= 48:
            raise Cut

    with pytest.raises(Cut):
        align(model=folder, run_dir=half, listeners=[stop], **given, **values)
    for missing in ("reward", "gold"):
        with pytest.raises(ValueError, match=f"The {missing} of .* no file may import"):
            resume_align(half, **{**given, missing: None})
    again = resume_align(half, **given)
    assert sum(row.get("eval/gold") is not None for row in whole.metrics) >= 2
    seconds = [row["seconds"] for row in again.metrics]
    assert seconds == sorted(seconds)
    drop = lambda row: {k: v for k, v in row.items() if not k.startswith("time/") and k != "seconds"}  # noqa: E731
    assert [drop(row) for row in again.metrics] == [drop(row) for row in whole.metrics]
    from safetensors.torch import load_file

    a, b = (load_file(run.path / "adapter" / "adapter_model.safetensors") for run in (whole, again))
    assert all(torch.equal(a[name], b[name]) for name in a)


def test_same_seed_same_bits_other_seed_others(folder, tmp_path):
    found = []
    for number, seed in enumerate((1, 1, 2)):
        run = align(model=folder, prompts=PROMPTS, reward=letters, run_dir=tmp_path / str(number),
                    **{**FAST, "seed": seed})  # fmt: skip
        found.append([row["objective/scores"] for row in run.metrics])
    assert found[0] == found[1] != found[2]


def test_samples_that_do_not_count_are_masked_and_counted(folder, tmp_path):
    def moody(prompts, completions, **columns):
        return [None if i % 4 == 0 else float("nan") if i % 4 == 1 else 1.0 for i in range(len(prompts))]

    run = align(model=folder, prompts=PROMPTS, reward=moody, run_dir=tmp_path / "run", **FAST)
    assert [row["objective/masked_samples"] for row in run.metrics] == [8.0] * 4
    assert all(row["objective/scores"] == 1.0 for row in run.metrics)


def test_trl_reward_functions_run_unchanged(folder, tmp_path):
    """Keyword arguments, columns, chats as message lists, async, several with weights, logging."""
    seen = {}

    async def hidden(prompts, completions, answer, log_metric, trainer_state, **columns):
        await asyncio.sleep(0)
        seen["completion"], seen["answer"], seen["state"] = (
            completions[0],
            answer[0],
            trainer_state.global_step,
        )
        log_metric("calls", 1.0)
        return [0.5] * len(prompts)

    rows = [{"prompt": [{"role": "user", "content": text}], "answer": text[::-1]} for text in PROMPTS]
    ones = lambda completions, **_: [1.0] * len(completions)  # noqa: E731
    run = align(model=folder, prompts=rows, reward=[(hidden, 2.0), ones],
                run_dir=tmp_path / "run", **FAST)  # fmt: skip
    assert run.metrics[0]["objective/scores"] == pytest.approx(2.0)
    assert seen["completion"][0]["role"] == "assistant" and seen["answer"] in {p[::-1] for p in PROMPTS}


@pytest.mark.parametrize(
    "values, words",
    [
        ({"prompts": []}, "no prompts|no rows|empty"),
        ({"prompts": [""]}, "tokens|empty"),
        ({"prompts": [{"text": "x"}]}, "prompt"),
        ({"max_new_tokens": 90}, "context"),
        ({"reward": "nowhere.py:f"}, "nowhere"),
        ({"reward": 3}, "reward is 3"),
        ({"reward": lambda prompts, completions, **_: [1.0]}, "1"),
        ({"critic": None}, "samples_per_prompt"),
        ({"critic": None, "samples_per_prompt": 4, "critic_warmup": 1}, "critic_warmup needs a critic"),
        ({"critic": None, "samples_per_prompt": 4, "truncation": "bootstrap"}, "truncation needs a critic"),
        ({"total_episodes": 3, "samples_per_prompt": 4}, "not one prompt"),
        ({"tune": "full", "dtype": "bfloat16"}, "steps of 1e-5 are lost"),
        ({"prompts": ["a", "b", "c", "a"], "gold": letters}, "at least 4"),
        ({"reward": (letters, float("nan"))}, "finite"),
        ({"kl": "k3-reward"}, "expected one of: k1-reward"),
        ({"learning_rte": 1.0}, "learning_rate"),
        ({"init_kl_coef": 0.1}, "Did you mean 'kl_beta'"),
        ({"model": "no such model"}, "no such model"),
        ({"lora_layers": 9}, "layers"),
        ({"minibatch_size": 0}, "minibatch_size"),
    ],
    ids=lambda value: str(value)[:30],
)
def test_mistakes_are_named(folder, tmp_path, values, words):
    common = {"model": folder, "prompts": PROMPTS, "reward": letters, "run_dir": tmp_path / "run", **FAST}
    with pytest.raises(ValueError, match=words):
        align(**{**common, **values})


def test_a_kl_budget_stops_the_run(folder, tmp_path):
    values = {**FAST, "total_episodes": 640, "kl_beta": 0.0, "learning_rate": 5e-2, "kl_budget": 0.5}
    run = align(model=folder, prompts=PROMPTS, reward=letters, run_dir=tmp_path / "run", **values)
    assert run.summary["stopped_early"] and run.summary["episodes"] < 640
    assert run.metrics[-1]["objective/kl"] >= 0.5 > run.metrics[-2]["objective/kl"]
    assert "train/grad_norm" in run.metrics[-2] and "train/grad_norm" not in run.metrics[-1]


def test_critic_none_is_accepted_as_in_python():
    assert AlignSettings(critic=None, samples_per_prompt=2).critic == "none"


def test_the_commands(folder, tmp_path, capsys):
    (tmp_path / "prompts.jsonl").write_text("".join(json.dumps({"prompt": p}) + "\n" for p in PROMPTS))
    (tmp_path / "mine.py").write_text(
        "def score(completions, **_):\n    return [float(len(c)) for c in completions]\n"
    )
    words = ["--model", folder, "--data", str(tmp_path / "prompts.jsonl"), "--total-episodes", "32",
             "--lora-rank", "2",
             "--batch-size", "16", "--minibatch-size", "16", "--max-new-tokens", "4"]  # fmt: skip
    run = tmp_path / "run"
    reward = f"{tmp_path / 'mine.py'}:score"
    assert main(["align", *words, "--reward", reward, "--run-dir", str(run), "--json"]) == 0
    seen = capsys.readouterr()
    assert json.loads(seen.out.splitlines()[-1])["episodes"] == 32
    assert "after 16 responses" in seen.err and "advantage" in seen.err  # a table at every checkpoint
    assert main(["sample", str(run), "--count", "2"]) == 0
    assert "before" in capsys.readouterr().out
    assert main(["sample", str(run), "--recorded", "--count", "3"]) == 0
    shown = capsys.readouterr().out
    assert "after 32 responses" in shown and "advantage" in shown and "score" in shown
    assert main(["sample", str(run), "--recorded", "--json"]) == 0
    recorded = json.loads(capsys.readouterr().out)["samples"]
    assert len(recorded) == 8 and {row["step"] for row in recorded} == {32}
    assert [row["score"] for row in recorded] == sorted((row["score"] for row in recorded), reverse=True)
    assert main(["sample", str(run), "--recorded", "--seed", "1"]) == 2
    capsys.readouterr()
    assert main(["resume", str(run), "--total-steps", "48"]) == 2
    assert "--reward" in capsys.readouterr().err
    assert main(["resume", str(run), "--total-steps", "48", "--reward", reward, "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["episodes"] == 48
    assert main(["align", *words, "--reward", "length", "--recipe", "ziegler2019", "--dry-run"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["kl_goal"] == 6.0 and shown["batch_size"] == 16


def test_the_doctor_finds_nothing_wrong_with_a_healthy_model(folder, capsys):
    assert main(["doctor", "--model", folder, "--json"]) == 0
    findings = json.loads(capsys.readouterr().out.splitlines()[-1])["findings"]
    assert len(findings) > 15 and all(finding["good"] for finding in findings)


def test_the_doctor_finds_a_model_that_reads_its_padding(folder, monkeypatch):
    """A trunk that ignores its mask and positions: the gradient depends on padding, sampling on the cache."""
    from tightrope.language import selfcheck
    from tightrope.language.model import trunk

    real = trunk._run

    def careless(base, mask, **inputs):
        return (
            base(use_cache=False, **inputs).last_hidden_state
            if "input_ids" in inputs
            else real(base, mask, **inputs)
        )

    monkeypatch.setattr(trunk, "_run", careless)
    bad = [finding.what for finding in selfcheck.check_model(folder) if not finding.good]
    assert any("amount of padding" in what for what in bad)
