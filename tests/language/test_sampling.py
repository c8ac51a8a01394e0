"""Sampling: the right distribution, independent rows, padding without effect."""

import pytest
import torch
from language.tiny import saved, tiny_gpt2, tiny_llama

from tightrope.language.data.batching import positions
from tightrope.language.generation.distribution import Sampling, token_statistics
from tightrope.language.generation.sample import draw, sample
from tightrope.language.model.load import load_causal, without_dropout
from tightrope.language.model.trunk import Trunk

MODELS = [tiny_llama, tiny_gpt2]
EOS = (3,)


def prompts(rows=5, columns=6, seed=0):
    generator = torch.Generator().manual_seed(seed)
    tokens = torch.randint(4, 60, (rows, columns), generator=generator)
    real = torch.ones(rows, columns, dtype=torch.bool)
    for row in range(rows):
        real[row, : row % columns] = False
    return tokens, real


def uniforms(rows, columns, seed=0):
    return torch.rand(rows, columns, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_positions_count_only_real_tokens():
    real = torch.tensor([[False, False, True, True, True, False]])
    assert positions(real).tolist() == [[0, 0, 0, 1, 2, 2]]


@pytest.mark.parametrize("make", MODELS)
@pytest.mark.parametrize("samples", [1, 3])
@pytest.mark.parametrize(
    "settings", [Sampling(), Sampling(0.7), Sampling(1.0, top_k=5), Sampling(forbidden=EOS)]
)
def test_log_probabilities_of_sampling_are_those_of_training(make, samples, settings):
    """With a KV cache, finished rows dropped, prompts shared: the same as the plain forward pass."""
    model = make()
    tokens, real = prompts()
    got = sample(model, tokens, real, settings, uniforms(5 * samples, 12), EOS, samples_per_prompt=samples)
    whole = torch.cat([tokens.repeat_interleave(samples, 0), got.tokens], 1)
    seen = torch.cat([real.repeat_interleave(samples, 0), got.mask], 1)
    hidden = Trunk(model).hidden(whole, seen)[:, 5:-1]
    support = None if got.support is None else got.support[got.mask]
    with torch.no_grad():
        logp = token_statistics(
            hidden[got.mask], model.get_output_embeddings(), got.tokens[got.mask], settings, support=support
        ).logp
    assert (logp - got.logp[got.mask]).abs().max() < 1e-4
    assert got.ended.any() != (settings.forbidden == EOS) or got.mask.all()


@pytest.mark.parametrize("make", MODELS)
def test_the_filler_and_the_amount_of_padding_change_nothing(make):
    model = make()
    tokens, real = prompts()
    first = sample(model, tokens, real, Sampling(), uniforms(5, 8), EOS)
    poisoned = torch.where(real, tokens, 41)
    wide = torch.cat([torch.full((5, 4), 17), poisoned], 1)
    seen = torch.cat([torch.zeros(5, 4, dtype=torch.bool), real], 1)
    second = sample(model, wide, seen, Sampling(), uniforms(5, 8), EOS)
    assert torch.equal(first.tokens, second.tokens) and torch.equal(first.mask, second.mask)
    torch.testing.assert_close(first.logp, second.logp, rtol=1e-4, atol=1e-5)


def test_top_k_beyond_the_vocabulary_leaves_every_token():
    model, (tokens, real) = tiny_llama(), prompts()
    size = model.config.vocab_size
    few, many = (sample(model, tokens, real, Sampling(top_k=k), uniforms(5, 8), EOS) for k in (size, 500))
    assert many.support.shape == (5, 8, size) and torch.equal(few.support, many.support)
    assert torch.equal(few.tokens, many.tokens) and torch.equal(few.logp, many.logp)


def test_a_row_does_not_depend_on_its_neighbours():
    model = tiny_llama()
    tokens, real = prompts()
    numbers = uniforms(5, 12)
    together = sample(model, tokens, real, Sampling(), numbers, EOS)
    for row in range(5):
        own = slice(row, row + 1)
        alone = sample(model, tokens[own], real[own], Sampling(), numbers[own], EOS)
        assert torch.equal(alone.tokens[alone.mask], together.tokens[row][together.mask[row]])


def test_a_response_ends_with_its_eos_and_nothing_behind_it_counts():
    model = tiny_llama()
    tokens, real = prompts(rows=40)
    got = sample(model, tokens, real, Sampling(), uniforms(40, 30, seed=1), EOS)
    assert got.ended.any() and not got.ended.all()
    for row in range(40):
        kept = got.tokens[row][got.mask[row]].tolist()
        assert (3 in kept) == bool(got.ended[row]) and kept.count(3) == int(got.ended[row])
        if got.ended[row]:
            assert kept[-1] == 3
        else:
            assert len(kept) == 30


def test_an_eos_in_the_last_place_that_there_is_ends_the_response():
    """The longest response of a batch does not count as cut."""
    model = tiny_llama()
    tokens, real = prompts(rows=40)
    numbers = uniforms(40, 30, seed=1)
    whole = sample(model, tokens, real, Sampling(), numbers, EOS)
    row = int(whole.ended.nonzero()[0])
    own, length = slice(row, row + 1), int(whole.mask[row].sum())
    for room, ended in ((length, True), (length - 1, False)):
        got = sample(model, tokens[own], real[own], Sampling(), numbers[own, :room], EOS)
        assert got.ended.tolist() == [ended] and got.mask.all()


def test_frequencies_are_the_probabilities():
    """Inverse transform of evenly spaced uniforms: each token in proportion to its probability, to one
    draw.
    """
    torch.manual_seed(0)
    head, hidden = torch.nn.Linear(4, 9), torch.randn(1, 4)
    count = 10_000
    even = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    for settings in (Sampling(), Sampling(0.5), Sampling(forbidden=(0, 8)), Sampling(top_k=3)):
        with torch.no_grad():
            chosen, logp, support = draw(hidden.expand(count, 4), head, settings, even)
            logits = head(hidden)[0] / settings.temperature
        logits[list(settings.forbidden)] = -torch.inf
        if settings.top_k:
            logits[logits < logits.topk(settings.top_k).values[-1]] = -torch.inf
        p = logits.softmax(0)
        counts = torch.bincount(chosen, minlength=9).double() / count
        assert (counts - p).abs().max() < 2 / count
        torch.testing.assert_close(logp, p[chosen].log(), rtol=1e-4, atol=1e-5)
        assert (support is None) == (settings.top_k == 0)
    ends = torch.tensor([0.0, 1 - 1e-16])
    with torch.no_grad():
        chosen, _, _ = draw(hidden.expand(2, 4), head, Sampling(forbidden=(0, 8)), ends)
    assert chosen.tolist() == [1, 7]


@pytest.mark.parametrize("make", MODELS)
def test_a_model_is_loaded_without_dropout(make, tmp_path):
    """Even after a later train(): GPT-2 has dropout 0.1 in its config, and Llama gets some."""
    model = make()
    model.config.attention_dropout = 0.5
    base = load_causal(saved(tmp_path, model)).train()
    tokens, real = prompts()
    trunk = Trunk(base)
    assert torch.equal(trunk.hidden(tokens, real), trunk.hidden(tokens, real))


def test_dropout_is_off_everywhere():
    model = tiny_gpt2().train()
    without_dropout(model)
    tokens, real = prompts()
    trunk = Trunk(model)
    assert torch.equal(trunk.hidden(tokens, real), trunk.hidden(tokens, real))
