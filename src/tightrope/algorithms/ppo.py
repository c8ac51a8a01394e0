"""Proximal policy optimisation: several epochs of minibatches on one rollout, held near the sampling policy.

    L = E[ -min(r A, clip(r, 1 - clip, 1 + clip) A) ] + value_weight * L_value - entropy_weight * H
    r = pi(a|s) / pi_old(a|s)        (Schulman et al. 2017, eq. 7, 9)

Read beside a2c.py: epochs, minibatches, the clip and the KL stop are all that is added.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from tightrope.algorithms.batch import Batch, Evaluation
from tightrope.algorithms.descent import Descent, Draw, ExtraLoss, Model, Terms
from tightrope.algorithms.settings import PPOSettings
from tightrope.maths import surrogate, values


def policy_loss(log_ratio: Tensor, advantages: Tensor, settings: PPOSettings) -> Tensor:
    """The clipped surrogate, or with ``kl_beta`` the KL-penalised one; [B, T], to be minimised."""
    if settings.kl_beta is not None:
        return surrogate.kl_penalised_surrogate(log_ratio, advantages, settings.kl_beta)
    return surrogate.clipped_surrogate(
        log_ratio, advantages, settings.clip, settings.clip_high, settings.dual_clip
    )


def value_loss(new: Tensor, part: Batch, settings: PPOSettings) -> Tensor:
    """Half the squared error to the returns, or with ``value_clip`` the clipped kind; [B, T]."""
    if settings.value_clip is not None:
        return values.clipped_squared_error(new, part.old_values, part.returns, settings.value_clip)
    return values.squared_error(new, part.returns)


def next_kl_beta(kl_beta: float, kl: float, kl_adapt: float) -> float:
    """The adaptive KL penalty of the PPO paper (eq. 8): halved where ``kl``, after the update, is below
    kl_adapt / 1.5, doubled above 1.5 kl_adapt.
    """
    if kl < kl_adapt / 1.5:
        return kl_beta / 2
    return kl_beta * 2 if kl > kl_adapt * 1.5 else kl_beta


def update(
    model: Model,
    optimiser: torch.optim.Optimizer,
    batch: Batch,
    settings: PPOSettings,
    rng: np.random.Generator,
    *,
    extra_loss: ExtraLoss | None = None,
    draw: Draw | None = None,
    refresh: Callable[[Batch], Batch] | None = None,
    log_ratio_limit: float | None = None,
) -> dict[str, float]:
    """Improve ``model`` on one rollout; returns the metrics, means over every minibatch; approx_kl over those
    of the last epoch, kl_after (with ``kl_adapt``) over the batch after the last step.

    ``model(batch) -> Evaluation``. ``extra_loss(model, part, evaluation, count) -> (loss, metrics)``:
    the loss is a sum over the part / ``count``, the counting steps of the whole minibatch, as the rest is;
    the metrics are [B, T], or a sum and the number of its terms.
    ``draw(minibatch) -> minibatch`` adds inputs that are drawn at random, once: a pass may be repeated.
    ``refresh(batch) -> batch`` estimates advantages again when ``recompute_advantages`` is on.
    Rows without a counting step are left out. Raises ValueError when no step counts, NonFiniteError before a
    step with a bad gradient, SamplingMismatch when the first log-ratios exceed ``log_ratio_limit``.
    """
    batch = batch.cleared()
    clip_high = settings.clip if settings.clip_high is None else settings.clip_high
    descent = Descent(
        model, optimiser, settings, batch, clip=settings.clip, clip_high=clip_high,
        extra_loss=extra_loss, draw=draw, log_ratio_limit=log_ratio_limit,
    )  # fmt: skip

    def loss(now: Evaluation, log_ratio: Tensor, part: Batch) -> Terms:
        policy = policy_loss(log_ratio, part.advantages, settings)
        value = value_loss(now.values, part, settings)
        total = policy + settings.value_weight * value - settings.entropy_weight * now.entropy
        return Terms(policy, value, total)

    for epoch in range(settings.num_epochs):
        if epoch and refresh is not None and settings.recompute_advantages:
            batch = refresh(batch).cleared()
        for number, minibatch in enumerate(batch.minibatches(settings.minibatch_size, rng), start=1):
            where = f"in minibatch {number} of epoch {epoch + 1}"
            if descent.step(batch, minibatch, loss, where, settings.target_kl, new_epoch=number == 1):
                break
        if descent.halted():
            break
    if settings.kl_beta is not None and settings.kl_adapt is not None:
        descent.measure_after(batch, settings.minibatch_size)
    return descent.metrics()
