"""The reward model: the loss by hand, scores by the mask, a saved scale, a folder that others can load."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from language.tiny import saved, tiny_gpt2, tiny_llama, tiny_of, tokenizer

from tightrope.algorithms.descent import CheckedSteps
from tightrope.language.alignment.align import align
from tightrope.language.data.batching import pad_left, pad_right
from tightrope.language.data.examples import Pair, preference_pairs
from tightrope.language.model import lora
from tightrope.language.model.architecture import parts
from tightrope.language.model.load import load_causal
from tightrope.language.model.saving import load_adapter
from tightrope.language.reward.model import SHIFT, RewardModel, last_real, load_reward
from tightrope.language.settings import RewardSettings
from tightrope.language.supervised.fit import Objective, take_step
from tightrope.language.supervised.preferences import (
    calibration,
    longest,
    make_head,
    normalise,
    pair_loss,
    right_order,
    score_differences,
    train_reward,
)
from tightrope.runs.run import Run
from tightrope.training.events import Evaluated, Finished, Message, Started, Updated

EOS = 3
MODELS = [tiny_llama, tiny_gpt2]


def settings_of(folder: str = "", **values) -> RewardSettings:
    usual = {
        "model": folder, "max_tokens": 32, "minibatch_size": 8, "learning_rate": 3e-3, "threads": 1,
        "tune": "full", "num_epochs": 2, "held_out": 0.2,
    }  # fmt: skip
    return RewardSettings(**{**usual, **values})


def preferences(count: int = 120, seed: int = 0) -> list[dict[str, str]]:
    """The word with more x is preferred."""
    generator = np.random.default_rng(seed)
    rows = []
    while len(rows) < count:
        words = ["".join(generator.choice(list("xyz"), size=generator.integers(2, 7))) for _ in range(2)]
        counts = [word.count("x") for word in words]
        if counts[0] != counts[1]:
            chosen, rejected = words if counts[0] > counts[1] else words[::-1]
            prompt = f"say {chr(97 + len(rows) % 26)}."
            rows.append({"prompt": prompt, "chosen": chosen, "rejected": rejected})
    return rows


def scorer(make=tiny_llama, seed: int = 0) -> RewardModel:
    model = make()
    return RewardModel(parts(model).base, make_head(model.config.hidden_size, seed), 0.0)


# ------------------------------------------------------------------------------------------------ the pieces


def test_the_head_begins_as_published():
    width = 40_000
    head = make_head(width, seed=5)
    weight = head.weight.detach()
    assert head.bias is None and weight.shape == (1, width)
    assert float(weight.std()) == pytest.approx(1 / math.sqrt(width + 1), rel=0.02)
    assert float(weight.mean()) == pytest.approx(0.0, abs=4 / width)
    assert torch.equal(head.weight, make_head(width, seed=5).weight)
    assert not torch.equal(head.weight, make_head(width, seed=6).weight)


def test_the_loss_is_bradley_terrys():
    difference = torch.tensor([2.0, -1.0, 0.0], requires_grad=True)
    loss = pair_loss(difference)
    wanted = sum(-math.log(1 / (1 + math.exp(-x))) for x in (2.0, -1.0, 0.0))
    assert float(loss.detach()) == pytest.approx(wanted)
    loss.backward()
    np.testing.assert_allclose(
        difference.grad, [1 / (1 + math.exp(-x)) - 1 for x in (2.0, -1.0, 0.0)], rtol=1e-5
    )
    assert math.isfinite(float(pair_loss(torch.tensor([-200.0]))))
    assert right_order(torch.tensor([2.0, -1.0, 0.0])).tolist() == [1.0, 0.0, 0.5]


def test_the_last_real_token_is_found_by_the_mask():
    hidden = torch.arange(12.0).reshape(3, 4, 1)
    real = torch.tensor([[0, 1, 1, 0], [1, 1, 1, 1], [0, 0, 0, 1]], dtype=torch.bool)
    assert last_real(hidden, real)[:, 0].tolist() == [2.0, 7.0, 11.0]


@pytest.mark.parametrize("make", MODELS)
@pytest.mark.parametrize("filler", [0, EOS, 50])
def test_padding_does_not_affect_a_score(make, filler):
    """Any side, any amount, any id, including the id of the EOS that ends every text."""
    model, texts = scorer(make), [[5, 6, EOS], [7, 8, 9, 10, EOS], [11, EOS]]
    alone = torch.cat([model.score(*pad_right([text])) for text in texts])
    for pad in (pad_left, pad_right):
        tokens, real = pad(texts, filler)
        torch.testing.assert_close(model.score(tokens, real), alone, rtol=1e-4, atol=1e-5)
        more = [
            torch.nn.functional.pad(x, (2, 3), value=value) for x, value in ((tokens, filler), (real, False))
        ]
        torch.testing.assert_close(model.score(*more), alone, rtol=1e-4, atol=1e-5)
    tokens, real = pad_right(texts, filler)
    torch.testing.assert_close(model.raw(tokens, real, right=True), alone, rtol=1e-4, atol=1e-5)
    model.shift = 2.0
    torch.testing.assert_close(model.score(tokens, real), alone - 2.0, rtol=1e-4, atol=1e-5)


def test_micro_batches_add_up_to_the_minibatch():
    rows = preferences(9)
    pairs, found = preference_pairs(rows, tokenizer(), eos=EOS, max_tokens=32), []
    for micro in (None, 2):
        model = scorer()

        def loss(items, model=model):
            found = score_differences(model, items)
            return pair_loss(found), {"margin": found.detach().sum()}

        objective = Objective("reward", "train", pairs, loss, lambda pair: 1, longest, dict)
        parameters = [*model.base.parameters(), *model.head.parameters()]
        settings = settings_of(micro_batch_size=micro, max_grad_norm=None)
        optimiser = torch.optim.SGD(parameters, lr=0.1)
        metrics = take_step(objective, pairs, optimiser, CheckedSteps(torch.device("cpu")), settings)
        found.append((metrics, [p.detach() for p in parameters]))
    assert found[0][0] == pytest.approx(found[1][0], rel=1e-4)
    for a, b in zip(found[0][1], found[1][1], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-6)
    fresh = scorer()
    with torch.no_grad():
        by_hand = torch.cat([score_differences(fresh, [pair]) for pair in pairs])
    assert found[0][0]["reward/margin"] == pytest.approx(float(by_hand.mean()), rel=1e-4)
    assert found[0][0]["reward/loss"] == pytest.approx(float(pair_loss(by_hand)) / 9, rel=1e-4)


def test_calibration_by_hand():
    sure = math.log(9)  # sigmoid: 0.9
    error, table = calibration(torch.tensor([sure, sure, sure, -sure, 0.0]))
    assert error == pytest.approx(
        0.8 * 0.15
    )  # four of five pairs at 0.9, of which 3/4 are right; the tie is right
    assert [(row["pairs"], row["accuracy"]) for row in table] == [(1, 0.5), (4, 0.75)]
    assert sum(row["pairs"] for row in table) == 5
    assert calibration(torch.tensor([1000.0]))[0] == pytest.approx(0.0)


def test_calibration_distinguishes_honest_from_overconfident():
    generator = torch.Generator().manual_seed(0)
    difference = 2 * torch.randn(20_000, generator=generator)
    right = torch.rand(20_000, generator=generator) < torch.sigmoid(difference.abs())
    honest = torch.where(right, difference.abs(), -difference.abs())
    assert calibration(honest)[0] < 0.02
    assert calibration(3 * honest)[0] > 0.1
    assert calibration(honest / 3)[0] > 0.1


@pytest.mark.parametrize("make", MODELS)
def test_normalised_scores_have_mean_0_and_deviation_1(make):
    model, texts = scorer(make), [[4 + i, 5 + i % 7, EOS] for i in range(30)]
    before = model.score(*pad_right(texts)).double()
    mean, deviation = normalise(model, texts, size=7)
    assert (mean, deviation) == (
        pytest.approx(float(before.mean())),
        pytest.approx(float(before.std(correction=0))),
    )
    after = model.score(*pad_right(texts)).double()
    assert float(after.mean()) == pytest.approx(0.0, abs=1e-5)
    assert float(after.std(correction=0)) == pytest.approx(1.0, abs=1e-5)
    same = scorer(make)
    weight = same.head.weight.clone()
    normalise(same, texts[:1], size=7)  # nothing to compare: the scale stays
    assert torch.equal(same.head.weight, weight)
    assert float(same.score(*pad_right(texts[:1]))) == pytest.approx(0.0, abs=1e-6)


# ------------------------------------------------------------------------------------------------- training


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> str:
    return saved(tmp_path_factory.mktemp("models") / "llama")


def texts_of(rows: list[dict[str, str]]) -> list[list[int]]:
    made = tokenizer()
    return [[*made(row["prompt"] + row["chosen"])["input_ids"], EOS] for row in rows]


@pytest.mark.parametrize("tune", ["full", "lora"])
@pytest.mark.parametrize("make", MODELS)
def test_it_learns_what_is_preferred_and_loads_elsewhere(tmp_path, make, tune):
    from transformers import AutoModelForSequenceClassification

    source, rows = saved(tmp_path / "base", make()), preferences(200)
    values = {"learning_rate": 1e-2, "num_epochs": 4} if tune == "lora" else {}
    summary = train_reward(settings_of(source, tune=tune, **values), data=rows, run_dir=tmp_path / "run")
    assert summary["final"]["reward/held_out_accuracy"] > 0.85
    assert sum(row["pairs"] for row in summary["calibration"]) == summary["held_out_pairs"] >= 40
    assert summary["pairs"] + summary["held_out_pairs"] == 200

    model = load_reward(tmp_path / "run")
    unseen = preferences(60, seed=9)
    pairs = preference_pairs(unseen, model.tokenizer, eos=EOS, max_tokens=32)
    with torch.no_grad():
        assert float(right_order(score_differences(model, pairs)).mean()) > 0.85
    trained = texts_of(rows)  # the chosen ones; a fifth of them is held out
    scores = model.score(*pad_right(trained))
    assert float(scores.mean()) == pytest.approx(0.0, abs=0.1)
    assert float(scores.std(correction=0)) == pytest.approx(1.0, abs=0.15)

    plain = AutoModelForSequenceClassification.from_pretrained(tmp_path / "run" / "model", num_labels=1)
    shift = json.loads((tmp_path / "run" / "model" / "config.json").read_text())[SHIFT]
    assert shift == model.shift and plain.score.bias is None
    with torch.no_grad():
        alone = torch.stack([plain(torch.tensor([text])).logits[0, 0] for text in trained[:8]])
    torch.testing.assert_close(alone, scores[:8] + shift, rtol=1e-4, atol=1e-4)
    if plain.config.pad_token_id is not None:
        tokens, real = pad_right(trained[:8], plain.config.pad_token_id)
        with torch.no_grad():
            batch = plain(tokens, attention_mask=real.long()).logits[:, 0]
        torch.testing.assert_close(batch, scores[:8] + shift, rtol=1e-4, atol=1e-4)
    card = (tmp_path / "run" / "model" / "README.md").read_text()
    assert repr(shift) in card and "subtracted" in card


def test_scores_are_normalised_on_the_demonstrations_that_are_given(tmp_path, folder):
    rows = preferences(60)
    shown = [{"prompt": "say a.", "completion": row["rejected"]} for row in rows]
    settings = settings_of(folder, num_epochs=1)
    summary = train_reward(settings, data=rows, demonstrations=shown, run_dir=tmp_path / "run")
    made = tokenizer()
    texts = [[*made("say a." + row["rejected"])["input_ids"], EOS] for row in rows]
    scores = load_reward(tmp_path / "run").score(*pad_right(texts)).double()
    assert float(scores.mean()) == pytest.approx(0.0, abs=1e-4)
    assert float(scores.std(correction=0)) == pytest.approx(1.0, abs=1e-4)
    assert summary["demonstrations"] == 60


def test_where_padding_is_the_eos_transformers_refuses_batches(tmp_path):
    """It would silently read the score before the EOS."""
    from transformers import AutoModelForSequenceClassification

    base, made = tiny_llama(), tokenizer()
    base.config.pad_token_id = EOS
    made.pad_token = "<eos>"
    rows = preferences(30)
    settings = settings_of("given", num_epochs=1)
    train_reward(settings, data=rows, model=(base, made), run_dir=tmp_path / "run")
    plain = AutoModelForSequenceClassification.from_pretrained(tmp_path / "run" / "model", num_labels=1)
    model, texts = load_reward(tmp_path / "run"), texts_of(rows)[:4]
    scores = model.score(*pad_right(texts, EOS))
    with torch.no_grad():
        alone = torch.stack([plain(torch.tensor([text])).logits[0, 0] for text in texts])
        torch.testing.assert_close(alone, scores + model.shift, rtol=1e-4, atol=1e-4)
        with pytest.raises(ValueError, match="batch sizes > 1"):
            plain(pad_right(texts, EOS)[0])


def test_the_adapter_scores_alike_on_a_trunk_that_is_shared(tmp_path, folder):
    """As in alignment: the adapter and its head on the policy's trunk."""
    from safetensors.torch import load_file

    rows = preferences(60)
    settings = settings_of(folder, tune="lora", lora_layers=2, learning_rate=1e-2)
    train_reward(settings, data=rows, run_dir=tmp_path / "run")
    trunk = load_causal(folder)
    load_adapter(trunk, "reward", tmp_path / "run" / "adapter")
    kept = load_file(tmp_path / "run" / "adapter" / "head.safetensors")
    head = torch.nn.Linear(32, 1, bias=False)
    head.weight.data = kept["score.weight"]
    shared = RewardModel(parts(trunk).base, head, float(kept["shift"]))
    tokens, real = pad_right(texts_of(rows))
    with lora.using(trunk, "reward"):
        found = shared.score(tokens, real)
    torch.testing.assert_close(found, load_reward(tmp_path / "run").score(tokens, real), rtol=1e-4, atol=1e-4)
    config = json.loads((tmp_path / "run" / "adapter" / "adapter_config.json").read_text())
    assert config["task_type"] == "SEQ_CLS" and config["modules_to_save"] == ["score"]
    assert config["base_model_name_or_path"] == folder


