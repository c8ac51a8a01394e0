"""The step that every update rule takes on a minibatch: forward, loss, backward, checks, one step of Adam.

A rule gives its loss per step; what is here is the same for all of them.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tightrope.algorithms.batch import Batch, Evaluation
from tightrope.algorithms.memory import Parts
from tightrope.algorithms.nonfinite import explain
from tightrope.algorithms.optimise import Meter, StepGuard, check_first_ratios, record_ratios
from tightrope.algorithms.settings import UpdateSettings
from tightrope.maths import statistics, surrogate

Model = Callable[[Batch], Evaluation]
ExtraLoss = Callable[[Model, Batch, Evaluation, Tensor], tuple[Tensor, dict[str, Any]]]
Draw = Callable[[Batch], Batch]


class Terms(NamedTuple):
    """The loss of each step, [B, T], to be minimised, and two of its parts as the metrics show them."""

    policy: Tensor
    value: Tensor
    loss: Tensor


Loss = Callable[[Evaluation, Tensor, Batch], Terms]  # (evaluation, log_ratio [B, T], part of the minibatch)


class Descent:
    """The steps of one update, and its metrics.

    ``clip`` and ``clip_high``: beyond these a ratio counts as clipped in the metrics. The last three
    arguments are those of ``update``.
    """

    def __init__(
        self,
        model: Model,
        optimiser: torch.optim.Optimizer,
        settings: UpdateSettings,
        batch: Batch,
        *,
        clip: float = torch.inf,
        clip_high: float = torch.inf,
        extra_loss: ExtraLoss | None = None,
        draw: Draw | None = None,
        log_ratio_limit: float | None = None,
    ) -> None:
        self.model = model
        self.optimiser = optimiser
        self.settings = settings
        self.clip = clip
        self.clip_high = clip_high
        self.extra_loss = extra_loss
        self.draw = draw
        self.log_ratio_limit = log_ratio_limit
        self.meter = Meter()
        self.guard = StepGuard(batch.mask.device)
        self.memory = Parts(settings.micro_batch_size)
        self.first = True
        self._explain: Callable[[], str] | None = None

    def step(
        self, batch: Batch, minibatch: Batch, loss: Loss, where: str, target_kl: float | None = None
    ) -> bool:
        """Take one step on the mean of ``loss``; True when the update has to stop.

        The KL of the minibatch is compared with ``target_kl`` before the step. ``where`` names the minibatch
        of ``batch`` in errors. Raises NonFiniteError before a step with a bad gradient.
        """
        minibatch = minibatch if self.draw is None else self.draw(minibatch)
        if self.settings.normalise_advantages:
            advantages = statistics.standardise(minibatch.advantages, minibatch.mask)
            minibatch = dataclasses.replace(minibatch, advantages=advantages)
        count = minibatch.mask.sum()
        gradient = functools.partial(self._gradient, loss, count)
        sums = self.memory.sum(minibatch, self.optimiser, self.meter, gradient)
        self.first = False
        self.guard.refuse(~torch.isfinite(sums).all())
        if target_kl is not None:
            self.guard.stop(sums[0] / count > target_kl)
        self.guard.step(self.optimiser, self.settings.max_grad_norm, self.meter)
        self._explain = functools.partial(explain, self.model, self.optimiser, batch, minibatch, where, sums)
        return self.guard.halted(self._explain)

    def _gradient(self, loss: Loss, count: Tensor, part: Batch) -> Tensor:
        """Add the gradient of one part of a minibatch with ``count`` counting steps; the KL and the loss."""
        now = self.model(part).within(part.mask)
        log_ratio = surrogate.log_ratio(now.logp, part.old_logp, part.mask)
        terms = loss(now, log_ratio, part)
        total = statistics.masked_mean(terms.loss, part.mask, count)
        if self.extra_loss is not None:
            extra, extra_metrics = self.extra_loss(self.model, part, now, count)
            total = total + extra
            self.meter.add(part.mask, **extra_metrics)
        total.backward()
        self.meter.add(
            part.mask, policy_gradient_loss=terms.policy, value_loss=terms.value, entropy=now.entropy
        )
        if self.first:
            check_first_ratios(log_ratio, self.log_ratio_limit)
            self.meter.extreme("log_ratio_first", log_ratio.abs(), largest=True)
        kl = record_ratios(self.meter, log_ratio, part.mask, self.clip, self.clip_high)
        return torch.stack([kl, total.detach().to(kl)])

    def halted(self) -> bool:
        """Whether to stop, waiting for an accelerator; NonFiniteError when the last gradient was bad."""
        return self.guard.halted(self._explain, poll=True)

    def metrics(self) -> dict[str, float]:
        """Means over every minibatch."""
        return {
            **self.meter.means(),
            **self.memory.metrics(),
            "train/minibatches": float(self.guard.steps),
        }
