"""The step that every update rule takes on a minibatch: forward, loss, backward, checks, one step of Adam.

A rule gives its loss per step; everything here is the same for all of them. A gradient that does not fit into
memory is computed in parts, which stays the same gradient.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from tightrope.algorithms.batch import Batch, Evaluation
from tightrope.algorithms.nonfinite import REFUSED, NonFiniteError, explain
from tightrope.algorithms.settings import UpdateSettings
from tightrope.errors import TightropeError
from tightrope.maths import divergence, statistics, surrogate

_T = TypeVar("_T")
Model = Callable[[Batch], Evaluation]
ExtraLoss = Callable[[Model, Batch, Evaluation, Tensor], tuple[Tensor, dict[str, Any]]]
Draw = Callable[[Batch], Batch]


class Terms(NamedTuple):
    """The loss of each step, [B, T], to be minimised, and two of its parts as the metrics show them."""

    policy: Tensor
    value: Tensor
    loss: Tensor


Loss = Callable[[Evaluation, Tensor, Batch], Terms]  # (evaluation, log_ratio [B, T], part of the minibatch)


class SamplingMismatch(TightropeError, RuntimeError):
    """The probabilities that trained are not the probabilities that sampled."""


class Descent:
    """The steps of one update, and its metrics.

    ``clip`` and ``clip_high``: a ratio beyond these counts as clipped in the metrics. The last three
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
        self.checked = CheckedSteps(batch.mask.device)
        self.micro_batches = MicroBatches(settings.micro_batch_size)
        self.first = True
        self._explain: Callable[[], str] | None = None

    def step(
        self,
        batch: Batch,
        minibatch: Batch,
        loss: Loss,
        where: str,
        target_kl: float | None = None,
        *,
        new_epoch: bool = False,
    ) -> bool:
        """Take one step on the mean of ``loss``; True when the update has to stop.

        ``new_epoch``: a pass over the batch begins; `approx_kl` is a mean over the last one. The KL of the
        minibatch is compared with ``target_kl`` before the step. ``where`` names the minibatch
        of ``batch`` in errors. Raises NonFiniteError before a step with a bad gradient.
        """
        if new_epoch:
            self.meter.forget("approx_kl")
        minibatch = minibatch if self.draw is None else self.draw(minibatch)
        if self.settings.normalise_advantages:
            advantages = statistics.standardise(minibatch.advantages, minibatch.mask)
            minibatch = dataclasses.replace(minibatch, advantages=advantages)
        count, before = minibatch.mask.sum(), self.meter

        def attempt(size: int | None) -> Any:
            self.meter = before.copy()
            self.optimiser.zero_grad(set_to_none=True)
            return sum(self._gradient(loss, count, part) for part in minibatch.split(size))

        sums = self.micro_batches.compute(len(minibatch.mask), attempt, self.optimiser)
        self.first = False
        too_far = None if target_kl is None else sums[0] / count > target_kl
        norm = self.checked.take(self.optimiser, self.settings.max_grad_norm, sums, too_far)
        self.meter.add_sum("grad_norm", norm, 1.0)
        self._explain = functools.partial(explain, self.model, self.optimiser, batch, minibatch, where, sums)
        return self.checked.halted(self._explain)

    def _gradient(self, loss: Loss, count: Tensor, part: Batch) -> Tensor:
        """Add the gradient of one part of a minibatch with ``count`` counting steps; the KL and the loss."""
        now = self.model(part)
        # what a model computes for padding must reach no gradient; a subclass may have more numbers
        clean = {name: torch.where(part.mask, x, 0.0) for name, x in vars(now).items()}
        now = dataclasses.replace(now, **clean)
        log_ratio = surrogate.log_ratio(now.logp, part.old_logp, part.mask)
        terms = loss(now, log_ratio, part)
        total = statistics.masked_mean(terms.loss, part.mask, count)
        if self.extra_loss is not None:
            extra, extra_metrics = self.extra_loss(self.model, part, now, count)
            total = total + extra
            self.meter.add(part.mask, **extra_metrics)
        total.backward()
        log_ratio = log_ratio.detach()
        if self.first:
            check_first_ratios(log_ratio, self.log_ratio_limit)
            self.meter.extreme("log_ratio_first", log_ratio.abs(), largest=True)
        kl = self._measure(now, terms, log_ratio, part.mask)
        return torch.stack([kl, total.detach().to(kl)])

    def _measure(self, now: Evaluation, terms: Terms, log_ratio: Tensor, mask: Tensor) -> Tensor:
        """Add the metrics of one part; returns the sum of k3 over its counting steps."""
        high, low = surrogate.clipped(log_ratio, self.clip, self.clip_high)
        sums = self.meter.add(
            mask, policy_gradient_loss=terms.policy, value_loss=terms.value, entropy=now.entropy,
            approx_kl=divergence.k3(log_ratio), clip_fraction=high | low,
            clip_fraction_high=high, clip_fraction_low=low,
        )  # fmt: skip
        ratio = log_ratio.exp()
        # a masked step has the ratio 1, which is no ratio of the update
        self.meter.extreme("ratio_min", torch.where(mask, ratio, torch.inf), largest=False)
        self.meter.extreme("ratio_max", torch.where(mask, ratio, 0.0), largest=True)
        return sums["approx_kl"]

    @torch.no_grad()
    def measure_after(self, batch: Batch, size: int) -> None:
        """Add the metric kl_after: k3 of the batch under the model as it is now; ``size`` rows a pass."""
        for part in batch.split(min(size, self.micro_batches.size or size)):
            log_ratio = surrogate.log_ratio(self.model(part).logp, part.old_logp, part.mask)
            self.meter.add(part.mask, kl_after=divergence.k3(log_ratio))

    def halted(self) -> bool:
        """Whether to stop, waiting for an accelerator; NonFiniteError when the last gradient was bad."""
        return self.checked.halted(self._explain, poll=True)

    def metrics(self) -> dict[str, float]:
        """Means over every minibatch, of approx_kl over those of the last epoch. NonFiniteError when the last
        gradient was bad.
        """
        self.halted()
        return {
            **self.meter.means(),
            **self.micro_batches.metrics(),
            "train/minibatches": float(self.checked.count),
        }


