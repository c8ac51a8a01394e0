"""Log-probability, entropy and KL of tokens, against plain softmax in float64, chunked or whole."""

import pytest
import torch

from tightrope.language.generation import distribution
from tightrope.language.generation.distribution import Sampling, shape_logits, token_statistics
from tightrope.maths.divergence import categorical_entropy

N, D, V = 11, 6, 17


def numbers(bias: bool, dtype=torch.float64):
    torch.manual_seed(0)
    head = torch.nn.Linear(D, V, bias=bias, dtype=dtype)
    hidden, reference = (torch.randn(N, D, dtype=dtype) for _ in range(2))
    return head, hidden.requires_grad_(), reference, torch.randint(2, V, (N,))


def plainly(head, hidden, reference, tokens, sampling, support):
    """The same with whole matrices and autograd."""
    logits, theirs = (head(x).double() / sampling.temperature for x in (hidden, reference))
    allowed = torch.ones(N, V, dtype=torch.bool)
    allowed[:, list(sampling.forbidden)] = False
    if support is not None:
        allowed = torch.zeros(N, V, dtype=torch.bool).scatter_(1, support, True) & allowed
    logs, other = (x.masked_fill(~allowed, -1e30).log_softmax(1) for x in (logits, theirs))
    p = logs.exp()
    return logs.gather(1, tokens[:, None])[:, 0], -(p * logs).sum(1), (p * (logs - other)).sum(1)


@pytest.mark.parametrize("bias", [False, True])
@pytest.mark.parametrize("chunk", [V, 3 * V, 1 << 20])
@pytest.mark.parametrize(
    "sampling, top",
    [(Sampling(), 0), (Sampling(0.7), 0), (Sampling(1.3, forbidden=(0, 1)), 0), (Sampling(0.9), 5)],
)
def test_values_and_gradients(monkeypatch, bias, chunk, sampling, top):
    monkeypatch.setattr(distribution, "CHUNK", chunk)
    head, hidden, reference, tokens = numbers(bias, torch.float32)
    support = None
    if top:
        support = head(hidden).topk(top, 1).indices.detach()
        tokens = support[torch.arange(N), torch.arange(N) % top]
    weights = torch.randn(3, N)
    found = token_statistics(hidden, head, tokens, sampling, support=support, reference=reference)
    sum((w * x).sum() for w, x in zip(weights, found[:3], strict=True)).backward()
    got = [hidden.grad.clone(), *(p.grad.clone() for p in head.parameters())]
    hidden.grad = None
    head.zero_grad()
    wanted = plainly(head, hidden, reference, tokens, sampling, support)
    sum((w * x).sum() for w, x in zip(weights, wanted, strict=True)).backward()
    for a, b in zip(found[:3], wanted, strict=True):
        torch.testing.assert_close(a.double(), b, rtol=1e-4, atol=1e-5)
    # the reference shares the head: its own gradient there is not needed
    torch.testing.assert_close(got[0], hidden.grad, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("sampling", [Sampling(), Sampling(0.7, forbidden=(0, 1))])
@pytest.mark.parametrize("top", [0, 5])
def test_the_entropy_is_that_of_the_maths(monkeypatch, sampling, top):
    """Value and gradient, chunked, for the same logits that the sampler uses."""
    monkeypatch.setattr(distribution, "CHUNK", 3 * V)
    head, hidden, _, tokens = numbers(True, torch.float32)
    support = None
    if top:
        support = head(hidden)[:, 2:].topk(top, 1).indices + 2
        tokens = support[:, 0]
    found = token_statistics(hidden, head, tokens, sampling, support=support).entropy
    wanted = categorical_entropy(shape_logits(head(hidden), sampling, support))
    torch.testing.assert_close(found, wanted, rtol=1e-5, atol=1e-6)
    weights = torch.randn(N)
    gradients = [torch.autograd.grad((weights * x).sum(), hidden)[0] for x in (found, wanted)]
    torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-6)
    assert float(found.detach().min()) > 0.1


def test_the_head_gets_its_gradient_when_it_is_trained():
    head, hidden, _, tokens = numbers(True, torch.float32)
    token_statistics(hidden, head, tokens, Sampling()).logp.sum().backward()
    got = head.weight.grad.clone(), head.bias.grad.clone()
    head.zero_grad()
    head(hidden).log_softmax(1).gather(1, tokens[:, None]).sum().backward()
    torch.testing.assert_close(got, (head.weight.grad, head.bias.grad), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("top", [0, 5])
def test_a_gradient_computed_ahead_is_the_one_computed_later(monkeypatch, top):
    monkeypatch.setattr(distribution, "CHUNK", 3 * V)
    head, hidden, reference, tokens = numbers(True, torch.float32)
    head.requires_grad_(False)
    sampling, support = Sampling(0.8, forbidden=(0, 1)), None
    if top:
        support = head(hidden)[:, 2:].topk(top, 1).indices + 2
        tokens = support[torch.arange(N), torch.arange(N) % top]
    weights, found = torch.randn(3, N), []
    for ahead in (False, True):
        for used in ((0,), (0, 1, 2)):  # with entropy or KL in the loss it must give way
            out = token_statistics(
                hidden, head, tokens, sampling, support=support, reference=reference, ahead=ahead
            )
            loss = sum((weights[i] * out[i]).sum() for i in used)
            found.append(torch.autograd.grad(loss, hidden)[0])
    torch.testing.assert_close(found[:2], found[2:], rtol=1e-5, atol=1e-6)
    assert not torch.allclose(found[0], found[1])


def test_the_references_log_probability_is_its_own():
    head, hidden, reference, tokens = numbers(True, torch.float32)
    one = token_statistics(hidden, head, tokens, Sampling(0.7), reference=reference)
    other = token_statistics(reference, head, tokens, Sampling(0.7))
    assert torch.equal(one.reference_logp, other.logp) and not one.reference_logp.requires_grad


def test_temperature_divides_in_sampling_and_training_alike():
    logits = torch.tensor([[2.0, 0.0, -2.0]])
    assert torch.equal(shape_logits(logits, Sampling(temperature=2.0)), logits / 2)
    assert torch.equal(logits, torch.tensor([[2.0, 0.0, -2.0]]))  # never in place on what it is given


def test_a_token_outside_its_support_is_refused():
    head, hidden, _, _ = numbers(False, torch.float32)
    support = torch.zeros(N, 1, dtype=torch.int64)
    with pytest.raises(ValueError, match="outside the top-k"):
        token_statistics(hidden, head, torch.ones(N, dtype=torch.int64), Sampling(top_k=1), support=support)
