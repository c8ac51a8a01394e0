"""The critic's losses and explained variance: numbers computed by hand, derivatives and bad shapes."""

import pytest
import torch
from torch import Tensor

from tightrope.maths.values import clipped_squared_error, explained_variance, squared_error


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