def check_first_ratios(log_ratio: Tensor, limit: float | None) -> None:
    """Before the first step of an update every ratio must be 1: what is sampled is what is trained.

    Raises SamplingMismatch when max |log_ratio| is above ``limit`` (None: not checked).
    """
    if limit is None:
        return
    worst = float(log_ratio.abs().max())
    if math.isfinite(worst) and worst > limit:  # the check before the step names other numbers
        raise SamplingMismatch(
            f"Before the first step of an update the log-probabilities differ by {worst:.3g} from those that "
            f"sampled (limit {limit:g}). Sampling and training disagree. Likely causes: dropout or batch "
            "normalisation left on in the policy, a normaliser that moved between rollout and update, "
            "another temperature or action mask in training."
        )


@dataclass
class Meter:
    """Sums over every minibatch of an update, divided once at the end; nothing is read from the device
    before.
    """

    sums: dict[str, Tensor] = field(default_factory=dict)
    counts: dict[str, Tensor | float] = field(default_factory=dict)
    extremes: dict[str, Tensor] = field(default_factory=dict)

    def copy(self) -> Meter:
        """Another meter with the same sums."""
        return Meter(dict(self.sums), dict(self.counts), dict(self.extremes))

    def forget(self, name: str) -> None:
        """Begin the sum of this name again."""
        self.sums.pop(f"train/{name}", None)
        self.counts.pop(f"train/{name}", None)

    def add(self, mask: Tensor, **per_step: Tensor | tuple[Tensor, float]) -> dict[str, Tensor]:
        """Add [B, T] quantities, and return their sums; steps outside the mask do not count. A pair is a sum
        over other things than steps, and their number.
        """
        added: dict[str, Tensor] = {}
        count: Tensor | float
        for name, x in per_step.items():
            if isinstance(x, tuple):
                added[name], count = x[0].detach().float(), x[1]
            else:
                added[name], count = statistics.masked_sum(x.detach().float(), mask), mask.sum()
            self.add_sum(name, added[name], count)
        return added

    def add_sum(self, name: str, total: Tensor, count: Tensor | float) -> None:
        """Add a sum and the number of things summed."""
        key = f"train/{name}"
        self.sums[key] = self.sums.get(key, 0) + total
        self.counts[key] = self.counts.get(key, 0) + count

    def extreme(self, name: str, x: Tensor, *, largest: bool) -> None:
        """Keep the smallest or the largest element."""
        key, pick = f"train/{name}", torch.maximum if largest else torch.minimum
        x = x.detach().float()
        x = x.max() if largest else x.min()
        self.extremes[key] = pick(self.extremes[key], x) if key in self.extremes else x

    def means(self) -> dict[str, float]:
        """One read of the device: the mean of every sum, and the extremes."""
        values = {**{key: total / self.counts[key] for key, total in self.sums.items()}, **self.extremes}
        wide = [torch.as_tensor(x, dtype=torch.float64, device="cpu") for x in values.values()]
        return dict(zip(values, torch.stack(wide).tolist(), strict=True)) if wide else {}


