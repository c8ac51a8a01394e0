"""What all update rules do alike: build Adam, take a checked step, and keep sums over every
minibatch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn

from tightrope.algorithms.nonfinite import REFUSED, NonFiniteError
from tightrope.algorithms.settings import UpdateSettings
from tightrope.errors import TightropeError
from tightrope.maths import divergence, statistics, surrogate


class SamplingMismatch(TightropeError, RuntimeError):
    """The probabilities that trained are not the probabilities that sampled."""


def _bare(name: str) -> Any:
    """Adam's own method without the decorators of torch's compiler.

    Calling a decorated one imports the whole compiler: 70 MB and more than a second, for nothing here.
    """
    method = getattr(torch.optim.Adam, name)
    return getattr(method, "__wrapped__", method)


class Adam(torch.optim.Adam):
    """torch's Adam, its mathematics and its state; only the way in is lighter."""

    add_param_group = _bare("add_param_group")
    load_state_dict = _bare("load_state_dict")
    state_dict = _bare("state_dict")
    zero_grad = _bare("zero_grad")
    step = torch.no_grad()(_bare("step"))


def make_optimiser(
    parameters: Iterable[nn.Parameter], critic: Iterable[nn.Parameter], settings: UpdateSettings
) -> Adam:
    """Adam with two groups, ``actor`` (everything else) and ``critic``, each with its own learning rate."""
    critic = list(critic)
    ids = {id(p) for p in critic}
    groups = [
        {"params": [p for p in parameters if id(p) not in ids], "lr": settings.learning_rate},
        {"params": critic, "lr": settings.critic_learning_rate or settings.learning_rate},
    ]
    groups = [group for group in groups if group["params"]]
    return Adam(groups, eps=settings.adam_eps, fused=True)


def set_learning_rates(optimiser: torch.optim.Optimizer, settings: UpdateSettings) -> None:
    """Put the present learning rates into the optimiser's groups (first actor, then critic)."""
    critic = settings.critic_learning_rate
    rates = [settings.learning_rate, settings.learning_rate if critic is None else critic]
    for group, rate in zip(optimiser.param_groups, rates, strict=False):
        group["lr"] = rate


