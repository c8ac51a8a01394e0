"""Models that differ from a Llama: scaled or capped logits, attention windows, more deeply nested layers."""

from pathlib import Path

import pytest
import torch
from language.tiny import VOCABULARY, padded, saved

from tightrope.algorithms.descent import SamplingMismatch
from tightrope.language import selfcheck
from tightrope.language.alignment.figures import refuse_mismatch
from tightrope.language.data.batching import Example, collate, row_of
from tightrope.language.generation.distribution import Sampling, token_statistics
from tightrope.language.generation.sample import LOG_RATIO_LIMIT, LOWERED_LIMIT, draw, sample
from tightrope.language.memory import Job, ledger, reward_model_bytes
from tightrope.language.model import architecture as parts_module
from tightrope.language.model.architecture import attention_window, parts
from tightrope.language.model.load import load_causal
from tightrope.language.model.trunk import Trunk
from tightrope.language.reward.model import load_reward
from tightrope.language.supervised.sft import require_packable, token_loss

COMMON = {
    "vocab_size": VOCABULARY, "hidden_size": 32, "num_hidden_layers": 4, "num_attention_heads": 2,
    "max_position_embeddings": 96, "bos_token_id": 2, "eos_token_id": 3, "pad_token_id": 0,
    "initializer_range": 0.3,
}  # fmt: skip
GATED = {**COMMON, "intermediate_size": 48, "num_key_value_heads": 1}
GEMMA = {**GATED, "head_dim": 16, "sliding_window": 8}
FAMILIES = {
    "granite": ("Granite", {**GATED, "logits_scaling": 13.0}),
    "cohere": ("Cohere", {**GATED, "logit_scale": 0.0625}),
    "capped": ("Gemma2", {**GEMMA, "final_logit_softcapping": 30.0}),
    "gemma2": ("Gemma2", {**GEMMA, "final_logit_softcapping": None}),
    "gemma3": ("Gemma3Text", {**GEMMA, "layer_types": ["sliding_attention", "full_attention"] * 2}),
    "qwen2": ("Qwen2", {**GATED, "use_sliding_window": True, "sliding_window": 16, "max_window_layers": 2}),
    "mistral": ("Mistral", {**GATED, "sliding_window": 4}),
    "opt": ("OPT", {**COMMON, "ffn_dim": 48, "word_embed_proj_dim": 32}),
    "opt350": ("OPT", {**COMMON, "ffn_dim": 48, "word_embed_proj_dim": 16}),
    "bloom": (
        "Bloom", {"hidden_size": 32, "n_layer": 3, "n_head": 2, "initializer_range": 0.3,
                  **{k: COMMON[k] for k in ("vocab_size", "bos_token_id", "eos_token_id", "pad_token_id")}},
    ),
}  # fmt: skip


def config_of(name):
    import transformers

    kind, values = FAMILIES[name]
    return getattr(transformers, f"{kind}Config")(**values)


def made(name):
    from transformers import AutoModelForCausalLM

    torch.manual_seed(0)
    return AutoModelForCausalLM.from_config(config_of(name)).eval()


@pytest.mark.parametrize("name", ["granite", "cohere"])
def test_a_factor_behind_the_head_is_in_what_is_sampled_and_trained(name):
    """At any temperature, forward and backward, the same as transformers' own logits."""
    model = made(name)
    tokens, real, sampling = torch.randint(4, 60, (2, 12)), torch.ones(2, 12, dtype=torch.bool), Sampling(0.7)
    wanted = (model(tokens).logits[:, :-1].double() / 0.7).log_softmax(2)
    wanted = wanted.gather(2, tokens[:, 1:, None]).flatten()
    head, gradients = parts(model).head, []
    hidden = Trunk(model).hidden(tokens, real)[:, :-1].flatten(0, 1)
    ours = token_statistics(hidden, head, tokens[:, 1:].flatten(), sampling).logp
    assert (ours - wanted).abs().max() < 1e-5
    for logp in (ours, wanted):
        model.zero_grad()
        logp.sum().backward(retain_graph=True)
        gradients.append(head.weight.grad.clone())
    torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-4)
    chosen, logp, _ = draw(hidden, head, sampling, torch.rand(len(hidden)))
    logits = (model(tokens).logits[:, :-1] / 0.7).flatten(0, 1).log_softmax(1)
    assert (logp - logits.gather(1, chosen[:, None])[:, 0]).abs().max() < 1e-5


def test_the_factor_is_exact_and_a_plain_head_has_none():
    assert getattr(parts(made("cohere")).head, parts_module.FACTOR) == 0.0625
    assert getattr(parts(made("granite")).head, parts_module.FACTOR) == pytest.approx(1 / 13, rel=1e-6)
    assert getattr(parts(made("mistral")).head, parts_module.FACTOR) == 1.0


@pytest.mark.parametrize(
    ("name", "words"), [("capped", r"gemma2.*soft-capped.*not\s+supported"), ("opt350", "head that reads 16")]
)
def test_what_is_no_factor_times_the_head_is_refused_by_name(name, words, tmp_path):
    """A cap of 30 barely changes the logits of this model, but is still detected."""
    with pytest.raises(ValueError, match=words):
        parts(made(name))
    with pytest.raises(ValueError, match=words):
        load_causal(saved(tmp_path, made(name)))


def test_hidden_states_that_are_changed_before_the_head_are_refused():
    model = made("mistral")
    model.lm_head.register_forward_pre_hook(lambda module, inputs: (inputs[0] / 2,))
    with pytest.raises(ValueError, match="before its head"):
        parts(model)


