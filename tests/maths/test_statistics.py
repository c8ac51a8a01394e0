"""Masked statistics and running moments: numbers computed by hand and edge cases."""

import dataclasses

import pytest
import torch

from tightrope.maths.statistics import (
    RunningMoments,
    masked_mean,
    masked_sum,
    masked_variance,
    standardise,
)

X = torch.tensor([[1.0, 2.0], [6.0, torch.nan]])
MASK = torch.tensor([[True, True], [True, False]])


def test_masked_statistics_by_hand() -> None:
    assert masked_sum(X, MASK) == 9
    assert masked_mean(X, MASK) == 3
    assert masked_mean(X, MASK, 6) == 1.5  # three more steps count elsewhere
    assert masked_variance(X, MASK) == pytest.approx((4 + 1 + 9) / 3)
    assert masked_variance(X, MASK, 2) == 7  # the sample variance


def test_standardise_by_hand() -> None:
    x = torch.tensor([[1.0, 3.0, 100.0]])
    mask = torch.tensor([[True, True, False]])  # mean 2, standard deviation 1
    assert standardise(x, mask, eps=0.0).tolist() == [[-1, 1, 0]]
    assert standardise(x, mask, eps=1.0).tolist() == [[-0.5, 0.5, 0]]


def test_a_single_step_is_not_standardised() -> None:
    assert standardise(X, torch.tensor([[False, False], [True, False]])).tolist() == [[0, 0], [6, 0]]


def test_an_empty_part_adds_nothing() -> None:
    nothing = torch.zeros(2, 2, dtype=torch.bool)
    x = X.clone().requires_grad_()
    mean = masked_mean(x, nothing)
    mean.backward()
    assert mean == 0
    assert x.grad is not None
    assert not x.grad.any()
    assert masked_mean(X, nothing, 5) == 0
    assert masked_variance(X, nothing) == 0
    assert standardise(X, nothing).tolist() == [[0, 0], [0, 0]]


def test_bad_counts_and_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="count is 0, expected"):
        masked_mean(X, MASK, 0)
    for function in (masked_sum, masked_mean, masked_variance, standardise):
        with pytest.raises(ValueError, match=r"x \(2, 2\), mask \(2,\)"):
            function(X, MASK[0])


def test_gradients_agree_with_finite_differences() -> None:
    x = torch.randn(3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    mask = x.detach() > -1

    def statistics(x: torch.Tensor) -> torch.Tensor:
        return torch.stack(
            [masked_mean(x, mask, 20), masked_variance(x, mask), standardise(x, mask).sin().sum()]
        )

    assert torch.autograd.gradcheck(statistics, x)


def test_running_moments_by_hand() -> None:
    first = RunningMoments.empty(1).update(torch.tensor([[1.0], [3.0]]))
    assert (first.count.item(), first.mean.item(), first.variance.item()) == (2, 2, 1)
    # 1, 3, 5, 7: mean 4, variance (9 + 1 + 1 + 9) / 4 = 5
    second = first.update(torch.tensor([[5.0], [7.0]]))
    assert (second.count.item(), second.mean.item(), second.variance.item()) == (4, 4, 5)


def test_running_moments_begin_as_the_identity_and_never_change_in_place() -> None:
    empty = RunningMoments.empty(3)
    assert (empty.count.item(), empty.mean.tolist(), empty.variance.tolist()) == (0, [0] * 3, [1] * 3)
    batch = torch.ones(2, 3, dtype=torch.float32)
    assert empty.update(batch[:0]) is empty
    after = empty.update(batch)
    assert {x.dtype for x in (after.count, after.mean, after.variance)} == {torch.float64}
    assert (empty.count.item(), empty.mean.tolist(), empty.variance.tolist()) == (0, [0] * 3, [1] * 3)
    with pytest.raises(dataclasses.FrozenInstanceError):
        after.count = empty.count  # type: ignore[misc]


def test_running_moments_refuse_another_width() -> None:
    for batch in (torch.zeros(4, 3), torch.zeros(2)):
        with pytest.raises(ValueError, match=r"expected \[N, 2\]"):
            RunningMoments.empty(2).update(batch)
