"""Supervised fine-tuning: the correct loss, packing and padding without effect, and it learns."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
import torch
from language.test_data import chatml, random_examples
from language.tiny import saved, tiny_gpt2, tiny_llama, tokenizer

from tightrope.algorithms.descent import CheckedSteps
from tightrope.algorithms.nonfinite import NonFiniteError
from tightrope.language.data.batching import collate, pack_rows, row_of
from tightrope.language.data.examples import hold_out
from tightrope.language.model import lora
from tightrope.language.model.architecture import parts
from tightrope.language.model.load import load_causal, load_tokenizer
from tightrope.language.settings import SFTSettings
from tightrope.language.supervised.fit import Objective, micro_batches, take_step
from tightrope.language.supervised.prepare import load_for_training
from tightrope.language.supervised.sft import hidden_states, mean_loss, token_loss, train_sft
from tightrope.runs.run import Run
from tightrope.training.events import Finished, Message, Started, Updated

MODELS = [tiny_llama, tiny_gpt2]
FACTS = [f"{a} is {b}." for a, b in zip("abcdefgh", "ponmlkji", strict=True)]


def settings_of(folder: str = "", **values) -> SFTSettings:
    usual = {"model": folder, "max_tokens": 32, "minibatch_size": 4, "learning_rate": 1e-2, "threads": 1}
    return SFTSettings(**{**usual, **values})


def rows_of(examples):
    return [row_of([example]) for example in examples]


# ------------------------------------------------------------------------------------------ what is computed


@pytest.mark.parametrize("make", MODELS)
def test_packed_examples_have_the_same_logits_as_separate_ones(make):
    model, examples = make(), random_examples(12, 20)
    packed = pack_rows(examples, 40)
    assert len(packed) < len(examples)
    alone = {}
    for example in examples:
        with torch.no_grad():
            alone[example.tokens] = model(torch.tensor([example.tokens])).logits[0]
    batch = collate(packed, filler=11)
    with torch.no_grad():
        together = parts(model).head(hidden_states(model, batch))
        leaking = model(batch.tokens).logits
    worst, worst_leaking = 0.0, 0.0
    for row, segments in enumerate(batch.segments):
        for segment in range(int(segments.max()) + 1):
            inside = segments == segment
            wanted = alone[tuple(batch.tokens[row][inside].tolist())]
            worst = max(worst, float((together[row][inside] - wanted).abs().max()))
            worst_leaking = max(worst_leaking, float((leaking[row][inside] - wanted).abs().max()))
    assert worst < 1e-5
    assert worst_leaking > 0.1  # without the blocks, texts see each other: the test can fail


@pytest.mark.parametrize("make", MODELS)
@pytest.mark.parametrize("filler", [0, 3, 40])
def test_loss_and_gradient_equal_those_of_separate_texts(make, filler):
    """Against transformers' own loss on one unpadded text at a time; the prompt's tokens do not count."""
    model, examples = make(), random_examples(6, 15)
    examples = [
        dataclasses.replace(e, learn=(*[False] * (len(e.learn) // 2), *e.learn[len(e.learn) // 2 :]))
        for e in examples
    ]
    wanted = torch.zeros(())
    for example in examples:
        labels = [token if keep else -100 for token, keep in zip(example.tokens, example.learn, strict=True)]
        out = model(torch.tensor([example.tokens]), labels=torch.tensor([labels]))
        wanted = wanted + out.loss * sum(example.learn)
    wanted.backward()
    gradients = [p.grad.clone() for p in model.parameters()]
    for rows in (rows_of(examples), pack_rows(examples, 40)):
        model.zero_grad()
        loss = token_loss(model, collate(rows, filler=filler))
        torch.testing.assert_close(loss, wanted, rtol=1e-5, atol=1e-4)
        loss.backward()
        for parameter, gradient in zip(model.parameters(), gradients, strict=True):
            torch.testing.assert_close(parameter.grad, gradient, rtol=1e-3, atol=1e-4)
    count = sum(sum(example.learn) for example in examples)
    assert mean_loss(model, rows_of(examples), 4) == pytest.approx(float(wanted.detach()) / count, rel=1e-5)


def objective_of(model, rows) -> Objective:
    def loss(items):
        return token_loss(model, collate(items)), {}

    return Objective("sft", "sft", rows, loss, lambda row: int(row.learn.sum()), len, dict)


@pytest.mark.parametrize("size", [1, 2, 3, 5])
def test_micro_batches_add_up_to_the_minibatch(size):
    """The mean is over the tokens of the minibatch, so that splitting it changes nothing."""
    rows, found = rows_of(random_examples(7, 20)), []
    for micro in (None, size):
        model = tiny_llama()
        optimiser = torch.optim.SGD(model.parameters(), lr=1.0)
        settings = settings_of(micro_batch_size=micro, max_grad_norm=None)
        metrics = take_step(
            objective_of(model, rows), rows, optimiser, CheckedSteps(torch.device("cpu")), settings
        )
        found.append((metrics, [p.detach() for p in model.parameters()]))
    (whole, wanted), (split, weights) = found
    assert split == pytest.approx(whole, rel=1e-5)
    for a, b in zip(weights, wanted, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-6)


def test_a_gradient_that_is_not_finite_stops_before_the_step():
    model = tiny_llama()
    rows = rows_of(random_examples(2, 9))
    before = [p.clone() for p in model.parameters()]

    def loss(items):
        return token_loss(model, collate(items)) * math.nan, {}

    objective = dataclasses.replace(objective_of(model, rows), loss=loss)
    optimiser = torch.optim.SGD(model.parameters(), lr=1.0)
    with pytest.raises(NonFiniteError, match="The loss is nan in this step"):
        take_step(objective, rows, optimiser, CheckedSteps(torch.device("cpu")), settings_of())
    assert all(torch.equal(a, b) for a, b in zip(before, model.parameters(), strict=True))


def test_micro_batches_are_sorted_by_length():
    parts_of = list(micro_batches([3, 1, 2, 5, 4], 2, lambda x: x))
    assert parts_of == [[1, 2], [3, 4], [5]]
    assert list(micro_batches([3, 1], None, lambda x: x)) == [[1, 3]]


# ------------------------------------------------------------------------------------------------ holding out


def test_held_out_examples_are_not_trained_on():
    items = list(range(100))
    own, held = hold_out(items, 0.1, seed=3)
    assert len(held) == 10 and sorted(own + held) == items and own == sorted(own)
    assert hold_out(items, 0.1, seed=3) == (own, held)
    assert hold_out(items, 0.1, seed=4)[1] != held
    assert hold_out(items, 0.0, seed=3) == (items, [])
    assert len(hold_out([1, 2], 0.05, seed=0)[1]) == 1
    assert hold_out([1], 0.5, seed=0) == ([1], [])


def test_equal_items_are_never_on_both_sides():
    items = [k % 8 for k in range(24)]
    own, held = hold_out(items, 0.05, seed=0, group=lambda item: 0)
    assert len(held) == 3 and not set(own) & set(held)
    own, held = hold_out([5, 5, 5], 0.3, seed=0)  # nothing else to train on
    assert len(own) == 2 and len(held) == 1


def test_groups_are_held_out_whole_unless_one_is_larger_than_the_share():
    items = [(prompt, i) for prompt in range(40) for i in range(3)]
    own, held = hold_out(items, 0.1, seed=0, group=lambda item: item[0])
    assert not {p for p, _ in own} & {p for p, _ in held}
    assert 12 <= len(held) <= 14 and len(own) + len(held) == len(items)
    for large in (lambda item: 0, lambda item: min(item[0], 27)):
        own, held = hold_out(items, 0.1, seed=0, group=large)
        assert len(held) == 12


# --------------------------------------------------------------------------------------------------- training


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> str:
    return saved(tmp_path_factory.mktemp("models") / "llama", chat=True)


@pytest.mark.parametrize("tune", ["full", "lora"])
@pytest.mark.parametrize("make", MODELS)
def test_it_learns_facts_and_where_they_end(tmp_path, make, tune):
    """Also for a model without PAD (GPT-2): after a fact it emits EOS. The folder loads elsewhere."""
    from transformers import AutoModelForCausalLM, AutoTokenizer

    source, events = saved(tmp_path / "base", make()), []
    settings = settings_of(source, tune=tune, num_epochs=40, held_out=0.0)
    data = [{"prompt": fact[:5], "completion": fact[5:]} for fact in FACTS]
    summary = train_sft(
        settings, data=data, listeners=[lambda event: events.append(event)], run_dir=tmp_path / "run"
    )

    model = AutoModelForCausalLM.from_pretrained(tmp_path / "run" / "model")
    made = AutoTokenizer.from_pretrained(tmp_path / "run" / "model")
    assert model.config.vocab_size == make().config.vocab_size  # no embedding is resized
    for fact in FACTS:
        tokens = torch.tensor([made(fact)["input_ids"]])
        with torch.no_grad():
            probabilities = model(tokens).logits[0].softmax(-1)
        assert probabilities[4, tokens[0, 5]] > 0.9 and probabilities[-1, 3] > 0.9
    losses = [row["sft/loss"] for row in Run.open(tmp_path / "run").read_metrics() if "sft/loss" in row]
    assert len(losses) == 80 and losses[-1] < 0.1 < losses[0] / 10
    assert summary["tokens"] == 3 * len(FACTS)
    assert [type(event) for event in events] == [Message, Started, *[Updated] * 80, Finished]


def test_lora_does_not_change_the_trunk_and_the_merged_model_equals_the_adapted_one(tmp_path, folder):
    model, made = load_causal(folder), load_tokenizer(folder)
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    settings = settings_of(folder, tune="lora", lora_layers=2, lora_rank=4)
    train_sft(settings, data=FACTS, model=(model, made), run_dir=tmp_path / "run")
    assert parts(model).layers[0].self_attn.q_proj.weight is not None  # below the adapted layers: untouched
    plain = lora.merged_state(model, None)
    assert all(torch.equal(plain[name], tensor) for name, tensor in before.items())
    tokens = torch.tensor([made(FACTS[0])["input_ids"]])
    with torch.no_grad(), lora.using(model, "sft"):
        wanted, bare = model(tokens).logits, load_causal(folder)(tokens).logits
        found = load_causal(str(tmp_path / "run" / "model"))(tokens).logits
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)
    assert (found - bare).abs().max() > 0.1
    config = json.loads((tmp_path / "run" / "adapter" / "adapter_config.json").read_text())
    assert (config["r"], config["layers_to_transform"]) == (4, [1, 2])
    assert config["base_model_name_or_path"] == folder


def test_chats_are_learnt_and_their_template_is_kept(tmp_path):
    made = chatml()
    chats = [
        {"messages": [{"role": "user", "content": f[0]}, {"role": "assistant", "content": f[5]}]}
        for f in FACTS
    ]
    settings = settings_of("chat", tune="full", num_epochs=60)
    train_sft(
        settings, data=chats, validation=chats[:2], model=(tiny_llama(), made), run_dir=tmp_path / "run"
    )
    again = load_tokenizer(str(tmp_path / "run" / "model"))
    assert again.chat_template == made.chat_template and again.pad_token == again.eos_token
    asked = again.apply_chat_template(chats[0]["messages"][:1], tokenize=False, add_generation_prompt=True)
    tokens = again(asked, add_special_tokens=False, return_tensors="pt")["input_ids"]
    said = load_causal(str(tmp_path / "run" / "model")).generate(
        tokens, attention_mask=torch.ones_like(tokens), max_new_tokens=4, do_sample=False, pad_token_id=0
    )
    assert again.decode(said[0, tokens.shape[1] :]) == FACTS[0][5] + "<eos>"


def weights(run) -> bytes:
    return (run / "model" / "model.safetensors").read_bytes()


def test_of_several_eos_the_tokenizers_own_closes_a_text():
    """Models of chats end with one token and texts with another; what the tokenizer calls EOS is written."""
    model = tiny_llama()
    model.generation_config.eos_token_id = [1, 2, 3]
    loaded = load_for_training(settings_of("given"), "sft", (model, tokenizer()))
    assert loaded.eos == (3, 1, 2) and loaded.adapter == "sft"


def test_same_seed_same_bits_other_seed_others(tmp_path, folder):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        torch.manual_seed(hash(name) % 1000)  # the global generator has no effect
        train_sft(settings_of(folder, seed=seed, held_out=0.2), data=FACTS, run_dir=tmp_path / name)
    assert weights(tmp_path / "a") == weights(tmp_path / "b") != weights(tmp_path / "c")


def test_the_run_folder_records_what_happened(tmp_path, folder):
    data = tmp_path / "facts.jsonl"
    data.write_text("".join(json.dumps({"text": fact}) + "\n" for fact in FACTS))
    settings = settings_of(folder, data=str(data), held_out=0.25, num_epochs=2, max_examples=7, tune="full")
    summary = train_sft(settings, run_dir=tmp_path / "run")
    run = Run.open(tmp_path / "run")
    assert SFTSettings(**run.settings) == settings
    first, *rows = run.read_metrics()
    assert set(first) == {"step", "seconds", "sft/held_out_loss"} and first["step"] == 0
    assert [row["step"] for row in rows] == [1, 2, 3, 4]  # 5 of 7 examples in minibatches of 4, twice
    assert ["sft/held_out_loss" in row for row in rows] == [False, True, False, True]
    rates = [row["sft/learning_rate"] for row in rows]
    np.testing.assert_allclose(rates, [1e-2, 7.5e-3, 5e-3, 2.5e-3])
    assert rows[-1]["sft/tokens"] == 2 * summary["tokens"] == 2 * 5 * len(FACTS[0])
    assert summary["held_out_rows"] == 2
    assert summary["final"]["sft/held_out_loss"] == rows[-1]["sft/held_out_loss"] < first["sft/held_out_loss"]
    assert json.loads((run.path / "summary.json").read_text())["final"] == summary["final"]


def test_packing_changes_neither_the_loss_nor_what_is_held_out(tmp_path, folder):
    found = []
    for packed in (False, True):
        settings = settings_of(folder, pack=packed, held_out=0.25, minibatch_size=8)
        summary = train_sft(settings, data=FACTS, run_dir=tmp_path / f"run{packed}")
        rows = Run.open(tmp_path / f"run{packed}").read_metrics()
        found.append((rows[0]["sft/held_out_loss"], rows[1]["sft/loss"], summary["tokens"]))
    assert found[0] == pytest.approx(found[1], rel=1e-5)
    assert len(rows) == 2 and summary["rows"] < 6  # fewer rows, the same tokens in one minibatch


@pytest.mark.parametrize("values", [{"gradient_checkpointing": True}, {"micro_batch_size": 1}])
def test_saving_memory_changes_nothing(tmp_path, folder, values):
    losses = []
    for more in ({}, values):
        run_dir = tmp_path / str(len(losses))
        train_sft(settings_of(folder, held_out=0.0, num_epochs=2, **more), data=FACTS, run_dir=run_dir)
        losses.append([row["sft/loss"] for row in Run.open(run_dir).read_metrics()])
    np.testing.assert_allclose(*losses, rtol=1e-4)


def test_dropout_is_off_also_in_a_model_that_is_given(tmp_path):
    model = tiny_gpt2().train()
    settings = settings_of("given", gradient_checkpointing=True, num_epochs=1, held_out=0.0)
    train_sft(settings, data=FACTS, model=(model, tokenizer()), run_dir=tmp_path / "run")
    tokens = torch.arange(4, 20)[None]
    with torch.no_grad():
        assert torch.equal(model.train()(tokens).logits, model(tokens).logits)


@pytest.mark.parametrize("tune", ["full", "lora"])
def test_bfloat16_learns_too(tmp_path, folder, tune):
    settings = settings_of(folder, tune=tune, dtype="bfloat16", num_epochs=20, held_out=0.0)
    train_sft(settings, data=FACTS, run_dir=tmp_path / "run")
    rows = Run.open(tmp_path / "run").read_metrics()
    assert rows[-1]["sft/loss"] < rows[0]["sft/loss"] / 2


def test_threads_are_the_users_again_afterwards(tmp_path, folder):
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        train_sft(settings_of(folder, threads=1), data=FACTS, run_dir=tmp_path / "run")
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("values", "data", "message"),
    [
        ({"max_tokens": 97}, FACTS, r"max_tokens is 97, but .* reads 96 tokens"),
        ({}, None, "There is no data. Give --data FILE"),
        ({}, [{"review": "a"}], r"data\[0\] has the columns: review"),
        ({"tune": "lora", "lora_layers": 9}, FACTS, "lora_layers is 9, but the model has 3"),
        ({"data": "absent.jsonl"}, None, "no file 'absent.jsonl'"),
        ({"device": "nowhere"}, FACTS, "device is 'nowhere', which cannot be used here .* Choose cpu"),
    ],
)
def test_invalid_settings_are_reported_before_anything_is_written(tmp_path, folder, values, data, message):
    with pytest.raises(ValueError, match=message):
        train_sft(settings_of(folder, **values), data=data, run_dir=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_long_rows_are_reported(tmp_path, folder):
    lines = []
    settings = settings_of(folder, max_tokens=5)
    train_sft(settings, data=FACTS, run_dir=tmp_path / "run", listeners=[lambda event: lines.append(event)])
    said = [event.text for event in lines if isinstance(event, Message) and event.level == "warning"]
    cut = "8 of 8 rows have more than max_tokens 5 tokens and were cut"
    assert said == [f"{cut}. Raise max_tokens to keep them whole."]
