"""Synchronous advantage actor-critic: one step on the whole rollout along the plain policy gradient.

    L = E[ -A log pi(a|s) ] + value_weight * L_value - entropy_weight * H   (Mnih et al. 2016)

Read beside ppo.py: epochs, minibatches, the clip and the KL stop are what it leaves out.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from tightrope.algorithms.batch import Batch, Evaluation
from tightrope.algorithms.descent import Descent, Draw, ExtraLoss, Model, Terms
from tightrope.algorithms.settings import A2CSettings
from tightrope.maths import surrogate, values


def update(
    model: Model,
    optimiser: torch.optim.Optimizer,
    batch: Batch,
    settings: A2CSettings,
    rng: np.random.Generator,
    *,
    extra_loss: ExtraLoss | None = None,
    draw: Draw | None = None,
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
    batch = batch.cleared()
    descent = Descent(
        model, optimiser, settings, batch,
        extra_loss=extra_loss, draw=draw, log_ratio_limit=log_ratio_limit,
    )  # fmt: skip

    def loss(now: Evaluation, log_ratio: Tensor, part: Batch) -> Terms:
        policy = surrogate.policy_gradient(now.logp, part.advantages)
        value = values.squared_error(now.values, part.returns)
        total = policy + settings.value_weight * value - settings.entropy_weight * now.entropy
        return Terms(policy, value, total)

    descent.step(batch, batch, loss, "in this update")
    return descent.metrics()
