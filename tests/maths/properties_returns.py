"""Properties of returns and advantages: functions of (maths, case), see properties.py."""

import math
from types import ModuleType

import numpy as np
import torch
from maths_cases import Case, close, poisoned, same, with_gradients
from torch import Tensor


def gae_of(maths: ModuleType, c: Case, columns: slice = slice(None), mask: Tensor | None = None) -> Tensor:
    parts = (c.rewards, c.values, c.next_values, c.terminated, c.ended)
    return maths.returns.gae(*(part[:, columns] for part in parts), c.gamma, c.gae_lambda, mask)


def td_errors_follow_their_equation(maths: ModuleType, c: Case) -> None:
    result = maths.returns.td_errors(c.rewards, c.values, c.next_values, c.terminated, c.gamma, c.mask)
    for place in np.ndindex(*result.shape):
        future = 0.0 if c.terminated[place] else c.gamma * float(c.next_values[place])
        expected = float(c.rewards[place]) + future - float(c.values[place])
        assert math.isclose(float(result[place]), expected if c.mask[place] else 0.0, abs_tol=1e-12)


def gae_is_the_discounted_sum_of_td_errors(maths: ModuleType, c: Case) -> None:
    """The definition, a forward sum for every step; the code is a backward recursion."""
    result = gae_of(maths, c, mask=c.mask)
    for row, start in np.ndindex(*result.shape):
        total, weight = 0.0, 1.0
        for t in range(start, result.shape[1]):
            if not c.mask[row, t]:
                break
            future = 0.0 if c.terminated[row, t] else c.gamma * float(c.next_values[row, t])
            total += weight * (float(c.rewards[row, t]) + future - float(c.values[row, t]))
            weight *= c.gamma * c.gae_lambda
            if c.ended[row, t]:
                break
        assert math.isclose(float(result[row, start]), total, rel_tol=1e-9, abs_tol=1e-11)


def lambda_0_is_the_td_error(maths: ModuleType, c: Case) -> None:
    arguments = (c.rewards, c.values, c.next_values, c.terminated)
    one_step = maths.returns.td_errors(*arguments, c.gamma, c.mask)
    close(maths.returns.gae(*arguments, c.ended, c.gamma, 0.0, c.mask), one_step)


def every_row_may_have_a_lambda_of_its_own(maths: ModuleType, c: Case) -> None:
    parts = (c.rewards, c.values, c.next_values, c.terminated, c.ended)
    lambdas = torch.rand(len(c.rewards), generator=c.generator, dtype=torch.float64)
    together = maths.returns.gae(*parts, c.gamma, lambdas, c.mask)
    for row, own in enumerate(lambdas.tolist()):
        here = slice(row, row + 1)
        alone = maths.returns.gae(*(part[here] for part in parts), c.gamma, own, c.mask[here])
        same(together[here], alone)


def lambda_1_is_monte_carlo(maths: ModuleType, c: Case) -> None:
    """The values cancel between one TD error and the next, and the discounted rewards are left."""
    shifted = torch.cat([c.values[:, 1:], c.last_values[:, None]], dim=1)
    following = torch.where(c.ended, c.final_values, shifted)
    advantages = maths.returns.gae(c.rewards, c.values, following, c.terminated, c.ended, c.gamma, 1.0)
    bootstrap = torch.where(c.terminated, 0.0, following)
    returns = maths.returns.discounted_returns(c.rewards, c.ended, c.gamma, bootstrap)
    close(advantages + c.values, returns)


def discounted_returns_are_discounted_sums(maths: ModuleType, c: Case) -> None:
    result = maths.returns.discounted_returns(c.rewards, c.ended, c.gamma, c.final_values, c.mask)
    steps = result.shape[1]
    for row, start in np.ndindex(*result.shape):
        total, weight = 0.0, 1.0
        for t in range(start, steps):
            if not c.mask[row, t]:
                break
            total += weight * float(c.rewards[row, t])
            weight *= c.gamma
            if c.ended[row, t] or t == steps - 1:
                total += weight * float(c.final_values[row, t])
                break
        assert math.isclose(float(result[row, start]), total, rel_tol=1e-9, abs_tol=1e-11)


