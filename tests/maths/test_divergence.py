"""Entropies and divergences: numbers computed by hand, extremes and derivatives."""

import math

import pytest
import torch
from torch import Tensor

from tightrope.maths.divergence import (
    bernoulli_entropy,
    categorical_entropy,
    gaussian_entropy,
    k1,
    k2,
    k3,
)


def logits(*probabilities: float) -> Tensor:
    return torch.tensor(probabilities, dtype=torch.float64).log() + 3  # any constant may be added


def test_estimators_by_hand() -> None:
    x = torch.tensor([[math.log(2)]], dtype=torch.float64)
    assert k1(x).item() == pytest.approx(-math.log(2))
    assert k2(x).item() == pytest.approx(math.log(2) ** 2 / 2)
    assert k3(x).item() == pytest.approx(2 - 1 - math.log(2))


def test_the_average_of_the_estimators_by_hand() -> None:
    # old (1/2, 1/2), new (1/4, 3/4): log ratios log 1/2 and log 3/2,
    # KL = 0.5 log 2 + 0.5 log 2/3 = 0.5 log 4/3
    x = torch.tensor([[0.5, 1.5]], dtype=torch.float64).log()
    assert k1(x).mean().item() == pytest.approx(0.5 * math.log(4 / 3))
    assert k3(x).mean().item() == pytest.approx(0.5 * math.log(4 / 3))


def test_k3_keeps_its_digits_near_ratio_1() -> None:
    """k3 of x is x^2 / 2 to first order; exp(x) - 1 - x in float32 would be mostly rounding error."""
    x = torch.tensor([[1e-3]])
    assert k3(x).item() == pytest.approx(5e-7, rel=1e-3)


def test_entropies_by_hand() -> None:
    # 0.5 log 2 + 2 * 0.25 log 4 = 1.5 log 2
    assert categorical_entropy(logits(0.5, 0.25, 0.25)).item() == pytest.approx(1.5 * math.log(2))
    assert categorical_entropy(logits(0.5, 0.5, 0)).item() == pytest.approx(math.log(2))
    assert categorical_entropy(logits(0, 1, 0)).item() == 0
    # two fair bits, and a third that is masked
    assert bernoulli_entropy(torch.tensor([0.0, 0.0, -torch.inf])).item() == pytest.approx(2 * math.log(2))
    assert gaussian_entropy(torch.zeros(2)).item() == pytest.approx(math.log(2 * math.pi * math.e))


def test_extreme_logits_are_certain_choices() -> None:
    certain = torch.tensor([[1000.0, -1000.0]], requires_grad=True)
    for entropy in (categorical_entropy(certain), bernoulli_entropy(certain)):
        assert entropy.item() == 0
        (gradient,) = torch.autograd.grad(entropy.sum(), certain)
        assert gradient.tolist() == [[0, 0]]


@pytest.mark.parametrize("function", [k1, k2, k3, categorical_entropy, bernoulli_entropy, gaussian_entropy])
def test_gradients_agree_with_finite_differences(function) -> None:
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(2, 3, 4, generator=generator, dtype=torch.float64)
    assert torch.autograd.gradcheck(function, [drawn.requires_grad_()])
