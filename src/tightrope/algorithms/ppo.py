"""Proximal policy optimisation: several epochs of minibatches on one rollout, held near the sampling policy.

    L = E[ -min(r A, clip(r, 1 - clip, 1 + clip) A) ] + value_weight * L_value - entropy_weight * H
    r = pi(a|s) / pi_old(a|s)        (Schulman et al. 2017, eq. 7, 9)

Read beside a2c.py: epochs, minibatches, the clip and the KL stop are all that is added.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tightrope.algorithms.batch import Batch, Evaluation
from tightrope.algorithms.memory import Parts
from tightrope.algorithms.nonfinite import explain
from tightrope.algorithms.optimise import Brake, Meter, book_ratios, check_first_ratios
from tightrope.algorithms.settings import PPOSettings
from tightrope.maths import statistics, surrogate, values

Model = Callable[[Batch], Evaluation]
ExtraLoss = Callable[[Model, Batch, Evaluation, Tensor], tuple[Tensor, dict[str, Any]]]


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
    """The adaptive KL penalty of the PPO paper (eq. 8): halved below kl_adapt / 1.5, doubled above 1.5
    kl_adapt.
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
    draw: Callable[[Batch], Batch] | None = None,
    refresh: Callable[[Batch], Batch] | None = None,
    log_ratio_limit: float | None = None,
) -> dict[str, float]:
    """Improve ``model`` on one rollout; returns the metrics, means over every minibatch.

    ``model(batch) -> Evaluation``. ``extra_loss(model, part, evaluation, count) -> (loss, metrics)``:
    the loss is a sum over the part / ``count``, the counting steps of the whole minibatch, as the rest is;
    the metrics are [B, T], or a sum and the number of its terms.
    ``draw(minibatch) -> minibatch`` adds inputs that are drawn at random, once: a pass may be repeated.
    ``refresh(batch) -> batch`` estimates advantages anew when ``recompute_advantages`` is on.
    Rows without a counting step are left out. Raises ValueError when no step counts, NonFiniteError before a
    step with a bad gradient, SamplingMismatch when the first log-ratios exceed ``log_ratio_limit``.
    """
    meter, brake, batch = Meter(), Brake(batch.mask.device), batch.cleared()
    clip_high = settings.clip if settings.clip_high is None else settings.clip_high
    parts, number, earlier = Parts(settings.micro_batch_size), 0, 0
    for epoch in range(settings.num_epochs):
        if epoch and refresh is not None and settings.recompute_advantages:
            batch = refresh(batch).cleared()
        for minibatch in batch.minibatches(settings.minibatch_size, rng):
            number += 1
            minibatch = minibatch if draw is None else draw(minibatch)
            if settings.normalise_advantages:
                advantages = statistics.standardise(minibatch.advantages, minibatch.mask)
                minibatch = dataclasses.replace(minibatch, advantages=advantages)
            count = minibatch.mask.sum()

            def gradient(part: Batch, count: Tensor = count, first: bool = number == 1) -> Tensor:
                now = model(part).within(part.mask)
                log_ratio = surrogate.log_ratio(now.logp, part.old_logp, part.mask)
                policy = policy_loss(log_ratio, part.advantages, settings)
                value = value_loss(now.values, part, settings)
                loss = policy + settings.value_weight * value - settings.entropy_weight * now.entropy
                total = statistics.masked_mean(loss, part.mask, count)
                if extra_loss is not None:
                    extra, extra_metrics = extra_loss(model, part, now, count)
                    total = total + extra
                    meter.add(part.mask, **extra_metrics)
                total.backward()
                meter.add(part.mask, policy_gradient_loss=policy, value_loss=value, entropy=now.entropy)
                if first:
                    check_first_ratios(log_ratio, log_ratio_limit)
                    meter.extreme("log_ratio_first", log_ratio.abs(), largest=True)
                kl = book_ratios(meter, log_ratio, part.mask, settings.clip, clip_high)
                return torch.stack([kl, total.detach().to(kl)])

            sums = parts.sum(minibatch, optimiser, meter, gradient)
            brake.bad = brake.bad | ~torch.isfinite(sums).all()
            if settings.target_kl is not None:
                brake.kl = brake.kl | (sums[0] / count > settings.target_kl)
            brake.step(optimiser, settings.max_grad_norm, meter)
            where = f"in minibatch {number - earlier} of epoch {epoch + 1}"
            look = functools.partial(explain, model, optimiser, batch, minibatch, where, sums)
            if brake.halted(look):
                break
        if brake.halted(look, poll=True):
            break
        earlier = number
    return {**meter.means(), **parts.metrics(), "train/minibatches": float(brake.steps)}
