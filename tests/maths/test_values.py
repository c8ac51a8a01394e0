"""The critic's losses and explained variance: numbers computed by hand, derivatives and bad shapes."""

import pytest
import torch
from torch import Tensor

from tightrope.maths.values import ReturnScale, clipped_squared_error, explained_variance, squared_error


def row(*numbers: float) -> Tensor:
    return torch.tensor([numbers], dtype=torch.float64)


ALL = torch.ones(1, 4, dtype=torch.bool)


def test_squared_error_by_hand() -> None:
    assert squared_error(row(1, 5), row(3, 2)).tolist() == [[2, 4.5]]  # 0.5 * 2^2, 0.5 * 3^2


def test_clipped_squared_error_by_hand() -> None:
    """The old value is 0 and the clip 1 everywhere."""
    values = row(3, 3, -3, 0.5).requires_grad_()
    loss = clipped_squared_error(values, row(0, 0, 0, 0), row(4, 1, 4, 4), 1.0)
    # moved 3 towards 4, more than allowed: evaluated at 1, 0.5 * 3^2, and flat
    # moved past its target 1: evaluated where it is, 0.5 * 2^2, and pulled back
    # moved away from 4: evaluated where it is, 0.5 * 7^2, and pulled back
    # moved 0.5, which is allowed: 0.5 * 3.5^2
    assert loss.tolist() == [[4.5, 2, 24.5, 6.125]]
    loss.sum().backward()
    assert values.grad is not None
    assert values.grad.tolist() == [[0, 2, -7, -3.5]]


def test_explained_variance_by_hand() -> None:
    returns = row(1, 2, 3, 4)  # mean 2.5, variance (2.25 + 0.25 + 0.25 + 2.25) / 4 = 1.25
    assert explained_variance(returns, returns, ALL) == 1
    assert explained_variance(returns + 7, returns, ALL) == 1  # a constant error has no variance
    assert explained_variance(row(9, 9, 9, 9), returns, ALL) == 0
    assert explained_variance(-returns, returns, ALL) == -3  # 1 - Var(2 R) / Var(R) = 1 - 4
    # errors 1, 0, 0, 1: variance 0.25, and 1 - 0.25 / 1.25 = 0.8
    assert explained_variance(row(0, 2, 3, 3), returns, ALL) == pytest.approx(0.8)
    # only the first two count: errors 1, 0 of variance 0.25, returns of variance 0.25
    assert explained_variance(row(0, 2, 3, 3), returns, torch.tensor([[True, True, False, False]])) == 0


def test_explained_variance_of_equal_returns_is_0() -> None:
    """0.1 has no exact binary form; its float32 mean would leave a variance of rounding errors."""
    returns, mask = torch.full((8, 8), 0.1), torch.ones(8, 8, dtype=torch.bool)
    assert explained_variance(torch.randn(8, 8), returns, mask) == 0
    assert explained_variance(returns, returns, mask) == 0
    assert explained_variance(returns, returns, ~mask) == 0


def test_the_scale_of_returns_by_hand() -> None:
    first = ReturnScale().update(row(1, 1, 3, 3), ALL)
    assert (first.mean, first.deviation, first.weight) == pytest.approx((2, 1, 0.1))
    # the share of the second rollout is 0.1 / 0.19; its mean is 4 and its variance 0
    second, share = first.update(row(4, 4, 4, 4), ALL), 0.1 / 0.19
    variance = (1 - share) + share * (1 - share) * 4
    assert (second.mean, second.deviation) == pytest.approx((2 + 2 * share, variance**0.5))
    # a rollout of a deviation of 100 counts at once
    assert second.update(row(-100, 100, -100, 100), ALL).deviation == 100
    assert first.values(row(-1, 0, 2, 9)).tolist() == [[1, 2, 4, 11]]
    assert first.outputs(row(1, 2, 4, 11)).tolist() == [[-1, 0, 2, 9]]


