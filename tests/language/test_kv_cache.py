"""The KV cache works under both names in transformers: the one up to 5.23, and the one from 5.24 on."""

import warnings
from types import SimpleNamespace

import pytest
import torch
from language.tiny import tiny_llama
from torch import nn

from tightrope.language.generation.sample import cached_forward


class NewName(nn.Module):
    """Like 5.24 and later: the old name still works and warns, as an argument and in the output."""

    class Output(SimpleNamespace):
        @property
        def past_key_values(self):
            warnings.warn("past_key_values is deprecated", FutureWarning, stacklevel=2)
            return self.cache

    def forward(self, tokens, attention_mask=None, position_ids=None, cache=None, use_cache=None, **other):
        assert not other, f"an argument that this version does not know: {sorted(other)}"
        return self.Output(last_hidden_state=position_ids.float()[..., None], cache=[*(cache or []), tokens])


class OldName(nn.Module):
    """Like 5.23 and earlier."""

    def forward(self, tokens, attention_mask=None, position_ids=None, past_key_values=None, use_cache=None):
        cache = [*(past_key_values or []), tokens]
        return SimpleNamespace(last_hidden_state=position_ids.float()[..., None], past_key_values=cache)


@pytest.mark.parametrize("model", [NewName(), OldName()], ids=["5.24 and later", "up to 5.23"])
def test_the_cache_goes_in_and_comes_out_under_either_name(model):
    tokens, ones = torch.tensor([[5, 6]]), torch.ones(1, 2, dtype=torch.int64)
    first = cached_forward(model, tokens, ones, torch.tensor([[0, 1]]))
    second = cached_forward(model, tokens + 2, ones, torch.tensor([[2, 3]]), first.cache)
    assert [x.tolist() for x in second.cache] == [[[5, 6]], [[7, 8]]]
    assert second.hidden[..., 0].tolist() == [[2.0, 3.0]]


def test_a_step_with_the_cache_is_the_whole_pass_of_the_installed_version(capfd):
    """Without warnings: the test settings make them errors, and transformers logs some to stderr."""
    base, tokens = tiny_llama().model, torch.tensor([[3, 4, 5]])
    places, ones = torch.arange(3)[None], torch.ones(1, 3, dtype=torch.int64)
    with torch.no_grad():
        whole = base(tokens, attention_mask=ones, position_ids=places).last_hidden_state[:, -1]
    first = cached_forward(base, tokens[:, :2], ones[:, :2], places[:, :2])
    last = cached_forward(base, tokens[:, 2:], ones, places[:, 2:], first.cache)
    torch.testing.assert_close(last.hidden[:, -1], whole, rtol=1e-5, atol=1e-6)
    assert capfd.readouterr().err == ""
