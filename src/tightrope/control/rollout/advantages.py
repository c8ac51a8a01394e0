"""From a rollout to the Batch that the update rules take: values, advantages, returns."""

from __future__ import annotations

import numpy as np
import torch

from tightrope.algorithms.batch import Batch
from tightrope.algorithms.settings import ReinforceSettings, UpdateSettings
from tightrope.control.engine.base import Engine
from tightrope.control.policy.normalise import Normalisers
from tightrope.control.rollout.rollout import Array, Rollout


def to_batch(rollout: Rollout, engine: Engine, normalisers: Normalisers, settings: UpdateSettings) -> Batch:
    """Values, advantages and returns of a rollout, as a Batch [B, T]; nothing else changes."""
    rewards = rollout.rewards.astype(np.float32)
    if normalisers.rewards is not None:
        rewards = normalisers.rewards(rollout.rewards)
    values, following = critic_values(rollout, engine)
    mask = rollout.mask
    if isinstance(settings, ReinforceSettings) and not settings.baseline:
        mask = mask & finished(rollout.ended, mask)
        values = np.zeros_like(values)
        following = np.zeros_like(values)
    advantages = engine.gae(
        rewards,
        values,
        following,
        rollout.terminated,
        rollout.ended,
        mask,
        settings.gamma,
        settings.gae_lambda,
    )

    def tensor(array: Array) -> torch.Tensor:
        return torch.from_numpy(array).to(engine.device)

    return Batch(
        inputs={name: tensor(x) for name, x in rollout.inputs.items()},
        actions=tensor(rollout.actions),
        old_logp=tensor(rollout.logp),
        old_values=tensor(values),
        advantages=tensor(advantages),
        returns=tensor(advantages + values),
        mask=tensor(mask),
    )


def critic_values(rollout: Rollout, engine: Engine) -> tuple[Array, Array]:
    """V of every observation, and of the true next observation of every step, both [B, T].

    The second differs from a shift of the first at the end of the rollout and at truncations.
    """
    flat = {name: x.reshape(-1, *x.shape[2:]) for name, x in rollout.inputs.items()}
    values = engine.values(flat).reshape(rollout.logp.shape)
    following = np.empty_like(values)
    following[:, :-1] = values[:, 1:]
    following[:, -1] = engine.values(rollout.last)
    if rollout.finals:
        names = rollout.finals[0][2]
        finals = engine.values({n: np.concatenate([x[n] for _, _, x in rollout.finals]) for n in names})
        columns = np.concatenate([np.full(len(rows), t) for t, rows, _ in rollout.finals])
        following[np.concatenate([rows for _, rows, _ in rollout.finals]), columns] = finals
    return values, following


def finished(ended: Array, mask: Array) -> Array:
    """True [B, T] for steps whose episode ends inside the rollout, other than by a fault that cut it.

    A fault is ``ended`` where ``mask`` is False.
    """
    found = np.zeros_like(ended)
    complete = np.zeros(len(ended), bool)
    for t in range(ended.shape[1] - 1, -1, -1):
        complete = np.where(ended[:, t], mask[:, t], complete)
        found[:, t] = complete
    return found
