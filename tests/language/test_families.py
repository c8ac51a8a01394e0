"""Models that differ from a Llama: scaled or capped logits, attention windows, recurrent layers, routers,
layers whose weight is read, no cache, dropout of every kind.
"""

from pathlib import Path

import pytest
import torch
from language.tiny import VOCABULARY, padded, saved, tokenizer

from tightrope.algorithms.descent import SamplingMismatch
from tightrope.language import RewardSettings, SFTSettings, align, selfcheck, train_reward, train_sft
from tightrope.language.alignment.figures import check_mismatch
from tightrope.language.data.batching import Example, collate, row_of
from tightrope.language.generation.distribution import Sampling, token_statistics
from tightrope.language.generation.sample import (
    LOG_RATIO_LIMIT,
    LOWERED_LIMIT,
    cache_works,
    draw,
    gap_limits,
    sample,
)
from tightrope.language.memory import Job, ledger, reward_model_bytes
from tightrope.language.model import architecture as parts_module
from tightrope.language.model import lora
from tightrope.language.model.architecture import attention_window, parts
from tightrope.language.model.load import HEAD, load_causal
from tightrope.language.model.saving import save_adapter
from tightrope.language.model.trunk import Trunk
from tightrope.language.reward.model import load_reward, write_head
from tightrope.language.supervised.sft import require_packable, token_loss

COMMON = {
    "vocab_size": VOCABULARY, "hidden_size": 32, "num_hidden_layers": 4, "num_attention_heads": 2,
    "max_position_embeddings": 96, "bos_token_id": 2, "eos_token_id": 3, "pad_token_id": 0,
    "initializer_range": 0.3,
}  # fmt: skip
GATED = {**COMMON, "intermediate_size": 48, "num_key_value_heads": 1}
IDS = {key: COMMON[key] for key in ("vocab_size", "bos_token_id", "eos_token_id", "pad_token_id")}
MOE = {"num_local_experts": 4, "num_experts_per_tok": 2}
MAMBA = {"mamba_n_heads": 4, "mamba_d_head": 16, "mamba_n_groups": 1, "mamba_d_state": 8}
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
    "layerdrop": ("OPT", {**COMMON, "ffn_dim": 48, "word_embed_proj_dim": 32, "layerdrop": 0.5}),
    "jitter": ("Mixtral", {**GATED, **MOE, "router_jitter_noise": 0.3}),
    "falcon": ("Falcon", {**COMMON, "num_kv_heads": 1, "new_decoder_architecture": True, "alibi": False,
                          "hidden_dropout": 0.3, "attention_dropout": 0.3}),
    "router": ("Mixtral", {**GATED, **MOE, "output_router_logits": True, "router_aux_loss_coef": 10.0}),
    "phimoe": ("Phimoe", {**GATED, **MOE}),
    "bamba": ("Bamba", {**GATED, **MAMBA, "attn_layer_indices": [1, 3]}),
    "jamba": ("Jamba", {**GATED, "num_experts": 2, "attn_layer_period": 2, "attn_layer_offset": 1,
                        "expert_layer_period": 2, "mamba_dt_rank": 4, "mamba_d_state": 8}),
    "lfm2": ("Lfm2", {**GATED, "layer_types": ["conv", "full_attention"] * 2, "conv_L_cache": 3,
                      "block_auto_adjust_ff_dim": False}),
    "mamba": ("Mamba", {**IDS, "hidden_size": 32, "state_size": 8, "num_hidden_layers": 3}),
    "openai-gpt": ("OpenAIGPT", {**IDS, "n_positions": 96, "n_embd": 32, "n_layer": 3, "n_head": 2,
                                 "initializer_range": 0.3}),
    "rwkv": ("Rwkv", {**IDS, "hidden_size": 32, "num_hidden_layers": 3, "context_length": 96}),
    "codegen": ("CodeGen", {**IDS, "n_positions": 96, "n_ctx": 96, "n_embd": 32, "n_layer": 3, "n_head": 4,
                            "rotary_dim": 4}),
    "projected": ("OPT", {**COMMON, "ffn_dim": 48, "word_embed_proj_dim": 16, "do_layer_norm_before": False}),
    "longcat": ("LongcatFlash", {
        **COMMON, "num_layers": 2, "num_hidden_layers": 4, "ffn_hidden_size": 48, "q_lora_rank": 16,
        "kv_lora_rank": 8, "qk_nope_head_dim": 8, "qk_rope_head_dim": 8, "head_dim": 8, "v_head_dim": 8,
        "moe_topk": 2, "n_routed_experts": 4, "zero_expert_num": 2, "expert_ffn_hidden_size": 16}),
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


