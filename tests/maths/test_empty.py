"""No rows and no steps: per-step results stay empty, scalars are 0, and nothing crashes."""

import pytest
import torch

from tightrope.maths import divergence, returns, statistics, surrogate, values

SHAPES = [(0, 0), (0, 3), (2, 0)]
PER_STEP = {
    "td_errors": lambda x, no: returns.td_errors(x, x, x, no, 0.9, no),
    "gae": lambda x, no: returns.gae(x, x, x, no, no, 0.9, 0.95, no),
    "gae with a lambda a row": lambda x, no: returns.gae(x, x, x, no, no, 0.9, torch.ones(len(x)), no),
    "discounted_returns": lambda x, no: returns.discounted_returns(x, no, 0.9, x, no),
    "standardise": statistics.standardise,
    "log_ratio": lambda x, no: surrogate.log_ratio(x, x, no),
    "clipped_surrogate": lambda x, no: surrogate.clipped_surrogate(x, x, 0.2, 0.3, 3.0),
    "kl_penalised_surrogate": lambda x, no: surrogate.kl_penalised_surrogate(x, x, 0.1),
    "policy_gradient": surrogate.policy_gradient,
    "squared_error": lambda x, no: values.squared_error(x, x, no),
    "clipped_squared_error": lambda x, no: values.clipped_squared_error(x, x, x, 0.2, no),
    "k1": lambda x, no: divergence.k1(x),
    "k2": lambda x, no: divergence.k2(x),
    "k3": lambda x, no: divergence.k3(x),
}
SCALARS = {
    "masked_sum": statistics.masked_sum,
    "masked_mean": statistics.masked_mean,
    "masked_variance": statistics.masked_variance,
    "explained_variance": lambda x, no: values.explained_variance(x, x, no),
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("name", PER_STEP)
def test_what_is_per_step_is_empty(name, shape):
    assert PER_STEP[name](torch.zeros(shape), torch.zeros(shape, dtype=torch.bool)).shape == shape


@pytest.mark.parametrize("shape", [*SHAPES, (2, 3)])
@pytest.mark.parametrize("name", SCALARS)
def test_a_scalar_over_nothing_is_0(name, shape):
    found = SCALARS[name](torch.full(shape, torch.nan), torch.zeros(shape, dtype=torch.bool))
    assert found.shape == () and found.item() == 0