def without_bootstrap_the_future_is_0(maths: ModuleType, c: Case) -> None:
    nothing = torch.zeros_like(c.rewards)
    expected = maths.returns.discounted_returns(c.rewards, c.ended, c.gamma, nothing)
    same(maths.returns.discounted_returns(c.rewards, c.ended, c.gamma), expected)


def episodes_know_nothing_of_each_other(maths: ModuleType, c: Case) -> None:
    """Cut a row where it has ended: each part gives the same result as in the whole row."""
    whole = gae_of(maths, c)
    returns = maths.returns.discounted_returns(c.rewards, c.ended, c.gamma, c.final_values)
    for row, t in c.ended.nonzero().tolist():
        for part in (slice(0, t + 1), slice(t + 1, None)):
            if whole[:, part].shape[1]:
                same(gae_of(maths, c, part)[row], whole[row, part])
                alone = (c.rewards[:, part], c.ended[:, part], c.gamma, c.final_values[:, part])
                same(maths.returns.discounted_returns(*alone)[row], returns[row, part])


def rows_may_be_permuted_and_padded(maths: ModuleType, c: Case) -> None:
    parts = (c.rewards, c.values, c.next_values, c.terminated, c.ended)
    whole = gae_of(maths, c, mask=c.mask)
    order = torch.randperm(len(c.rewards), generator=c.generator)
    shuffled = maths.returns.gae(*(part[order] for part in parts), c.gamma, c.gae_lambda, c.mask[order])
    same(shuffled, whole[order])

    def pad(part: Tensor) -> Tensor:  # two columns and a row of NaN; of random flags
        wide = torch.full((part.shape[0] + 1, part.shape[1] + 2), torch.nan, dtype=torch.float64)
        if part.dtype == torch.bool:
            wide = torch.rand(wide.shape, generator=c.generator) < 0.5
        wide = wide.to(part.dtype)
        wide[:-1, :-2] = part
        return wide

    mask = torch.zeros(whole.shape[0] + 1, whole.shape[1] + 2, dtype=torch.bool)
    mask[:-1, :-2] = c.mask
    padded = maths.returns.gae(*(pad(part) for part in parts), c.gamma, c.gae_lambda, mask)
    same(padded[:-1, :-2], whole)
    same(padded[~mask], torch.zeros_like(padded[~mask]))


def nan_behind_a_cut_changes_nothing(maths: ModuleType, c: Case) -> None:
    """Neither values nor gradients change, for GAE and the returns."""

    def gae(rewards: Tensor, values: Tensor, following: Tensor) -> Tensor:
        return maths.returns.gae(
            rewards, values, following, c.terminated, c.ended, c.gamma, c.gae_lambda, c.mask
        )

    def returns(rewards: Tensor, bootstrap: Tensor) -> Tensor:
        return maths.returns.discounted_returns(rewards, c.ended, c.gamma, bootstrap, c.mask)

    rewards, values = poisoned(c.rewards, ~c.mask), poisoned(c.values, ~c.mask)
    following = poisoned(c.next_values, ~c.mask | c.terminated)
    clean = with_gradients(gae, c.rewards, c.values, c.next_values)
    same(with_gradients(gae, rewards, values, following), clean)
    last = torch.zeros_like(c.ended)
    last[:, -1] = True
    bootstrap = poisoned(c.final_values, ~c.mask | ~(c.ended | last))
    clean = with_gradients(returns, c.rewards, c.final_values)
    same(with_gradients(returns, rewards, bootstrap), clean)


PROPERTIES = (
    td_errors_follow_their_equation,
    gae_is_the_discounted_sum_of_td_errors,
    lambda_0_is_the_td_error,
    every_row_may_have_a_lambda_of_its_own,
    lambda_1_is_monte_carlo,
    discounted_returns_are_discounted_sums,
    without_bootstrap_the_future_is_0,
    episodes_know_nothing_of_each_other,
    rows_may_be_permuted_and_padded,
    nan_behind_a_cut_changes_nothing,
)