class CheckedSteps:
    """Decides on the device, before a step, whether it may be taken. A step that is refused ends the update.

    A fused Adam skips a refused step by itself (its ``found_inf``), so the host need not wait for an
    accelerator; it reads the decision when it polls. ``count``: steps that were taken.
    """

    def __init__(self, device: torch.device) -> None:
        self._stopped = torch.zeros((), dtype=torch.bool, device=device)
        self._bad = torch.zeros((), dtype=torch.bool, device=device)
        self.count = torch.zeros((), dtype=torch.int64, device=device)
        self._lazy = device.type == "cuda"

    def take(
        self,
        optimiser: torch.optim.Optimizer,
        max_grad_norm: float | None,
        loss: Tensor,
        too_far: Tensor | None = None,
    ) -> Tensor:
        """Clip by one joint norm over all parameters and take the step; returns the norm before.

        The step is refused when ``loss``, the norm or a weight is not finite. ``too_far``, a bool on the
        device, stops before the step: the KL is above its limit.
        """
        parameters = [p for group in optimiser.param_groups for p in group["params"] if p.grad is not None]
        norm = nn.utils.get_total_norm([p.grad for p in parameters if p.grad is not None])
        # infinite weights too: behind a saturated unit their gradient is 0
        largest = nn.utils.get_total_norm([p.detach() for p in parameters], norm_type=math.inf)
        self._bad = self._bad | ~(torch.isfinite(norm) & torch.isfinite(largest) & torch.isfinite(loss).all())
        if too_far is not None:
            self._stopped = self._stopped | too_far
        if max_grad_norm is not None:
            scale = torch.where(self._bad, 0.0, norm)  # 0: a bad gradient stays as it is, to be explained
            nn.utils.clip_grads_with_norm_(parameters, max_grad_norm, scale)
        halted = self._stopped | self._bad
        self.count += ~halted
        fused = all(group.get("fused") for group in optimiser.param_groups)
        if self._lazy and fused:
            optimiser.found_inf = halted.float()  # type: ignore[attr-defined]
            optimiser.step()
        elif not bool(halted):
            optimiser.step()
        return norm.detach()

    def halted(self, explain: Callable[[], str] | None = None, *, poll: bool = False) -> bool:
        """Whether to stop; raises NonFiniteError for a bad gradient, with the text of ``explain``.

        Waits for an accelerator only when polled.
        """
        if self._lazy and not poll:
            return False
        if bool(self._bad):
            raise NonFiniteError(explain() if explain else f"The gradient holds a NaN; {REFUSED}")
        return bool(self._stopped)


SIGNS = ("out of memory", "not enough memory", "defaultcpuallocator")  # in the texts of torch's RuntimeErrors


class OutOfMemory(TightropeError, RuntimeError):
    """Memory is not enough even for the smallest part; the message says which setting makes it smaller."""


def is_out_of_memory(error: BaseException) -> bool:
    """Whether torch, on any device, or Python could not get the memory it asked for."""
    if isinstance(error, torch.OutOfMemoryError | MemoryError):
        return True
    return isinstance(error, RuntimeError) and any(sign in str(error).lower() for sign in SIGNS)


def free() -> None:
    """Free the memory of a GPU that torch holds but does not use."""
    if torch.cuda.is_available():
        torch.cuda.empty_cache()


def _random_state() -> Callable[[], None]:
    """A function that restores the present state of torch's generators, CPU and CUDA."""
    cpu = torch.get_rng_state()
    cuda = torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else []

    def put_back() -> None:
        torch.set_rng_state(cpu)
        for index, state in enumerate(cuda):
            torch.cuda.set_rng_state(state, index)

    return put_back


@dataclass
class MicroBatches:
    """How many rows a gradient is computed on at a time: ``size``, None: all of them.

    ``halvings`` counts how often memory was not enough.
    """

    size: int | None
    halvings: int = 0

    def compute(self, rows: int, attempt: Callable[[int | None], _T], optimiser: torch.optim.Optimizer) -> _T:
        """Return ``attempt(size)``, which computes a gradient over ``rows`` rows, ``size`` at a time.

        When memory runs out, the attempt is repeated at half the size with the same random numbers of torch.
        It must reset everything else that it changes: draw and count outside of it. OutOfMemory when a single
        row is too much.
        """
        start_over = _random_state()
        while True:
            try:
                return attempt(self.size)
            except (RuntimeError, MemoryError) as error:
                if not is_out_of_memory(error):
                    raise
                now = min(self.size or rows, rows)
                if now == 1:
                    raise OutOfMemory(_advice(error)) from error
            # outside the except clause, which keeps the failed pass's tensors alive
            optimiser.zero_grad(set_to_none=True)
            self.size, self.halvings = (now + 1) // 2, self.halvings + 1
            free()
            start_over()

    def metrics(self) -> dict[str, float]:
        """The present size and how often it was halved; nothing while memory was enough."""
        if not self.halvings:
            return {}
        return {
            "train/micro_batch_size": float(self.size or 0),
            "train/memory_halvings": float(self.halvings),
        }


def _advice(error: BaseException) -> str:
    reason = (str(error).splitlines() or [""])[0][:200]
    return (
        f"Memory is not enough for the gradient of a single row ({reason}). The step was not taken. Use a "
        "smaller model or less of it (language: --tune lora, --lora-layers, --gradient-checkpointing, fewer "
        "--max-new-tokens and --max-prompt-tokens; control: smaller --hidden), or a device with more memory."
    )
