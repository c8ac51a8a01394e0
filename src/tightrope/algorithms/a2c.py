"""Synchronous advantage actor-critic: one step on the whole rollout along the plain policy gradient.

    L = E[ -A log pi(a|s) ] + value_weight * L_value - entropy_weight * H   (Mnih et al. 2016)

Read beside ppo.py: epochs, minibatches, the clip and the KL stop are what it leaves out.
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
from tightrope.algorithms.settings import A2CSettings
from tightrope.maths import statistics, surrogate, values

Model = Callable[[Batch], Evaluation]
ExtraLoss = Callable[[Model, Batch, Evaluation, Tensor], tuple[Tensor, dict[str, Any]]]


def update(
    model: Model,
    optimiser: torch.optim.Optimizer,
    batch: Batch,
    settings: A2CSettings,
    rng: np.random.Generator,
    *,
    extra_loss: ExtraLoss | None = None,
    draw: Callable[[Batch], Batch] | None = None,
    refresh: Callable[[Batch], Batch] | None = None,
    log_ratio_limit: float | None = None,
) -> dict[str, float]:
    """Improve ``model`` on one rollout by one step; returns the metrics.

    ``model(batch) -> Evaluation``. ``extra_loss(model, part, evaluation, count) -> (loss, metrics)``:
    the loss is a sum over the part / ``count``, the counting steps of the whole batch, as the rest is; the
    metrics are [B, T], or a sum and the number of its terms.
    ``draw(batch) -> batch`` adds inputs that are drawn at random, once: a pass may be repeated.
    ``rng`` and ``refresh`` are not needed: there is one pass, in the order of the rollout.
    Rows without a counting step are left out. Raises ValueError when no step counts, NonFiniteError before a
    step with a bad gradient, SamplingMismatch when the log-ratios exceed ``log_ratio_limit``.
    """
    meter, brake, batch = Meter(), Brake(batch.mask.device), batch.cleared()
    batch = batch if draw is None else draw(batch)
    if settings.normalise_advantages:
        advantages = statistics.standardise(batch.advantages, batch.mask)
        batch = dataclasses.replace(batch, advantages=advantages)
    count = batch.mask.sum()

    def gradient(part: Batch) -> Tensor:
        now = model(part).within(part.mask)
        log_ratio = surrogate.log_ratio(now.logp, part.old_logp, part.mask)
        policy = surrogate.policy_gradient(now.logp, part.advantages)
        value = values.squared_error(now.values, part.returns)
        loss = policy + settings.value_weight * value - settings.entropy_weight * now.entropy
        total = statistics.masked_mean(loss, part.mask, count)
        if extra_loss is not None:
            extra, extra_metrics = extra_loss(model, part, now, count)
            total = total + extra
            meter.add(part.mask, **extra_metrics)
        total.backward()
        meter.add(part.mask, policy_gradient_loss=policy, value_loss=value, entropy=now.entropy)
        check_first_ratios(log_ratio, log_ratio_limit)
        meter.extreme("log_ratio_first", log_ratio.abs(), largest=True)
        kl = book_ratios(meter, log_ratio, part.mask, torch.inf, torch.inf)
        return torch.stack([kl, total.detach().to(kl)])

    parts = Parts(settings.micro_batch_size)
    sums = parts.sum(batch, optimiser, meter, gradient)
    brake.bad = brake.bad | ~torch.isfinite(sums).all()
    brake.step(optimiser, settings.max_grad_norm, meter)
    look = functools.partial(explain, model, optimiser, batch, batch, "in this update", sums)
    brake.halted(look, poll=True)
    return {**meter.means(), **parts.metrics(), "train/minibatches": float(brake.steps)}