def test_the_scale_of_returns_leaves_out_masked_steps_and_waits_for_finite_ones() -> None:
    mask = torch.tensor([[True, True, False, False]])
    assert ReturnScale().update(row(1, 3, 9, torch.nan), mask) == ReturnScale(2.0, 1.0, 0.1)
    before = ReturnScale(2.0, 1.0, 0.1)
    assert before.update(row(1, 3, 9, torch.nan), ALL) == before
    assert before.update(row(1, 3, 9, 9), ~ALL) == before


@pytest.mark.parametrize("size", [1e-30, 1e-6, 1.0, 1e6, 1e30])
@pytest.mark.parametrize("offset", [0.0, 1e6, -1e9])
def test_targets_are_of_order_1_for_any_size_and_offset(size: float, offset: float) -> None:
    plain = torch.randn(1, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    scale = ReturnScale().update(size * (offset + plain), ALL)
    expected = (plain - plain.mean()) / plain.std(correction=0)
    torch.testing.assert_close(scale.outputs(size * (offset + plain)), expected, rtol=1e-5, atol=1e-5)


def test_returns_that_are_alike_have_no_deviation_and_outputs_then_count_for_nothing() -> None:
    scale = ReturnScale()
    for _ in range(30):
        scale = scale.update(row(0.1, 0.1, 0.1, 0.1), ALL)
    assert scale.deviation == 0
    assert scale.values(row(5, -5, 0, 1)).tolist() == [[scale.mean] * 4]
    assert scale.outputs(row(0.1, 0.1, 0.1, 0.1)).abs().max() < 1e-12
    # after a deviation has been seen it takes many rollouts, but not for ever
    scale = scale.update(row(0, 1, 0, 1), ALL)
    for _ in range(2000):
        scale = scale.update(row(1, 1, 1, 1), ALL)
    assert scale.mean == pytest.approx(1) and scale.deviation == 0


@pytest.mark.parametrize("after", [ReturnScale(7.0, 3.0, 1.0), ReturnScale(-1e6, 1e5, 1.0)])
def test_a_layer_that_is_carried_gives_the_same_values(after: ReturnScale) -> None:
    before, generator = ReturnScale(2.0, 0.5, 0.5), torch.Generator().manual_seed(0)
    features, weight = (torch.randn(5, 3, dtype=torch.float64, generator=generator) for _ in range(2))
    bias = torch.randn(5, dtype=torch.float64, generator=generator)
    old = before.values(features @ weight.T + bias)
    factor, shift = before.change(after)
    torch.testing.assert_close(after.values(features @ (factor * weight).T + factor * bias + shift), old)


def test_outputs_that_counted_for_nothing_are_not_carried() -> None:
    new, known = ReturnScale(), ReturnScale(2.0, 0.5, 0.1)
    assert new.change(known) == known.change(new) == (1, 0)


@pytest.mark.parametrize(
    "numbers", [(0.0, -1.0, 0.0), (torch.nan, 1.0, 0.0), (0.0, torch.inf, 0.0), (0, 1, 0)]
)
def test_statistics_that_cannot_be_are_refused(numbers: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="expected finite floats"):
        ReturnScale(*numbers)


def test_gradients_agree_with_finite_differences() -> None:
    inputs = [x.requires_grad_() for x in (row(3, 3, -3, 0.5), row(0, 0.1, 0.2, 0), row(4, 1, 4, 4))]

    def clipped(values: Tensor, old_values: Tensor, returns: Tensor) -> Tensor:
        return clipped_squared_error(values, old_values, returns, 1.0)

    assert torch.autograd.gradcheck(clipped, inputs)
    assert torch.autograd.gradcheck(squared_error, inputs[:2])


def test_broadcasting_is_refused() -> None:
    """The classic: values [B, 1] minus returns [B] is a matrix."""
    with pytest.raises(ValueError, match=r"values \(4, 1\), returns \(4,\)"):
        squared_error(torch.zeros(4, 1), torch.zeros(4))
    with pytest.raises(ValueError, match="old_values"):
        clipped_squared_error(torch.zeros(4, 1), torch.zeros(4), torch.zeros(4, 1), 0.2)
    with pytest.raises(ValueError, match="mask"):
        explained_variance(torch.zeros(4, 1), torch.zeros(4, 1), ALL)
