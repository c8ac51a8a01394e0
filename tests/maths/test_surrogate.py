"""Surrogate losses: the cases of the clip and other numbers computed by hand, derivatives and bad input."""

import math

import pytest
import torch
from maths_cases import random_case
from torch import Tensor

from tightrope.maths.surrogate import (
    clipped,
    clipped_surrogate,
    kl_penalised_surrogate,
    log_ratio,
    policy_gradient,
)


def step(ratio: float, advantage: float, **options: float) -> tuple[float, float]:
    """The loss of one step with clip 0.2, and its gradient by the ratio."""
    x = torch.tensor([[ratio]], dtype=torch.float64).log().requires_grad_()
    loss = clipped_surrogate(x, torch.tensor([[advantage]], dtype=torch.float64), 0.2, **options)
    loss.sum().backward()
    assert x.grad is not None
    return round(loss.item(), 12), round(x.grad.item() / ratio, 12)


@pytest.mark.parametrize(
    ("ratio", "advantage", "loss", "gradient"),
    [
        (1.5, 2.0, -2.4, 0.0),  # 1: encouraged enough, -1.2 * 2, flat
        (1.1, 2.0, -2.2, -2.0),  # 2: inside, -1.1 * 2, flows
        (0.5, -2.0, 1.6, 0.0),  # 3: discouraged enough, -(0.8 * -2), flat
        (1.5, -2.0, 3.0, 2.0),  # 4: a bad action made likelier, -(1.5 * -2), flows
        (0.5, 2.0, -1.0, -2.0),  # a good action made rarer, -(0.5 * 2), flows
        (0.9, -2.0, 1.8, 2.0),  # inside, -(0.9 * -2), flows
    ],
)
def test_the_cases_of_the_clip(ratio: float, advantage: float, loss: float, gradient: float) -> None:
    assert step(ratio, advantage) == (loss, gradient)


def test_the_dual_clip_adds_its_own_case() -> None:
    assert step(5.0, -2.0) == (10.0, 2.0)
    assert step(5.0, -2.0, dual_clip=3.0) == (6.0, 0.0)  # 3 * |-2|
    assert step(2.5, -2.0, dual_clip=3.0) == (5.0, 2.0)  # below the bound nothing changes
    assert step(5.0, 2.0, dual_clip=3.0) == (-2.4, 0.0)  # nor for a good action
    assert step(0.5, -2.0, dual_clip=3.0) == (1.6, 0.0)


def test_the_upper_side_may_differ() -> None:
    assert step(1.3, 2.0, clip_high=0.4) == (-2.6, -2.0)
    assert step(1.5, 2.0, clip_high=0.4) == (-2.8, 0.0)
    assert step(0.7, -2.0, clip_high=0.4) == (1.6, 0.0)


def test_case_4_without_dual_clip_is_not_silently_bounded() -> None:
    """exp(1000) is infinite. An infinite loss is noticed; a silent 0 gradient would not be."""
    loss = clipped_surrogate(torch.tensor([[1000.0]]), torch.tensor([[-1.0]]), 0.2)
    assert loss.item() == math.inf


def test_log_ratio_by_hand() -> None:
    logp = torch.tensor([[-1.0, -2.0, torch.nan]], requires_grad=True)
    result = log_ratio(logp, torch.tensor([[-1.5, 7.0, 1.0]]), torch.tensor([[True, False, False]]))
    assert result.tolist() == [[0.5, 0, 0]]
    result.sum().backward()
    assert logp.grad is not None
    assert logp.grad.tolist() == [[1, 0, 0]]


def test_the_kl_penalty_by_hand() -> None:
    # r = 2, A = 3, beta 0.5: -(6 - 0.5 * (2 - 1 - log 2))
    loss = kl_penalised_surrogate(torch.tensor([[math.log(2)]]), torch.tensor([[3.0]]), 0.5)
    assert loss.item() == pytest.approx(-6 + 0.5 * (1 - math.log(2)))


def test_the_policy_gradient_by_hand() -> None:
    logp, advantages = torch.tensor([[-0.5, -3.0]]), torch.tensor([[4.0, torch.nan]])
    assert policy_gradient(logp, advantages, torch.tensor([[True, False]])).tolist() == [[2, 0]]
    assert policy_gradient(logp[:, :1], advantages[:, :1]).tolist() == [[2]]


def test_indicators_by_hand() -> None:
    ratios = torch.tensor([[0.5, 0.9, 1.1, 1.5]], requires_grad=True).log()
    high, low = clipped(ratios, 0.2, 0.2)
    assert high.tolist() == [[False, False, False, True]]
    assert low.tolist() == [[True, False, False, False]]


def test_gradients_agree_with_finite_differences() -> None:
    """At ratios well away from the kinks: 0.5, 0.9, 1.1, 1.6, 2.5 with clips at 0.8, 1.2 and 2."""
    x = torch.tensor([[0.5, 0.9, 1.1, 1.6, 2.5]] * 2, dtype=torch.float64).log().requires_grad_()
    advantages = torch.tensor([[1.5] * 5, [-0.7] * 5], dtype=torch.float64, requires_grad=True)

    def dual(x: Tensor, advantages: Tensor) -> Tensor:
        return clipped_surrogate(x, advantages, 0.2, None, 2.0)

    def plain(x: Tensor, advantages: Tensor) -> Tensor:
        return clipped_surrogate(x, advantages, 0.2)

    def penalised(x: Tensor, advantages: Tensor) -> Tensor:
        return kl_penalised_surrogate(x, advantages, 0.3)

    for loss in (plain, dual, penalised, policy_gradient):
        assert torch.autograd.gradcheck(loss, (x, advantages))


def test_bad_input_is_refused() -> None:
    c = random_case(0)
    with pytest.raises(ValueError, match=r"dual_clip is 0\.9, expected above 1"):
        clipped_surrogate(c.log_ratio, c.advantages, 0.2, None, 0.9)
    column = c.advantages[:, :1]
    for call in (
        lambda: clipped_surrogate(c.log_ratio, column, 0.2),
        lambda: kl_penalised_surrogate(c.log_ratio, column, 0.1),
        lambda: policy_gradient(c.log_ratio, column),
        lambda: log_ratio(c.log_ratio, c.log_ratio, c.mask[0]),
    ):
        with pytest.raises(ValueError, match="shapes differ"):
            call()
