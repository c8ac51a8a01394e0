"""Returns and advantages: what a step was worth.

Everything is per step, [B, T] in and [B, T] out: B rows (environments or prompts), T steps (or tokens) in
time order.

Two flags tell how a step ended, and they are not the same:

- `terminated`: no future exists, the value after the step is 0.
- `ended`: the segment stops here, because it terminated, was truncated by a time limit, or is cut for any
  other reason. Every terminated step has also ended.

`mask` is True where a step counts. Whatever lies in a masked step or behind a cut (NaN included) changes
nothing, neither a value nor a gradient: cuts are `torch.where`, because 0 * NaN is NaN.

Rewards, values and advantages share one unit. No rows or no steps give as many. Source of GAE: Schulman et
al. 2016, https://arxiv.org/abs/1506.02438
"""

import torch
from torch import Tensor

from .statistics import require_same_shape


def td_errors(
    rewards: Tensor,
    values: Tensor,
    next_values: Tensor,
    terminated: Tensor,
    gamma: float,
    mask: Tensor | None = None,
) -> Tensor:
    """Temporal-difference errors, [B, T].

    delta_t = r_t + gamma * V(s_{t+1}) - V(s_t), without the term of V(s_{t+1}) where `terminated`; 0 where
    masked. `next_values` is V of the true next observation, also at a truncation and at the end of the
    rollout. ValueError when the shapes differ.
    """
    require_same_shape(
        rewards=rewards, values=values, next_values=next_values, terminated=terminated, mask=mask
    )
    return _td_errors(rewards, values, next_values, terminated, gamma, mask)


def _td_errors(
    rewards: Tensor,
    values: Tensor,
    next_values: Tensor,
    terminated: Tensor,
    gamma: float,
    mask: Tensor | None,
) -> Tensor:
    future = torch.where(terminated, 0.0, next_values)
    deltas = rewards + gamma * future - values
    return deltas if mask is None else torch.where(mask, deltas, 0.0)


def gae(
    rewards: Tensor,
    values: Tensor,
    next_values: Tensor,
    terminated: Tensor,
    ended: Tensor,
    gamma: float,
    gae_lambda: float | Tensor,
    mask: Tensor | None = None,
) -> Tensor:
    """Generalised advantage estimates, [B, T].

    A_t = delta_t + gamma * lambda * A_{t+1}, without the second term (the trace) where `ended`, in the last
    column and before a masked step; 0 where masked. lambda 0 is the TD error (biased), lambda 1 is the Monte
    Carlo return minus the value (of high variance). The target of the critic is advantages + values.
    `gae_lambda` is one number for all, or a tensor [B], one for each row (a response whose lambda follows its
    length: VAPO, https://arxiv.org/abs/2504.05118). ValueError when the shapes differ.
    """
    require_same_shape(
        rewards=rewards, values=values, next_values=next_values, terminated=terminated, ended=ended, mask=mask
    )
    deltas = _td_errors(rewards, values, next_values, terminated, gamma, mask)
    if not deltas.shape[1]:
        return deltas
    if isinstance(gae_lambda, Tensor):
        require_same_shape(a_column_of_rewards=rewards[:, 0], gae_lambda=gae_lambda)
        gae_lambda = gae_lambda.to(rewards)
    advantages = []
    trace = torch.zeros_like(deltas[:, 0])
    for t in reversed(range(deltas.shape[1])):
        trace = deltas[:, t] + gamma * gae_lambda * torch.where(ended[:, t], 0.0, trace)
        if mask is not None:
            trace = torch.where(mask[:, t], trace, 0.0)
        advantages.append(trace)
    return torch.stack(advantages[::-1], dim=1)


def discounted_returns(
    rewards: Tensor,
    ended: Tensor,
    gamma: float,
    bootstrap: Tensor | None = None,
    mask: Tensor | None = None,
) -> Tensor:
    """Discounted sums of the rewards to come, [B, T].

    G_t = r_t + gamma * G_{t+1}; where `ended` and in the last column G_t = r_t + gamma * bootstrap_t; 0 where
    masked, and a masked step passes nothing back. `bootstrap` [B, T] is the value of the state after the step
    and is read only at those cuts: give 0 where the step terminated, V(s_{t+1}) where it was truncated or
    cut. None means 0 everywhere. ValueError when the shapes differ.
    """
    require_same_shape(rewards=rewards, ended=ended, bootstrap=bootstrap, mask=mask)
    if not rewards.shape[1]:
        return rewards
    tail = torch.zeros_like(rewards) if bootstrap is None else bootstrap
    returns = []
    future = tail[:, -1]
    for t in reversed(range(rewards.shape[1])):
        future = rewards[:, t] + gamma * torch.where(ended[:, t], tail[:, t], future)
        if mask is not None:
            future = torch.where(mask[:, t], future, 0.0)
        returns.append(future)
    return torch.stack(returns[::-1], dim=1)
