"""Properties of the statistics and the critic's losses: functions of (maths, case), see properties.py."""

import math
from functools import partial
from types import ModuleType

import numpy as np
import torch
from maths_cases import Case, close, poisoned, same, with_gradients
from torch import Tensor


def masked_statistics_are_numpy_on_what_counts(maths: ModuleType, c: Case) -> None:
    x = poisoned(c.rewards, ~c.mask)
    counting = c.rewards[c.mask].numpy()
    number = len(counting)
    statistics = maths.statistics
    assert math.isclose(statistics.masked_sum(x, c.mask), counting.sum(), rel_tol=1e-9, abs_tol=1e-12)
    assert math.isclose(statistics.masked_mean(x, c.mask), counting.mean(), rel_tol=1e-9, abs_tol=1e-12)
    variance = float(statistics.masked_variance(x, c.mask))
    assert math.isclose(variance, counting.var(), rel_tol=1e-9, abs_tol=1e-12)
    if number > 1:
        sample = float(statistics.masked_variance(x, c.mask, number - 1))
        assert math.isclose(sample, counting.var(ddof=1), rel_tol=1e-9, abs_tol=1e-12)


def micro_batches_add_up_to_the_batch(maths: ModuleType, c: Case) -> None:
    """Any split of the rows, even with parts where nothing counts: the same mean and the same gradient."""
    whole = with_gradients(partial(maths.statistics.masked_mean, mask=c.mask), c.rewards)
    cut = int(torch.randint(len(c.rewards) + 1, (), generator=c.generator))
    empty = torch.zeros_like(c.mask)

    def in_parts(x: Tensor, count: float | Tensor) -> Tensor:
        pieces = ((x[:cut], c.mask[:cut]), (x[cut:], c.mask[cut:]), (x, empty))
        parts = [maths.statistics.masked_mean(piece, mask, count) for piece, mask in pieces]
        return torch.stack(parts).sum()

    x = poisoned(c.rewards, ~c.mask)
    for count in (int(c.mask.sum()), c.mask.sum()):
        for part, expected in zip(with_gradients(partial(in_parts, count=count), x), whole, strict=True):
            close(part, expected)


def standardised_steps_have_mean_0_and_std_1(maths: ModuleType, c: Case) -> None:
    result = maths.statistics.standardise(poisoned(c.advantages, ~c.mask), c.mask)
    same(result[~c.mask], torch.zeros_like(result[~c.mask]))
    counting = c.advantages[c.mask].numpy()
    if len(counting) == 1:
        same(result[c.mask], c.advantages[c.mask])
    else:
        expected = (counting - counting.mean()) / (counting.std() + 1e-8)
        close(result[c.mask], torch.from_numpy(expected))


def equal_steps_standardise_to_0(maths: ModuleType, c: Case) -> None:
    """Float32 input too: its mean rounded to float32 is another number, and off by as much as eps."""
    for number in (0.1, 0.7, 1000.1):
        mask = torch.ones(8, 8, dtype=torch.bool)
        same(maths.statistics.standardise(torch.full((8, 8), number), mask), torch.zeros(8, 8))


def running_moments_are_those_of_all_rows(maths: ModuleType, c: Case) -> None:
    """In three batches, some empty, far from 0, where a naive sum of squares loses all digits."""
    rows = c.rewards.numpy() * [1.0, 1e-3][c.seed % 2] + 1e4
    width = rows.shape[1]
    moments = maths.statistics.RunningMoments.empty(width)
    for batch in np.array_split(rows, 3):
        moments = moments.update(torch.from_numpy(batch))
    assert float(moments.count) == len(rows)
    np.testing.assert_allclose(moments.mean.numpy(), rows.mean(0), rtol=1e-12)
    np.testing.assert_allclose(moments.variance.numpy(), rows.var(0), rtol=1e-6, atol=1e-12)


def value_losses_are_their_equations(maths: ModuleType, c: Case) -> None:
    plain = maths.values.squared_error(c.values, c.returns)
    clipped = maths.values.clipped_squared_error(c.values, c.old_values, c.returns, 0.3)
    for place in np.ndindex(*plain.shape):
        value, old, target = (float(x[place]) for x in (c.values, c.old_values, c.returns))
        near = min(max(value, old - 0.3), old + 0.3)
        error = 0.5 * (value - target) ** 2
        assert math.isclose(float(plain[place]), error, rel_tol=1e-9)
        pessimistic = max(error, 0.5 * (near - target) ** 2)
        assert math.isclose(float(clipped[place]), pessimistic, rel_tol=1e-9)


def a_clipped_value_gets_no_gradient(maths: ModuleType, c: Case) -> None:
    """Exactly where it has moved too far and towards its target; V - R everywhere else."""
    values = c.values.clone().requires_grad_()
    maths.values.clipped_squared_error(values, c.old_values, c.returns, 0.3).sum().backward()
    far = (c.values - c.old_values).abs() > 0.3
    near = c.old_values + (c.values - c.old_values).clamp(-0.3, 0.3)
    flat = far & ((near - c.returns).abs() > (c.values - c.returns).abs())
    assert values.grad is not None
    close(values.grad, torch.where(flat, 0.0, c.values - c.returns))


def nan_in_padding_never_reaches_the_critic(maths: ModuleType, c: Case) -> None:
    def loss(values: Tensor, old_values: Tensor, returns: Tensor) -> Tensor:
        losses = maths.values.squared_error(values, returns, c.mask)
        clipped = maths.values.clipped_squared_error(values, old_values, returns, 0.3, c.mask)
        same((losses + clipped)[~c.mask], torch.zeros_like(losses[~c.mask]))
        return losses + clipped

    inputs = (c.values, c.old_values, c.returns)
    clean = with_gradients(loss, *inputs)
    same(with_gradients(loss, *(poisoned(x, ~c.mask) for x in inputs)), clean)


def explained_variance_is_one_minus_the_rest(maths: ModuleType, c: Case) -> None:
    values, returns = poisoned(c.values, ~c.mask), poisoned(c.returns, ~c.mask)
    result = maths.values.explained_variance(values, returns, c.mask)
    total, rest = (float(np.var(x[c.mask].numpy())) for x in (c.returns, c.returns - c.values))
    assert math.isclose(float(result), 1 - rest / total if total > 0 else 0.0, rel_tol=1e-9, abs_tol=1e-9)


PROPERTIES = (
    masked_statistics_are_numpy_on_what_counts,
    micro_batches_add_up_to_the_batch,
    standardised_steps_have_mean_0_and_std_1,
    equal_steps_standardise_to_0,
    running_moments_are_those_of_all_rows,
    value_losses_are_their_equations,
    a_clipped_value_gets_no_gradient,
    nan_in_padding_never_reaches_the_critic,
    explained_variance_is_one_minus_the_rest,
)