@pytest.mark.filterwarnings("ignore:.*is_gradient_checkpointing.*:FutureWarning")  # peft's own
@pytest.mark.parametrize("make", MODELS)
def test_peft_opens_the_adapter_with_its_head(tmp_path, make):
    from transformers import AutoModelForSequenceClassification

    peft = pytest.importorskip("peft")
    source, rows = saved(tmp_path / "base", make()), preferences(40)
    settings = settings_of(source, tune="lora", lora_layers=2, learning_rate=1e-2, num_epochs=1)
    train_reward(settings, data=rows, run_dir=tmp_path / "run")
    base = AutoModelForSequenceClassification.from_pretrained(source, num_labels=1)
    theirs = peft.PeftModel.from_pretrained(base, str(tmp_path / "run" / "adapter")).eval()
    model, texts = load_reward(tmp_path / "run"), texts_of(rows)[:5]
    with torch.no_grad():
        found = torch.stack([theirs(torch.tensor([text])).logits[0, 0] for text in texts])
    wanted = model.score(*pad_right(texts)) + model.shift
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)


HEADLESS = {
    "granite": ("Granite", {"logits_scaling": 4.0}),
    "cohere": ("Cohere", {}),
    "olmoe": ("Olmoe", {"num_experts": 4, "num_experts_per_tok": 2}),
    "glm4moe": (
        "Glm4Moe", {"n_routed_experts": 4, "num_experts_per_tok": 2, "moe_intermediate_size": 16,
                    "n_shared_experts": 1, "first_k_dense_replace": 1, "n_group": 1, "topk_group": 1,
                    "head_dim": 8},
    ),
    "ctrl": ("CTRL", {"n_embd": 16, "dff": 16, "n_layer": 3, "n_head": 2, "n_positions": 96}),
}  # fmt: skip


