"""Adapters: they start without effect, do not affect each other, and PEFT reads them."""

import pytest
import torch
from language.tiny import padded, tiny_gpt2, tiny_llama

from tightrope.language.model import lora
from tightrope.language.model.saving import load_adapter, save_adapter
from tightrope.language.model.trunk import Trunk

MODELS = [tiny_llama, tiny_gpt2]


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
