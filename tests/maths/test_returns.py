"""Returns and advantages: numbers computed by hand, derivatives and bad shapes."""

import pytest
import torch
from maths_cases import random_case

from tightrope.maths.returns import discounted_returns, gae, td_errors

# Three steps with gamma = lambda = 0.5. Rewards 1, 2, 3; values 4, 8, 16; next values 8, 16, 32.
REWARDS = torch.tensor([[1.0, 2.0, 3.0]])
VALUES = torch.tensor([[4.0, 8.0, 16.0]])
FOLLOWING = torch.tensor([[8.0, 16.0, 32.0]])
NEVER = torch.tensor([[False, False, False]])
SECOND = torch.tensor([[False, True, False]])


def test_td_errors_by_hand() -> None:
    # 1 + 0.5 * 8 - 4 = 1;  2 + 0.5 * 16 - 8 = 2, or 2 - 8 = -6 when terminated;  3 + 0.5 * 32 - 16 = 3
    assert td_errors(REWARDS, VALUES, FOLLOWING, NEVER, 0.5).tolist() == [[1, 2, 3]]
    assert td_errors(REWARDS, VALUES, FOLLOWING, SECOND, 0.5).tolist() == [[1, -6, 3]]
    assert td_errors(REWARDS, VALUES, FOLLOWING, NEVER, 0.5, ~SECOND).tolist() == [[1, 0, 3]]


def test_gae_by_hand() -> None:
    # A3 = 3;  A2 = 2 + 0.25 * 3 = 2.75;  A1 = 1 + 0.25 * 2.75 = 1.6875
    assert gae(REWARDS, VALUES, FOLLOWING, NEVER, NEVER, 0.5, 0.5).tolist() == [[1.6875, 2.75, 3]]


def test_lambda_may_differ_from_row_to_row() -> None:
    # the first row as above;  with lambda 0 the TD errors are left;  the dtype is that of the rewards
    parts = [part.expand(2, 3) for part in (REWARDS, VALUES, FOLLOWING, NEVER, NEVER)]
    result = gae(*parts, 0.5, torch.tensor([0.5, 0.0], dtype=torch.float64))
    assert result.tolist() == [[1.6875, 2.75, 3], [1, 2, 3]]
    assert result.dtype == REWARDS.dtype


def test_a_truncation_keeps_the_value_and_drops_the_trace() -> None:
    # A3 = 3;  A2 = 2, no trace;  A1 = 1 + 0.25 * 2 = 1.5
    assert gae(REWARDS, VALUES, FOLLOWING, NEVER, SECOND, 0.5, 0.5).tolist() == [[1.5, 2, 3]]


def test_a_termination_drops_both() -> None:
    # A3 = 3;  A2 = -6;  A1 = 1 + 0.25 * -6 = -0.5
    assert gae(REWARDS, VALUES, FOLLOWING, SECOND, SECOND, 0.5, 0.5).tolist() == [[-0.5, -6, 3]]


def test_no_trace_passes_through_a_masked_step() -> None:
    # A3 = 3;  the second step does not count;  A1 = 1, though the second step has not ended
    assert gae(REWARDS, VALUES, FOLLOWING, NEVER, NEVER, 0.5, 0.5, ~SECOND).tolist() == [[1, 0, 3]]


def test_discounted_returns_by_hand() -> None:
    bootstrap = torch.tensor([[100.0, 4.0, 8.0]])
    # none: 3;  2 + 0.5 * 3 = 3.5;  1 + 0.5 * 3.5 = 2.75
    assert discounted_returns(REWARDS, NEVER, 0.5).tolist() == [[2.75, 3.5, 3]]
    # the last column is a cut: 3 + 0.5 * 8 = 7;  2 + 0.5 * 7 = 5.5;  1 + 0.5 * 5.5 = 3.75
    assert discounted_returns(REWARDS, NEVER, 0.5, bootstrap).tolist() == [[3.75, 5.5, 7]]
    # the second step truncated: 7;  2 + 0.5 * 4 = 4;  1 + 0.5 * 4 = 3
    assert discounted_returns(REWARDS, SECOND, 0.5, bootstrap).tolist() == [[3, 4, 7]]


def test_gradients_agree_with_finite_differences() -> None:
    c = random_case(0, rows=2, steps=4)
    inputs = [x.clone().requires_grad_() for x in (c.rewards, c.values, c.next_values)]

    def advantages(*parts: torch.Tensor) -> torch.Tensor:
        return gae(*parts, c.terminated, c.ended, 0.9, 0.7, c.mask)

    def returns(rewards: torch.Tensor, bootstrap: torch.Tensor) -> torch.Tensor:
        return discounted_returns(rewards, c.ended, 0.9, bootstrap, c.mask)

    assert torch.autograd.gradcheck(advantages, inputs)
    assert torch.autograd.gradcheck(returns, inputs[:2])


def test_broadcasting_is_refused() -> None:
    """Rewards [T] with values [1, T] would broadcast, and mostly give nonsense."""
    with pytest.raises(ValueError, match=r"shapes differ: rewards \(3,\), values \(1, 3\)"):
        td_errors(REWARDS[0], VALUES, FOLLOWING, NEVER, 0.5)
    with pytest.raises(ValueError, match=r"ended \(3, 1\)"):
        gae(REWARDS, VALUES, FOLLOWING, NEVER, NEVER.T, 0.5, 0.5)
    with pytest.raises(ValueError, match=r"mask \(3,\)"):
        gae(REWARDS, VALUES, FOLLOWING, NEVER, NEVER, 0.5, 0.5, NEVER[0])
    with pytest.raises(ValueError, match=r"gae_lambda \(3,\)"):
        gae(REWARDS, VALUES, FOLLOWING, NEVER, NEVER, 0.5, torch.zeros(3))
    with pytest.raises(ValueError, match=r"gae_lambda \(1, 1\)"):
        gae(REWARDS, VALUES, FOLLOWING, NEVER, NEVER, 0.5, torch.zeros(1, 1))
    with pytest.raises(ValueError, match=r"bootstrap \(1,\)"):
        discounted_returns(REWARDS, NEVER, 0.5, torch.tensor([0.0]))
