"""Adapters: they start without effect, do not affect each other, and PEFT reads them."""

import pytest
import torch
from language.tiny import padded, tiny_gpt2, tiny_llama, tiny_of

from tightrope.language.model import lora, saving
from tightrope.language.model.saving import load_adapter, save_adapter
from tightrope.language.model.trunk import Trunk

MODELS = [tiny_llama, tiny_gpt2]
EXPERTS = {
    "n_routed_experts": 4, "num_experts_per_tok": 2, "moe_intermediate_size": 16, "n_shared_experts": 1,
    "first_k_dense_replace": 1, "n_group": 1, "topk_group": 1,
}  # fmt: skip
LATENT = {
    **EXPERTS, "kv_lora_rank": 8, "q_lora_rank": 8, "qk_nope_head_dim": 8, "qk_rope_head_dim": 8,
    "v_head_dim": 8,
}  # fmt: skip
LINEAR = {
    "linear_num_key_heads": 2, "linear_num_value_heads": 4, "linear_key_head_dim": 8,
    "linear_value_head_dim": 8,
}  # fmt: skip
STATE = {"mamba_d_state": 8, "mamba_d_head": 16, "mamba_n_heads": 2, "mamba_n_groups": 1, "mamba_d_ssm": 32}
# Shared experts and dense layers beside fused experts; names that other modules have too (Zamba2: "0").
HARD = {
    "deepseek2": ("DeepseekV2", {**LATENT, "topk_method": "greedy"}),
    "deepseek3": ("DeepseekV3", LATENT),
    "glm4moe": ("Glm4Moe", {**EXPERTS, "head_dim": 8}),
    "qwen3next": (
        "Qwen3Next", {**EXPERTS, **LINEAR, "num_experts": 4, "head_dim": 8, "num_hidden_layers": 4,
                      "shared_expert_intermediate_size": 16},
    ),
    "mixtral": ("Mixtral", {"num_local_experts": 4}),
    "zamba2": (
        "Zamba2", {"num_mem_blocks": 1, "mamba_headdim": 16, "n_mamba_heads": 2, "mamba_d_state": 8,
                   "mamba_ngroups": 1, "chunk_size": 8, "use_shared_mlp_adapter": True, "adapter_rank": 4,
                   "layers_block_type": ["mamba", "hybrid", "mamba"]},
    ),
}  # fmt: skip


def adapted(make, *names, layers=None):
    model = make()
    for seed, name in enumerate(names):
        lora.add_adapter(model, name, 4, 8.0, layers, seed)
    return model


def shake(model, name, seed=0):
    """Adapter weights with an effect: B is no longer 0."""
    generator = torch.Generator().manual_seed(seed)
    for parameter in lora.adapter_parameters(model, name):
        parameter.data += 0.1 * torch.randn(parameter.shape, generator=generator)


@pytest.mark.parametrize("make", MODELS)
def test_a_new_adapter_changes_nothing_and_a_shaken_one_does(make):
    tokens, real, _ = padded()
    bare = Trunk(make()).hidden(tokens, real)
    model = adapted(make, "policy")
    with lora.using(model, "policy"):
        assert torch.equal(Trunk(model).hidden(tokens, real)[real], bare[real])
        shake(model, "policy")
        assert (Trunk(model).hidden(tokens, real) - bare)[real].abs().max() > 0.01
    assert torch.equal(Trunk(model).hidden(tokens, real)[real], bare[real])  # off again: the reference


@pytest.mark.parametrize("make", MODELS)
def test_every_role_gets_the_same_gradient_as_on_its_own(make):
    """Three roles in one graph with switches and one backward pass: no gradient is lost or mixed."""
    tokens, real, _ = padded()
    names = ("policy", "critic", "reward")

    def loss(model, name):
        with lora.using(model, name):
            return Trunk(model).hidden(tokens, real)[real].square().mean()

    together = adapted(make, *names)
    for name in names:
        shake(together, name, seed=len(name))
    total = sum(loss(together, name) for name in names)
    with torch.no_grad():
        loss(together, None)  # the reference in between
    total.backward()
    for seed, name in enumerate(names):
        alone = make()
        lora.add_adapter(alone, name, 4, 8.0, None, seed)
        shake(alone, name, seed=len(name))
        loss(alone, name).backward()
        pairs = zip(
            lora.adapter_parameters(together, name), lora.adapter_parameters(alone, name), strict=True
        )
        for ours, theirs in pairs:
            assert ours.grad is not None and theirs.grad.abs().max() > 0
            torch.testing.assert_close(ours.grad, theirs.grad, rtol=1e-5, atol=1e-7)
    trunk = [p for n, p in together.named_parameters() if ".down." not in n and ".up." not in n]
    assert all(p.grad is None and not p.requires_grad for p in trunk)


def test_switching_touches_no_requires_grad():
    model = adapted(tiny_llama, "policy", "critic")
    before = {name: p.requires_grad for name, p in model.named_parameters()}
    for name in ("policy", None, "critic"):
        with lora.using(model, name):
            assert {n: p.requires_grad for n, p in model.named_parameters()} == before