@pytest.mark.parametrize("name", ["granite", "cohere", "capped"])
def test_a_factor_behind_the_head_is_in_what_is_sampled_and_trained(name):
    """At any temperature, forward and backward, the same as transformers' own logits; so is a cap."""
    model = made(name)
    if name == "capped":  # logits far beyond the cap of 30
        with torch.no_grad():
            model.lm_head.weight.mul_(20)
        assert model(torch.arange(4, 60)[None]).logits.abs().max() > 29
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


@pytest.mark.parametrize(("name", "factor", "cap"), [("capped", 1.0, 30.0), ("cohere", 0.0625, None)])
def test_factor_and_cap_are_measured_before_weights_are_loaded(name, factor, cap):
    """The weights are on the meta device: only the head's output is replaced by numbers."""
    from transformers import AutoModelForCausalLM

    with torch.device("meta"):
        model = AutoModelForCausalLM.from_config(config_of(name))
    head = parts(model).head
    assert getattr(head, parts_module.FACTOR) == pytest.approx(factor, rel=1e-5)
    assert getattr(head, parts_module.CAP) == (cap and pytest.approx(cap, rel=1e-5))


@pytest.mark.parametrize("place", ["cpu", "meta"])
def test_what_else_is_done_to_logits_is_refused_by_name_without_weights_too(place, monkeypatch):
    from transformers import AutoModelForCausalLM, MistralForCausalLM

    plain = MistralForCausalLM.forward

    def squared(self, *given, **options):
        out = plain(self, *given, **options)
        out.logits = out.logits**3
        return out

    monkeypatch.setattr(MistralForCausalLM, "forward", squared)
    with torch.device(place):
        model = AutoModelForCausalLM.from_config(config_of("mistral")).eval()
    with pytest.raises(ValueError, match="MistralForCausalLM.*does more to the logits"):
        parts(model)


def test_hidden_states_that_are_changed_before_the_head_are_refused():
    model = made("mistral")
    model.lm_head.register_forward_pre_hook(lambda module, inputs: (inputs[0].abs(),))
    with pytest.raises(ValueError, match="before its head"):
        parts(model)


def test_hidden_states_that_are_scaled_before_the_head_are_a_factor():
    """As MiniCPM does."""
    model = made("mistral")
    model.lm_head.register_forward_pre_hook(lambda module, inputs: (inputs[0] / 4,))
    assert getattr(parts(model).head, parts_module.FACTOR) == pytest.approx(0.25)
    with torch.device("meta"):
        model = made("mistral")
    model.lm_head.register_forward_pre_hook(lambda module, inputs: (inputs[0] / 4,))
    assert not hasattr(parts(model).head, parts_module.FACTOR)  # known when weights are loaded


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


@pytest.mark.parametrize("name", ["granite", "opt350", "bloom", "capped", "bamba", "openai-gpt", "phimoe"])
def test_the_doctor_finds_them_healthy(name, tmp_path):
    """Also models without fused attention, or with layers nested one module deeper."""
    folder = saved(tmp_path, made(name))
    assert [finding for finding in selfcheck.check_model(folder) if not finding.good] == []
    assert ledger(config_of(name), Job(batch_size=2, prompt_tokens=4, response_tokens=4)).total > 0


def test_the_doctor_compares_with_the_model_s_own_logits(tmp_path, monkeypatch):
    monkeypatch.setattr(parts_module, "_measured", lambda *arguments: (1.0, None))
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
    limits = gap_limits(dtype, 30, 576)
    assert limits.rounding == limit
    assert check_mismatch(limit, limits, dtype, first=True) is None
    assert f"{limit * 1.5:.3g} nats" in str(check_mismatch(limit * 1.5, limits, dtype, first=True))
    for gap in (limits.stop * 1.01, float("nan")):
        with pytest.raises(SamplingMismatch, match=r"KV cache.*window"):
            check_mismatch(gap, limits, dtype, first=True)
    if dtype == "float32":
        with pytest.raises(SamplingMismatch):
            check_mismatch(limits.stop * 1.01, limits, dtype, first=False)
    else:  # one token of many, late in a run
        assert check_mismatch(limits.stop * 1.01, limits, dtype, first=False) is None
    with pytest.raises(SamplingMismatch):
        check_mismatch(float("nan"), limits, dtype, first=False)