def optimiser_tensors(optimiser: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Adam's moments and step counts, named ``<index of the parameter>.<what>``."""
    state = optimiser.state_dict()["state"]
    return {f"{index}.{name}": x for index, entry in state.items() for name, x in entry.items()}


def restore_optimiser(optimiser: torch.optim.Optimizer, tensors: dict[str, Tensor]) -> None:
    """Adam's moments, copied in place where they exist: the compiled engine may hold views of them. Raises
    ValueError for those of other parameters.
    """
    parameters = [p for group in optimiser.param_groups for p in group["params"]]
    for name, saved in tensors.items():
        index, kind = name.split(".", 1)
        parameter = parameters[int(index)]
        if saved.shape != (() if kind == "step" else parameter.shape):
            raise ValueError(f"{name} of the optimiser has shape {tuple(saved.shape)}")
        entry = optimiser.state[parameter]
        if kind in entry:
            entry[kind].copy_(saved)
        else:
            entry[kind] = saved.to(parameter.device).clone()


class Meter:
    """Sums over every minibatch of an update, divided once at the end; nothing is read from the device
    before.
    """

    def __init__(self) -> None:
        self._sums: dict[str, Tensor] = {}
        self._counts: dict[str, Tensor | float] = {}
        self._extremes: dict[str, Tensor] = {}

    def add(self, mask: Tensor, **per_step: Tensor | tuple[Tensor, float]) -> None:
        """Add [B, T] quantities; steps outside the mask do not count. A pair is a sum over other things than
        steps, and their number.
        """
        for name, x in per_step.items():
            if isinstance(x, tuple):
                self.add_sum(name, x[0].detach().float(), x[1])
            else:
                self.add_sum(name, statistics.masked_sum(x.detach().float(), mask), mask.sum())

    def add_sum(self, name: str, total: Tensor, count: Tensor | float) -> None:
        """Add a sum and the number of things summed."""
        key = f"train/{name}"
        self._sums[key] = self._sums.get(key, 0) + total
        self._counts[key] = self._counts.get(key, 0) + count

    def extreme(self, name: str, x: Tensor, *, largest: bool) -> None:
        """Keep the smallest or the largest element seen."""
        key, pick = f"train/{name}", torch.maximum if largest else torch.minimum
        x = x.detach().float()
        x = x.max() if largest else x.min()
        self._extremes[key] = pick(self._extremes[key], x) if key in self._extremes else x

    def snapshot(self) -> tuple[dict[str, Any], ...]:
        """All sums as they stand, to go back to with `restore`."""
        return tuple(dict(x) for x in (self._sums, self._counts, self._extremes))

    def restore(self, snapshot: tuple[dict[str, Any], ...]) -> None:
        """Forget what was added since ``snapshot`` was taken."""
        self._sums, self._counts, self._extremes = (dict(x) for x in snapshot)

    def means(self) -> dict[str, float]:
        """One read of the device: the mean of every sum, and the extremes."""
        names = [*self._sums, *self._extremes]
        values = [self._sums[k] / self._counts[k] for k in self._sums] + list(self._extremes.values())
        values = [torch.as_tensor(v, dtype=torch.float64, device="cpu") for v in values]
        return dict(zip(names, torch.stack(values).tolist(), strict=True)) if names else {}


def record_ratios(meter: Meter, log_ratio: Tensor, mask: Tensor, clip: float, clip_high: float) -> Tensor:
    """Record how far the ratios are from 1; returns the sum of k3 over the counting steps."""
    high = surrogate.clipped_high(log_ratio, clip_high) & mask
    low = surrogate.clipped_low(log_ratio, clip) & mask
    kl = divergence.k3(log_ratio).detach()
    meter.add(mask, approx_kl=kl, clip_fraction=high | low, clip_fraction_high=high, clip_fraction_low=low)
    ratio = log_ratio.detach().exp()
    # a masked step has the ratio 1, which is no ratio of the update
    meter.extreme("ratio_min", torch.where(mask, ratio, torch.inf), largest=False)
    meter.extreme("ratio_max", torch.where(mask, ratio, 0.0), largest=True)
    return statistics.masked_sum(kl, mask)


class StepGuard:
    """Decides on the device, before a step, whether it may be taken. A step that is refused ends the update.

    A fused Adam skips a refused step by itself (its ``found_inf``), so an accelerator need not be waited for;
    the host reads the decision when it polls.
    """

    def __init__(self, device: torch.device) -> None:
        self._stopped = torch.zeros((), dtype=torch.bool, device=device)
        self._bad = torch.zeros((), dtype=torch.bool, device=device)
        self.steps = torch.zeros((), dtype=torch.int64, device=device)
        self._lazy = device.type == "cuda"

    def refuse(self, bad: Tensor) -> None:
        """Refuse the step when ``bad``, a bool on the device, is True: the loss is not finite."""
        self._bad = self._bad | bad

    def stop(self, enough: Tensor) -> None:
        """Stop before the step when ``enough``, a bool on the device, is True: the KL is above its limit."""
        self._stopped = self._stopped | enough

    def step(self, optimiser: torch.optim.Optimizer, max_grad_norm: float | None, meter: Meter) -> None:
        """Clip by one joint norm over all parameters and take the step, unless it is refused."""
        parameters = [p for group in optimiser.param_groups for p in group["params"] if p.grad is not None]
        norm = nn.utils.get_total_norm([p.grad for p in parameters if p.grad is not None])
        # infinite weights too: behind a saturated unit their gradient is 0
        largest = nn.utils.get_total_norm([p.detach() for p in parameters], norm_type=math.inf)
        self._bad = self._bad | ~(torch.isfinite(norm) & torch.isfinite(largest))
        if max_grad_norm is not None:
            scale = torch.where(self._bad, 0.0, norm)  # 0: a bad gradient stays as it is, to be explained
            nn.utils.clip_grads_with_norm_(parameters, max_grad_norm, scale)
        halted = self._stopped | self._bad
        self.steps += ~halted
        fused = all(group.get("fused") for group in optimiser.param_groups)
        if self._lazy and fused:
            optimiser.found_inf = halted.float()  # type: ignore[attr-defined]
            optimiser.step()
        elif not bool(halted):
            optimiser.step()
        meter.add_sum("grad_norm", norm.detach(), 1.0)

    def halted(self, explain: Callable[[], str] | None = None, *, poll: bool = False) -> bool:
        """Whether to stop; raises NonFiniteError for a bad gradient, with the text of ``explain``.

        Waits for an accelerator only when polled.
        """
        if self._lazy and not poll:
            return False
        if bool(self._bad):
            raise NonFiniteError(explain() if explain else f"The gradient holds a NaN; {REFUSED}")
        return bool(self._stopped)


def check_first_ratios(log_ratio: Tensor, limit: float | None) -> None:
    """Before the first step every ratio must be 1: what is sampled is what is trained.

    Raises SamplingMismatch when max |log_ratio| is above ``limit`` (None: not checked).
    """
    if limit is None:
        return
    worst = float(log_ratio.detach().abs().max())
    if math.isfinite(worst) and worst > limit:  # what is not finite is named before the step
        raise SamplingMismatch(
            f"Before any update the log-probabilities differ by {worst:.3g} from those that sampled (limit "
            f"{limit:g}). Sampling and training disagree. Likely causes: dropout or batch normalisation left "
            "on in the policy, a normaliser that moved between rollout and update, another temperature or "
            "action mask in training."
        )
