"""REINFORCE: one step on the whole rollout along the policy gradient of Monte Carlo returns.

    L = E[ -(G - b) log pi(a|s) ] - entropy_weight * H;  G = sum_k gamma^k r_{t+k}   (Williams 1992)

With a baseline, b = V(s) is learned beside it and cut episodes are continued by V; without, b = 0 and the
steps of episodes that do not finish inside the rollout are masked. Read beside a2c.py: lambda is 1, no more.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from tightrope.algorithms.batch import Batch, Evaluation
from tightrope.algorithms.descent import Descent, Draw, ExtraLoss, Model, Terms
from tightrope.algorithms.settings import ReinforceSettings
from tightrope.maths import surrogate, values


def update(
    model: Model,
    optimiser: torch.optim.Optimizer,
    batch: Batch,
    settings: ReinforceSettings,
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
        total = policy - settings.entropy_weight * now.entropy
        if settings.baseline:
            total = total + settings.value_weight * value
        return Terms(policy, value, total)

    descent.step(batch, batch, loss, "in this update")
    return descent.metrics()