@pytest.mark.parametrize("tune", ["lora", "full"])
@pytest.mark.parametrize("name", HEADLESS)
@pytest.mark.filterwarnings("ignore:.*is_gradient_checkpointing.*:FutureWarning")  # peft's own
def test_families_without_a_class_that_scores_get_a_head_of_ours(tmp_path, name, tune):
    """The bare trunk and its head in a file: read back here, by the card's own lines, and through PEFT."""
    from transformers import AutoModelForCausalLM

    peft = pytest.importorskip("peft")
    kind, values = HEADLESS[name]
    source, rows = saved(tmp_path / "base", tiny_of(kind, **values)), preferences(40)
    settings = settings_of(source, tune=tune, learning_rate=1e-2, num_epochs=1)
    told = []
    train_reward(
        settings, data=rows, run_dir=tmp_path / "run",
        listeners=[lambda event: told.append(event) if isinstance(event, Message) else None],
    )  # fmt: skip
    assert not [event.text for event in told if event.level == "warning"]
    model, texts = load_reward(tmp_path / "run"), texts_of(rows)
    scores = model.score(*pad_right(texts))
    if tune == "full":  # of the chosen texts of all pairs, most were normalised on
        assert abs(float(scores.mean())) < 0.2 and abs(float(scores.std(correction=0)) - 1) < 0.2
    folder = tmp_path / "run" / "model"
    card = (folder / "README.md").read_text()
    lines = card.split("```python\n")[1].split("```")[0].replace("this/folder", str(folder))
    found = {"input_ids": torch.tensor([texts[0]])}
    with torch.no_grad():
        exec(lines, found)  # what the card tells others to write
    torch.testing.assert_close(found["score"].float(), scores[:1], rtol=1e-4, atol=1e-4)
    if tune == "lora":
        theirs = peft.PeftModel.from_pretrained(
            AutoModelForCausalLM.from_pretrained(source), str(tmp_path / "run" / "adapter")
        ).eval()
        inner = theirs.get_base_model()
        with torch.no_grad():
            hidden = getattr(inner, inner.base_model_prefix)(
                found["input_ids"], use_cache=False
            ).last_hidden_state[:, -1]
        again = (hidden @ model.head.weight.T)[:, 0] - model.shift
        torch.testing.assert_close(again, scores[:1], rtol=1e-4, atol=1e-4)


