"""Properties of entropies and divergences: functions of (maths, case), see properties.py."""

from types import ModuleType

import torch
from maths_cases import Case, close, same, with_gradients
from torch import Tensor
from torch.distributions import Bernoulli, Categorical, Normal, kl_divergence

IMPOSSIBLE = -torch.inf


def parameters(c: Case, count: int, width: int = 5) -> list[Tensor]:
    """`count` random arrays [B, T, width]."""
    generator = c.generator
    shape = (*c.rewards.shape, width)
    return [torch.randn(shape, generator=generator, dtype=torch.float64) for _ in range(count)]


def the_estimators_are_the_kl_on_average(maths: ModuleType, c: Case) -> None:
    """Summed over every action the old policy may take: E_old[k1] = E_old[k3] = KL(old || new)."""
    old, new = (logits.log_softmax(-1) for logits in parameters(c, 2))
    exact = (old.exp() * (old - new)).sum(-1)
    for estimator in (maths.divergence.k1, maths.divergence.k3):
        close((old.exp() * estimator(new - old)).sum(-1), exact)


def the_gradient_of_k3_is_that_of_the_kl(maths: ModuleType, c: Case) -> None:
    """As in training: through the KL-penalised surrogate, with advantages 0."""
    old, new = parameters(c, 2)
    probabilities = old.softmax(-1)

    def penalty(logits: Tensor) -> Tensor:
        log_ratio = logits.log_softmax(-1) - old.log_softmax(-1)
        nothing = torch.zeros_like(log_ratio)
        loss = maths.surrogate.kl_penalised_surrogate(log_ratio, nothing, 1.0)
        return (probabilities * loss).sum(-1)

    def exact(logits: Tensor) -> Tensor:
        return kl_divergence(Categorical(logits=old), Categorical(logits=logits))

    for estimated, true in zip(with_gradients(penalty, new), with_gradients(exact, new), strict=True):
        close(estimated, true)


def k2_and_k3_are_never_negative(maths: ModuleType, c: Case) -> None:
    assert (maths.divergence.k2(c.log_ratio) >= 0).all()
    assert (maths.divergence.k3(c.log_ratio) >= 0).all()
    close(maths.divergence.k2(c.log_ratio), c.log_ratio * c.log_ratio / 2)
    tiny = 1e-4 * c.log_ratio  # all three agree to the second order around r = 1
    close(maths.divergence.k3(tiny), maths.divergence.k2(tiny), rtol=1e-3)


def entropies_agree_with_torch(maths: ModuleType, c: Case) -> None:
    logits, log_std = parameters(c, 2)
    close(maths.divergence.categorical_entropy(logits), Categorical(logits=logits).entropy())
    bits = Bernoulli(logits=logits, validate_args=False)
    close(maths.divergence.bernoulli_entropy(logits), bits.entropy().sum(-1))
    gaussian = Normal(torch.zeros_like(log_std), log_std.exp())
    close(maths.divergence.gaussian_entropy(log_std), gaussian.entropy().sum(-1))


def masked_choices_do_not_exist(maths: ModuleType, c: Case) -> None:
    """A logit of -inf is equivalent to removing the choice, and its own gradient is 0."""
    (p,) = parameters(c, 1)
    free = torch.tensor([True, False, True, True, False])
    hidden = torch.where(free, p, IMPOSSIBLE)
    for function in (maths.divergence.categorical_entropy, maths.divergence.bernoulli_entropy):
        value, gradient = with_gradients(function, hidden)
        expected, wanted = with_gradients(function, p[..., free])
        close(value, expected)
        close(gradient[..., free], wanted)
        same(gradient[..., ~free], torch.zeros_like(gradient[..., ~free]))


def a_bit_is_a_choice_of_two(maths: ModuleType, c: Case) -> None:
    (p,) = parameters(c, 1, width=1)
    pair = torch.nn.functional.pad(p, (0, 1))  # the logits (l, 0)
    close(maths.divergence.bernoulli_entropy(p), maths.divergence.categorical_entropy(pair))


PROPERTIES = (
    the_estimators_are_the_kl_on_average,
    the_gradient_of_k3_is_that_of_the_kl,
    k2_and_k3_are_never_negative,
    entropies_agree_with_torch,
    masked_choices_do_not_exist,
    a_bit_is_a_choice_of_two,
)