@pytest.mark.parametrize("make", MODELS)
def test_the_merged_model_computes_what_the_adapter_does(make):
    tokens, real, _ = padded()
    model = adapted(make, "policy", layers=(1, 2))
    shake(model, "policy")
    with lora.using(model, "policy"):
        wanted = Trunk(model).hidden(tokens, real)
    plain = make()
    plain.load_state_dict(lora.merged_state(model, "policy"), strict=True)
    torch.testing.assert_close(Trunk(plain).hidden(tokens, real)[real], wanted[real], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("make", MODELS)
@pytest.mark.filterwarnings("ignore::UserWarning", "ignore:.*is_gradient_checkpointing.*:FutureWarning")
def test_peft_opens_a_saved_adapter(make, tmp_path):
    peft = pytest.importorskip("peft")
    tokens, real, _ = padded()
    model = adapted(make, "policy", layers=(1, 2))
    shake(model, "policy")
    save_adapter(model, "policy", tmp_path, base_model="somewhere")
    with lora.using(model, "policy"):
        wanted = model(input_ids=tokens, attention_mask=real.long()).logits
    theirs = peft.PeftModel.from_pretrained(make(), str(tmp_path))
    got = theirs(input_ids=tokens, attention_mask=real.long()).logits
    torch.testing.assert_close(got[real], wanted[real], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", HARD)
@pytest.mark.filterwarnings("ignore::UserWarning", "ignore:.*is_gradient_checkpointing.*:FutureWarning")
def test_peft_gives_what_was_trained_on_families_whose_targets_it_rewrites(name, tmp_path):
    """huggingface/peft #3711: it gave shared experts and dense layers of these no adapter."""
    peft = pytest.importorskip("peft")
    kind, values = HARD[name]
    tokens = padded()[0]
    model = tiny_of(kind, **values)
    lora.add_adapter(model, "policy", 4, 8.0, (1, 2), 0)
    with torch.no_grad():
        bare = model(input_ids=tokens, use_cache=False).logits
        shake(model, "policy")
        assert save_adapter(model, "policy", tmp_path, base_model="somewhere") is None
        with lora.using(model, "policy"):
            wanted = model(input_ids=tokens, use_cache=False).logits
        theirs = peft.PeftModel.from_pretrained(tiny_of(kind, **values), str(tmp_path)).eval()
        got = theirs(input_ids=tokens, use_cache=False).logits
        merged = theirs.merge_and_unload()(input_ids=tokens, use_cache=False).logits
    assert (wanted - bare).abs().max() > 0.01
    torch.testing.assert_close(got, wanted, rtol=0, atol=1e-4)
    torch.testing.assert_close(merged, wanted, rtol=0, atol=1e-4)
    assert "every weight has its place" in (tmp_path / "README.md").read_text()
    other = tiny_of(kind, **values)
    load_adapter(other, "reward", tmp_path)
    with torch.no_grad(), lora.using(other, "reward"):
        torch.testing.assert_close(other(input_ids=tokens, use_cache=False).logits, wanted)


@pytest.mark.parametrize("installed", [True, False])
def test_where_peft_refuses_an_adapter_the_card_says_so(installed, tmp_path, monkeypatch):
    if not installed:
        monkeypatch.setattr(saving.importlib.util, "find_spec", lambda name: None)
    model = tiny_of("FalconH1", **STATE)
    lora.add_adapter(model, "policy", 4, 8.0)
    said = save_adapter(model, "policy", tmp_path, base_model="somewhere")
    assert said and "no out_proj in models of type falcon_h1" in said
    card = (tmp_path / "README.md").read_text()
    assert said in card and "PeftModel" not in card


def test_weights_that_peft_would_leave_out_are_found_before_anything_is_promised(tmp_path, monkeypatch):
    pytest.importorskip("peft")
    monkeypatch.setattr(saving, "EXPERT_NAMES", ())
    kind, values = HARD["deepseek3"]
    model = tiny_of(kind, **values)
    lora.add_adapter(model, "policy", 4, 8.0)
    said = save_adapter(model, "policy", tmp_path, base_model="somewhere")
    assert said and "weights are only here or only there, such as base_model.model.model.layers.0.mlp" in said


def test_what_was_not_tried_is_not_called_tried(tmp_path, monkeypatch):
    monkeypatch.setattr(saving.importlib.util, "find_spec", lambda name: None)
    model = adapted(tiny_llama, "policy")
    assert save_adapter(model, "policy", tmp_path, base_model="somewhere") is None
    card = (tmp_path / "README.md").read_text()
    assert "was not tried" in card and "every weight has its place" not in card


def test_an_adapter_comes_back_from_its_folder(tmp_path):
    model = adapted(tiny_llama, "policy", layers=(2,))
    shake(model, "policy")
    save_adapter(model, "policy", tmp_path, base_model="somewhere")
    other = tiny_llama()
    load_adapter(other, "reward", tmp_path)
    for a, b in zip(
        lora.adapter_parameters(model, "policy"), lora.adapter_parameters(other, "reward"), strict=True
    ):
        assert torch.equal(a, b)
    with pytest.raises(ValueError, match="does not fit"):
        load_adapter(tiny_gpt2(), "reward", tmp_path)


def test_user_mistakes_are_named():
    model = adapted(tiny_llama, "policy")
    with pytest.raises(ValueError, match="already has an adapter"):
        lora.add_adapter(model, "policy", 4, 8.0)
    with pytest.raises(ValueError, match="has 3 layers"):
        lora.top_layers(model, 4)
    with pytest.raises(ValueError, match="none at all"), lora.using(tiny_llama(), "policy"):
        pass