@pytest.mark.parametrize("name", ["qwen2", "gemma3"])
@pytest.mark.parametrize("cut", [1, 2, 3])
def test_halves_keep_each_layer_s_window(name, cut):
    """Rows are longer than the window, and the trunk's self-check is shorter."""
    model = made(name)
    tokens, real, _ = padded(rows=3, prompt=20, response=20)
    trunk = Trunk(model, cut)
    assert trunk.cut == cut and model.config.sliding_window == FAMILIES[name][1]["sliding_window"]
    with torch.no_grad():
        whole, half = (trunk.hidden(tokens, real, x) for x in (None, trunk.lower(tokens, real)))
    torch.testing.assert_close(half[real], whole[real], rtol=1e-5, atol=1e-5)


def test_halves_that_mix_up_windows_are_not_used(monkeypatch):
    """A trunk's self-check detects a wrong window, however wide the real one is."""
    from tightrope.language.model import trunk

    real = trunk._halves

    def careless(base, layers, cut):
        lower, upper = real(base, layers, cut)
        upper.config.layer_types = base.config.layer_types
        return lower, upper

    monkeypatch.setattr(trunk, "_halves", careless)
    assert Trunk(made("qwen2"), 2).cut == 0


@pytest.mark.parametrize("name", ["qwen2", "gemma3", "mistral"])
def test_packing_is_refused_where_a_window_is_shorter_than_a_row(name):
    model = made(name)
    window = attention_window(model)
    assert window == FAMILIES[name][1]["sliding_window"]
    with pytest.raises(ValueError, match=f"look back over {window} tokens"):
        require_packable(model, window + 1)


def test_packing_within_the_window_gives_the_loss_of_texts_apart():
    model = made("qwen2")
    require_packable(model, 16)
    texts = [Example(tuple(range(4, 4 + n)), (False, *(True,) * (n - 1))) for n in (9, 7)]
    with torch.no_grad():
        apart = token_loss(model, collate([row_of([text]) for text in texts]))
        torch.testing.assert_close(token_loss(model, row_of(texts)), apart, rtol=1e-5, atol=1e-5)


def test_packing_is_refused_where_masks_are_read_in_another_way():
    with pytest.raises(ValueError, match="Leave --pack out"):
        require_packable(made("bloom"), 16)


@pytest.mark.parametrize("name", ["granite", "opt", "bloom", "gemma2"])
def test_the_doctor_finds_them_healthy(name, tmp_path):
    """Also models without fused attention, or with layers nested one module deeper."""
    folder = saved(tmp_path, made(name))
    assert [finding for finding in selfcheck.check_model(folder) if not finding.good] == []
    assert ledger(config_of(name), Job(batch_size=2, prompt_tokens=4, response_tokens=4)).total > 0


def test_the_doctor_compares_with_the_model_s_own_logits(tmp_path, monkeypatch):
    monkeypatch.setattr(parts_module, "_factor", lambda *arguments: 1.0)
    found = selfcheck.check_model(saved(tmp_path, made("granite")))
    assert "log-probabilities are those of model(tokens).logits" in [f.what for f in found if not f.good]


def test_a_trunk_whose_layers_are_no_children_stays_in_one_piece():
    assert Trunk(made("opt"), 2).cut == 0


def test_a_reward_model_without_fused_attention_loads(tmp_path):
    from transformers import AutoModelForSequenceClassification

    config = config_of("bloom")
    config.num_labels = 1
    model = AutoModelForSequenceClassification.from_config(config)
    folder, tokens = saved(tmp_path, model), torch.randint(4, 60, (2, 5))
    got = load_reward(folder).score(tokens, torch.ones(2, 5, dtype=torch.bool))
    assert got.shape == (2,) and got.isfinite().all()
    assert reward_model_bytes(Path(folder)) == 4 * sum(p.numel() for p in model.parameters())


@pytest.mark.parametrize(("dtype", "limit"), [("float32", LOG_RATIO_LIMIT), ("bfloat16", LOWERED_LIMIT)])
def test_sampling_and_training_may_differ_only_by_rounding_in_every_precision(dtype, limit):
    refuse_mismatch(limit, limit, dtype, first=True)
    for gap in (limit * 1.01, float("nan")):
        with pytest.raises(SamplingMismatch, match=r"KV cache.*window"):
            refuse_mismatch(gap, limit, dtype, first=True)
    if dtype == "float32":
        with pytest.raises(SamplingMismatch):
            refuse_mismatch(limit * 1.01, limit, dtype, first=False)
    else:
        refuse_mismatch(limit * 1.01, limit, dtype, first=False)  # one token of many, late in a run
    with pytest.raises(SamplingMismatch):
        refuse_mismatch(float("nan"), limit, dtype, first=False)


def test_sampling_from_a_scaled_model_is_not_from_its_head(tmp_path):
    """Uniform numbers that pick by the head's own, 13 times sharper, distribution give other tokens."""
    model = load_causal(saved(tmp_path, made("granite")))
    prompts = torch.randint(4, 60, (3, 4), generator=torch.Generator().manual_seed(0))
    real, uniforms = torch.ones_like(prompts, dtype=torch.bool), torch.full((3, 1), 0.5).double()
    got = sample(model, prompts, real, Sampling(), uniforms, (3,))
    with torch.no_grad():
        logs = model(prompts).logits[:, -1].log_softmax(1)
    torch.testing.assert_close(got.logp, logs.gather(1, got.tokens), rtol=1e-4, atol=1e-5)
