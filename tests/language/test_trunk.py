"""A trunk in two halves equals the whole trunk, and padding has no effect."""

import pytest
import torch
from language.tiny import padded, tiny_gpt2, tiny_llama

from tightrope.language.model import lora
from tightrope.language.model.trunk import Trunk

MODELS = [tiny_llama, tiny_gpt2]


@pytest.mark.parametrize("make", MODELS)
@pytest.mark.parametrize("cut", [1, 2])
def test_the_halves_agree_with_the_whole_and_pass_gradients(make, cut):
    tokens, real, _ = padded()
    layers = tuple(range(cut, 3))
    model = make()
    lora.add_adapter(model, "policy", 4, 8.0, layers)
    for parameter in lora.adapter_parameters(model, "policy"):
        parameter.data += 0.05
    trunk = Trunk(model, cut)
    assert trunk.cut == cut
    gradients = []
    for lower in (None, trunk.lower(tokens, real)):
        model.zero_grad()
        with lora.using(model, "policy"):
            hidden = trunk.hidden(tokens, real, lower)
        hidden[real].square().sum().backward()
        gradients.append([p.grad.clone() for p in lora.adapter_parameters(model, "policy")])
    for whole, half in zip(*gradients, strict=True):
        torch.testing.assert_close(whole, half, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("make", MODELS)
def test_a_cut_that_does_not_agree_is_not_made(make, monkeypatch):
    """An architecture that scales the input of its layers would be wrong in halves: it stays whole."""
    model = make()
    base = model.base_model
    forward = type(base).forward

    def scaled(self, input_ids=None, inputs_embeds=None, **more):
        if inputs_embeds is not None:
            inputs_embeds = 2 * inputs_embeds
        return forward(self, input_ids=input_ids, inputs_embeds=inputs_embeds, **more)

    monkeypatch.setattr(type(base), "forward", scaled)
    assert Trunk(model, 1).cut == 0


@pytest.mark.parametrize("make", MODELS)
def test_padding_side_amount_and_filler_change_nothing(make):
    tokens, real, _ = padded()
    trunk = Trunk(make())
    wanted = trunk.hidden(tokens, real)[real]
    poisoned = torch.where(real, tokens, 5)
    torch.testing.assert_close(trunk.hidden(poisoned, real)[real], wanted, rtol=1e-5, atol=1e-5)
    both = [torch.nn.functional.pad(x, (3, 2)) for x in (poisoned, real)]
    torch.testing.assert_close(trunk.hidden(*both)[both[1]], wanted, rtol=1e-5, atol=1e-5)


def test_gradient_checkpointing_changes_no_gradient():
    tokens, real, _ = padded()
    found = []
    for checkpointing in (False, True):
        model = tiny_llama()
        lora.add_adapter(model, "policy", 4, 8.0)
        trunk = Trunk(model, checkpointing=checkpointing)
        with lora.using(model, "policy"):
            trunk.hidden(tokens, real)[real].square().sum().backward()
        found.append([p.grad for p in lora.adapter_parameters(model, "policy")])
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-7)
