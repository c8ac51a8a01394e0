"""In float32 every function keeps the dtype and stays within rounding of its float64 result."""

from collections.abc import Callable

import pytest
import torch
from maths_cases import Case, random_case
from torch import Tensor

from tightrope.maths import divergence, returns, statistics, surrogate, values

Function = Callable[[Case], Tensor]
FUNCTIONS: dict[str, Function] = {
    "td_errors": lambda c: returns.td_errors(c.rewards, c.values, c.next_values, c.terminated, 0.99, c.mask),
    "gae": lambda c: returns.gae(
        c.rewards, c.values, c.next_values, c.terminated, c.ended, 0.99, 0.95, c.mask
    ),
    "discounted_returns": lambda c: returns.discounted_returns(c.rewards, c.ended, 0.99, c.values, c.mask),
    "log_ratio": lambda c: surrogate.log_ratio(c.values, c.old_values, c.mask),
    "clipped_surrogate": lambda c: surrogate.clipped_surrogate(c.log_ratio, c.advantages, 0.2, 0.3, 3.0),
    "kl_penalised_surrogate": lambda c: surrogate.kl_penalised_surrogate(c.log_ratio, c.advantages, 0.5),
    "policy_gradient": lambda c: surrogate.policy_gradient(c.log_ratio, c.advantages, c.mask),
    "squared_error": lambda c: values.squared_error(c.values, c.returns, c.mask),
    "clipped_squared_error": lambda c: values.clipped_squared_error(c.values, c.old_values, c.returns, 0.2),
    "explained_variance": lambda c: values.explained_variance(c.values, c.returns, c.mask),
    "k1": lambda c: divergence.k1(c.log_ratio),
    "k2": lambda c: divergence.k2(c.log_ratio),
    "k3": lambda c: divergence.k3(c.log_ratio),
    "categorical_entropy": lambda c: divergence.categorical_entropy(c.values),
    "gaussian_entropy": lambda c: divergence.gaussian_entropy(c.values),
    "bernoulli_entropy": lambda c: divergence.bernoulli_entropy(c.values),
    "masked_sum": lambda c: statistics.masked_sum(c.rewards, c.mask),
    "masked_mean": lambda c: statistics.masked_mean(c.rewards, c.mask),
    "masked_variance": lambda c: statistics.masked_variance(c.rewards, c.mask),
    "standardise": lambda c: statistics.standardise(c.rewards, c.mask),
}


def in_float32(case: Case) -> Case:
    fields = {
        name: field.float() if isinstance(field, Tensor) and field.is_floating_point() else field
        for name, field in vars(case).items()
    }
    return Case(**fields)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_float32_agrees_with_float64(name: str) -> None:
    case = random_case(5, rows=16, steps=64)
    single, double = FUNCTIONS[name](in_float32(case)), FUNCTIONS[name](case)
    assert (single.dtype, double.dtype) == (torch.float32, torch.float64)
    torch.testing.assert_close(single.double(), double, rtol=2e-5, atol=2e-5)


def test_every_function_is_compared() -> None:
    """A function added to the package belongs in the list above."""
    public = {
        name
        for module in (returns, surrogate, values, divergence, statistics)
        for name, member in vars(module).items()
        if not name.startswith("_") and callable(member) and member.__module__ == module.__name__
    }
    assert public - set(FUNCTIONS) == {"clipped", "require_same_shape", "RunningMoments", "ReturnScale"}