def test_alignment_reads_a_head_of_ours(tmp_path):
    """On the policy's trunk where both are adapters, and with a trunk of its own: the same first scores."""
    from tightrope.language import align

    source = saved(tmp_path / "base", tiny_of("Granite"))
    settings = settings_of(source, tune="lora", learning_rate=1e-2, num_epochs=1)
    train_reward(settings, data=preferences(40), run_dir=tmp_path / "reward")
    found = {}
    for tune in ("lora", "full"):
        run = align(
            model=source, prompts=["say a.", "say b."], reward=str(tmp_path / "reward"), tune=tune, seed=1,
            total_episodes=4, batch_size=4, minibatch_size=4, max_new_tokens=4, run_dir=tmp_path / tune,
        )  # fmt: skip
        rows = [json.loads(line) for line in (run.path / "samples.jsonl").read_text().splitlines()]
        found[tune] = [row["score"] for row in rows]
    assert found["lora"] == pytest.approx(found["full"], abs=1e-4) and len(set(found["full"])) == 4


def test_the_run_folder_records_what_happened(tmp_path, folder):
    data = tmp_path / "pairs.jsonl"
    data.write_text("".join(json.dumps(row) + "\n" for row in preferences(40)))
    settings = settings_of(folder, data=str(data), validation=str(data), num_epochs=1)
    events = []
    summary = train_reward(settings, run_dir=tmp_path / "run", listeners=[lambda event: events.append(event)])
    run = Run.open(tmp_path / "run")
    assert RewardSettings(**run.settings) == settings
    first, *rows = run.read_metrics()
    held = {"reward/held_out_accuracy", "reward/calibration_error"}
    assert set(first) == {"step", "seconds", *held}
    usual = {"reward/loss", "reward/accuracy", "reward/margin", "train/learning_rate", "train/grad_norm"}
    assert all(usual <= set(row) for row in rows) and [row["step"] for row in rows] == [1, 2, 3, 4, 5]
    assert held <= set(rows[-1]) and not held & set(rows[0])
    assert summary["held_out_pairs"] == summary["pairs"] == 40
    assert rows[-1]["reward/held_out_accuracy"] == summary["final"]["reward/held_out_accuracy"]
    assert [type(event) for event in events if not isinstance(event, Evaluated)] == [
        Message, Started, *[Updated] * 5, Finished]  # fmt: skip