def test_the_limit_grows_with_the_root_of_depth_times_width():
    assert gap_limits("float32", 120, 576).rounding == pytest.approx(2 * LOG_RATIO_LIMIT)
    assert gap_limits("float32", 30, 4 * 576).stop == pytest.approx(20 * LOG_RATIO_LIMIT)
    assert gap_limits("bfloat16", 2, 32) == (LOWERED_LIMIT, 2 * LOWERED_LIMIT)


def test_sampling_from_a_scaled_model_is_not_from_its_head(tmp_path):
    """Uniform numbers that pick by the head's own, 13 times sharper, distribution give other tokens."""
    model = load_causal(saved(tmp_path, made("granite")))
    prompts = torch.randint(4, 60, (3, 4), generator=torch.Generator().manual_seed(0))
    real, uniforms = torch.ones_like(prompts, dtype=torch.bool), torch.full((3, 1), 0.5).double()
    got = sample(model, prompts, real, Sampling(), uniforms, (3,))
    with torch.no_grad():
        logs = model(prompts).logits[:, -1].log_softmax(1)
    torch.testing.assert_close(got.logp, logs.gather(1, got.tokens), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", ["bamba", "jamba", "lfm2", "mamba", "openai-gpt", "gemma3", "bloom"])
def test_rows_that_end_early_and_share_a_prompt_are_sampled_as_they_are_trained(name):
    """States of recurrent and convolutional layers follow their rows; a model without a cache needs none."""
    model = made(name)
    base = parts(model).base
    assert cache_works(base, VOCABULARY) == {"openai-gpt": "", "mamba": "new"}.get(name, "whole")
    prompts = torch.randint(4, 60, (3, 5), generator=torch.Generator().manual_seed(0))
    real = torch.ones_like(prompts, dtype=torch.bool)
    real[0, :2] = False
    uniforms = torch.rand(6, 12, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    got = sample(model, prompts, real, Sampling(), uniforms, tuple(range(4, 14)), samples_per_prompt=2)
    lengths = got.mask.sum(1)
    assert len(set(lengths.tolist())) > 1
    for row in range(6):
        text = torch.cat([prompts[row // 2][real[row // 2]], got.tokens[row, : lengths[row]]])[None]
        with torch.no_grad():
            logs = model(input_ids=text).logits[0, -1 - lengths[row] : -1].log_softmax(1)
        wanted = logs.gather(1, text[0, -lengths[row] :, None])[:, 0]
        torch.testing.assert_close(got.logp[row, : lengths[row]], wanted, rtol=1e-4, atol=1e-4)


def test_a_cache_that_mixes_its_rows_is_not_used(monkeypatch):
    from transformers import DynamicCache

    monkeypatch.setattr(DynamicCache, "reorder_cache", lambda self, rows: None)
    model = made("mistral")
    assert cache_works(parts(model).base, VOCABULARY) == ""


@pytest.mark.parametrize("name", ["phimoe", "jamba", "falcon"])
def test_an_adapter_is_in_every_layer_that_computes_and_the_merged_model_is_the_same(name):
    """Not in a router that returns a tuple; also where a layer's weight is read instead of called."""
    model, other = made(name), made(name)
    lora.add_adapter(model, "policy", 4, 8.0)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in lora.adapter_parameters(model, "policy"):
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.2)
    tokens = torch.arange(4, 20)[None]
    other.load_state_dict(lora.merged_state(model, "policy"))
    with lora.using(model, "policy"):
        found = model(input_ids=tokens).logits
        found.square().sum().backward()
    torch.testing.assert_close(found, other(input_ids=tokens).logits, rtol=1e-4, atol=1e-4)
    missing = [p for p in lora.adapter_parameters(model, "policy") if p.grad is None]
    assert not missing or name in ("phimoe", "jamba")  # experts that got no token
    assert any("dt_proj" in key for key in lora.adapter_state(model, "policy")) is (name == "jamba")


def test_lora_layers_of_a_configuration_that_cannot_be_cut_are_computed_whole():
    assert Trunk(made("bamba"), 2).cut == 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("name", ["bamba", "lfm2", "mamba", "qwen2", "granite", "opt"])
def test_packing_is_decided_exactly_in_every_precision(name, dtype):
    """In bfloat16 a state that leaks from text to text is as small as rounding; its gradient is not."""
    model = made(name).to(dtype)
    if name in ("bamba", "lfm2", "mamba"):
        with pytest.raises(ValueError, match="Leave --pack out"):
            require_packable(model, 16)
    else:
        require_packable(model, 16)


@pytest.mark.parametrize("name", ["layerdrop", "falcon", "jitter"])
def test_nothing_is_dropped_where_activations_are_checkpointed(name, tmp_path):
    """The first loss is that of a run without checkpointing, and so is the held-out one."""
    losses = []
    for checkpointing in (False, True):
        model = load_causal(saved(tmp_path / "model", made(name))).train()
        settings = SFTSettings(
            gradient_checkpointing=checkpointing, tune="full", max_tokens=20, minibatch_size=4, held_out=0.4,
        )  # fmt: skip
        texts = [{"text": text} for text in ("a cat", "the dog", "no", "yes yes")]
        run = tmp_path / f"run-{checkpointing}"
        losses.append(train_sft(settings, data=texts, model=(model, tokenizer()), run_dir=run)["final"])
    assert losses[0]["sft/loss"] == pytest.approx(losses[1]["sft/loss"], rel=1e-5)
    assert losses[0]["sft/held_out_loss"] == pytest.approx(losses[1]["sft/held_out_loss"], rel=1e-4)


def test_a_module_that_draws_random_numbers_is_refused(tmp_path):
    """Of whatever kind."""
    model = load_causal(saved(tmp_path / "model", made("mistral")))
    model.model.layers[1].register_forward_hook(lambda m, i, out: out * (1 + 0.1 * torch.rand(())))
    with pytest.raises(ValueError, match=r"MistralForCausalLM.*random numbers"):
        train_sft(
            SFTSettings(max_tokens=20),
            data=[{"text": "a cat"}] * 4,
            model=(model, tokenizer()),
            run_dir=tmp_path / "r",
        )


def test_the_router_loss_that_a_configuration_asks_for_is_that_of_transformers(tmp_path):
    """Padding is not counted, and micro-batches weigh by their tokens."""
    model, words, texts = made("router"), tokenizer(), ["a cat", "the dog ran"]
    rows = [torch.tensor([[*words(text)["input_ids"], 3]]) for text in texts]
    tokens = torch.zeros(2, max(row.shape[1] for row in rows), dtype=torch.int64)
    mask = torch.zeros_like(tokens)
    for i, row in enumerate(rows):
        tokens[i, : row.shape[1]], mask[i, : row.shape[1]] = row[0], 1
    labels = torch.where(mask.bool(), tokens, -100)
    with torch.no_grad():
        wanted = model(input_ids=tokens, attention_mask=mask, labels=labels)
    settings = SFTSettings(tune="full", max_tokens=20, minibatch_size=2, held_out=0.0)
    run = train_sft(settings, data=[{"text": t} for t in texts], model=(model, words), run_dir=tmp_path / "r")
    assert run["final"]["sft/loss"] == pytest.approx(float(wanted.loss), rel=1e-4)
    assert run["final"]["sft/router_loss"] == pytest.approx(float(wanted.aux_loss), rel=1e-4)
    assert wanted.loss > 10


def test_a_router_loss_that_cannot_be_used_is_told(tmp_path):
    lines: list[str] = []
    settings = SFTSettings(tune="full", max_tokens=20, minibatch_size=2, held_out=0.0, pack=True)
    given = [{"text": "a cat"}, {"text": "a dog"}]
    listen = [lambda event: lines.append(str(event))]
    train_sft(
        settings, data=given, model=(made("router"), tokenizer()), run_dir=tmp_path / "r", listeners=listen
    )
    assert any("output_router_logits" in line and "not used" in line for line in lines)


def test_a_model_that_reads_padding_is_refused_by_align_and_found_by_the_doctor(tmp_path):
    folder = saved(tmp_path / "model", made("rwkv"))
    with pytest.raises(ValueError, match=r"RwkvForCausalLM.*padded on the left"):
        align(model=folder, prompts=["a", "the cat"], reward="length", run_dir=tmp_path / "run")
    assert not (tmp_path / "run").exists()
    bad = [finding.what for finding in selfcheck.check_model(folder) if not finding.good]
    assert "padding on the right and on the left are one" in bad


PAIRS = [{"prompt": "a", "chosen": x, "rejected": y} for x, y in ((" cat", " dogs"), ("x", "yz"))]


def rewarded(model, folder, **options):
    settings = RewardSettings(tune="full", max_tokens=20, minibatch_size=2, held_out=0.0, num_epochs=1)
    train_reward(settings, data=PAIRS, model=(model, tokenizer()), run_dir=folder, **options)
    return load_reward(folder)


@pytest.mark.parametrize("name", ["rwkv", "codegen", "projected"])
def test_reward_models_without_a_padding_id_or_with_a_projection_before_the_head(name, tmp_path):
    """Their scores do not depend on where a text is padded: RWKV reads what comes before it."""
    causal = made(name)
    if name != "projected":
        del causal.config.pad_token_id
    model = rewarded(causal, tmp_path / "run")
    width = 16 if name == "projected" else 32
    assert model.head.in_features == width
    wanted = 4 * (sum(p.numel() for p in model.base.parameters()) + width)
    assert reward_model_bytes(tmp_path / "run") == wanted
    tokens, real, _ = padded()
    alone = torch.cat(
        [model.score(row[here][None], here[here][None]) for row, here in zip(tokens, real, strict=True)]
    )
    torch.testing.assert_close(model.score(tokens, real), alone, rtol=1e-4, atol=1e-5)


def test_a_bare_trunk_with_a_projection_takes_a_head_of_its_own_width(tmp_path, monkeypatch):
    from transformers import AutoModel

    model = AutoModel.from_config(config_of("projected"))
    folder = Path(saved(tmp_path, model))
    write_head(folder / HEAD, torch.ones(1, 16), 0.5)
    assert load_reward(folder).head.in_features == 16
    assert reward_model_bytes(folder) == 4 * (sum(p.numel() for p in model.parameters()) + 16)


@pytest.mark.parametrize("stage", ["reward", "align"])
def test_a_router_loss_that_reward_and_align_leave_out_is_told_once(stage, tmp_path):
    lines: list[str] = []
    listen = [lambda event: lines.append(str(event))]
    if stage == "reward":
        rewarded(made("router"), tmp_path / "run", listeners=listen)
    else:
        align(
            model=saved(tmp_path / "model", made("router")), prompts=["a", "b"], reward="length",
            total_episodes=2, batch_size=2, minibatch_size=2, max_new_tokens=2, lora_rank=2,
            run_dir=tmp_path / "run", listeners=listen,
        )  # fmt: skip
    assert sum("output_router_logits" in line and stage in line for line in lines) == 1


@pytest.mark.parametrize("name", ["jamba", "longcat", "granite"])
@pytest.mark.filterwarnings("ignore::UserWarning", "ignore:.*is_gradient_checkpointing.*:FutureWarning")
def test_where_peft_passes_an_adapter_by_the_card_says_so(name, tmp_path):
    peft = pytest.importorskip("peft")
    model, tokens = made(name), torch.arange(4, 20)[None]
    lora.add_adapter(model, "policy", 4, 8.0)
    generator = torch.Generator().manual_seed(0)
    for parameter in lora.adapter_parameters(model, "policy"):
        parameter.data += 0.3 * torch.randn(parameter.shape, generator=generator)
    said = save_adapter(model, "policy", tmp_path, base_model="somewhere")
    with torch.no_grad(), lora.using(model, "policy"):
        wanted = model(tokens, use_cache=False).logits
        theirs = peft.PeftModel.from_pretrained(made(name), str(tmp_path)).eval()
        same = torch.allclose(theirs(tokens, use_cache=False).logits, wanted, atol=1e-3)
        merged = theirs.merge_and_unload()(tokens, use_cache=False).logits
    torch.testing.assert_close(merged, wanted, rtol=0, atol=1e-3)
    assert same == (said is None) == (name == "granite")
    assert said is None or ("merge_and_unload" in said and said in (tmp_path / "README.md").read_text())