def test_same_seed_same_bits_other_seed_others(tmp_path, folder):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        torch.manual_seed(seed + ord(name))  # the global generator has no effect
        train_reward(
            settings_of(folder, seed=seed, num_epochs=1), data=preferences(30), run_dir=tmp_path / name
        )
    a, b, c = ((tmp_path / name / "model" / "model.safetensors").read_bytes() for name in "abc")
    assert a == b != c


def test_pairs_of_one_prompt_are_held_out_together(tmp_path, folder, monkeypatch):
    from tightrope.language.supervised import prepare

    seen = {}
    whole = prepare.hold_out

    def spy(*arguments):
        seen["own"], seen["held"] = whole(*arguments)
        return seen["own"], seen["held"]

    monkeypatch.setattr(prepare, "hold_out", spy)
    rows = preferences(104)  # 26 prompts, four pairs each
    train_reward(settings_of(folder, num_epochs=1), data=rows, run_dir=tmp_path / "run")
    own, held = ({pair.chosen[: pair.prompt_length] for pair in seen[part]} for part in ("own", "held"))
    assert own and held and not own & held


def test_what_is_no_reward_model_is_named(tmp_path, folder):
    from transformers import LlamaConfig, LlamaForSequenceClassification

    with pytest.raises(ValueError, match=r"absent is not a reward model: it holds no config.json"):
        load_reward(tmp_path / "absent")
    with pytest.raises(ValueError, match="holds LlamaForCausalLM, which gives no scores"):
        load_reward(folder)
    shape = {"vocab_size": 64, "hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1}
    config = LlamaConfig(**shape, num_attention_heads=2, num_key_value_heads=2, num_labels=3)
    LlamaForSequenceClassification(config).save_pretrained(tmp_path / "three")
    with pytest.raises(ValueError, match="with 3 labels; expected one label"):
        load_reward(tmp_path / "three")


def test_other_peoples_reward_models_have_no_shift(tmp_path):
    from transformers import LlamaConfig, LlamaForSequenceClassification

    shape = {"vocab_size": 64, "hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1}
    config = LlamaConfig(**shape, num_attention_heads=2, num_key_value_heads=2, num_labels=1, pad_token_id=0)
    theirs = LlamaForSequenceClassification(config).eval()
    theirs.save_pretrained(tmp_path / "theirs")
    tokenizer().save_pretrained(tmp_path / "theirs")
    tokens, real = pad_right([[5, 6, EOS], [7, 8, 9, EOS]])
    with torch.no_grad():
        wanted = theirs(tokens, attention_mask=real.long()).logits[:, 0]
    torch.testing.assert_close(
        load_reward(tmp_path / "theirs").score(tokens, real), wanted, rtol=1e-4, atol=1e-5
    )


def test_a_pair_is_as_long_as_its_longer_text():
    assert longest(Pair((1, 2), (1, 2, 3), 1)) == longest(Pair((1, 2, 3), (1, 2), 1)) == 3


def as_reward(folder, positions: int = 96, bias: int = 0) -> str:
    """A reward model of others, in the format of transformers."""
    from safetensors.torch import load_file, save_file

    made = tiny_of("GPT2", "SequenceClassification", num_labels=1, max_position_embeddings=positions)
    made.save_pretrained(folder)
    tokenizer().save_pretrained(folder)
    if bias:
        tensors = load_file(folder / "model.safetensors")
        tensors = {**tensors, "score.bias": torch.zeros(bias)}
        save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})
    return str(folder)


def test_a_bias_of_several_numbers_is_refused(tmp_path):
    load_reward(as_reward(tmp_path / "one", bias=1))
    with pytest.raises(ValueError, match=r"two holds score.bias with 2 numbers; expected one"):
        load_reward(as_reward(tmp_path / "two", bias=2))


def test_a_reward_model_of_a_shorter_context_is_refused_before_the_run(tmp_path):
    judge, model = as_reward(tmp_path / "judge", positions=16), saved(tmp_path / "model")
    values = {
        "prompts": ["abcdefgh"],
        "total_episodes": 8,
        "batch_size": 8,
        "lora_rank": 2,
        "max_new_tokens": 4,
    }
    message = (
        "max_prompt_tokens 13 [+] max_new_tokens 4 exceed the context of the reward model .*judge, 16 tokens"
    )
    with pytest.raises(ValueError, match=message):
        align(model=model, reward=judge, run_dir=tmp_path / "run", max_prompt_tokens=13, **values)
    assert not (tmp_path / "run").exists()
    align(model=model, reward=judge, run_dir=tmp_path / "run", max_prompt_tokens=12, **values)
