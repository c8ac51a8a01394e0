"""From the actor's outputs to a distribution over actions, for sampling and for training.

An action is a row of ``num_columns`` float32 numbers: category indices, bits and Gaussian values side by
side. Noise comes from outside (uniforms for categories and bits, standard normals for Gaussian columns), so
that the compiled engine and this module draw the very same actions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from tightrope.control.spaces.structure import Component
from tightrope.maths import divergence

LOG_STD_RANGE = (-20.0, 2.0)
_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


class _Bounded(torch.autograd.Function):
    """A clamp from which there is a way back: beyond the range the gradient is cut only where a step along it
    would lead farther out.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        """x within LOG_STD_RANGE."""
        ctx.save_for_backward(x)
        return x.clamp(*LOG_STD_RANGE)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        """The gradient, 0 where it leads farther out."""
        (x,) = ctx.saved_tensors
        low, high = LOG_STD_RANGE
        farther = ((x > high) & (grad < 0)) | ((x < low) & (grad > 0))
        return torch.where(farther, 0.0, grad)


def bounded(log_std: Tensor) -> Tensor:
    """``log_std`` within LOG_STD_RANGE, with a gradient that leads back into it from outside."""
    return _Bounded.apply(log_std)


@dataclass(frozen=True)
class Distribution:
    """A joint distribution over the components of an action; log-probability and entropy are their sums.

    ``parameters`` [N, P]; ``log_std`` [d] or [N, d] for all Gaussian dimensions in order (what lies outside
    LOG_STD_RANGE acts as its nearer end), None without any;
    ``mask`` [N, L] bool over all logits, None: everything is allowed; ``half_range`` [d]: tanh-squashed onto
    bounds of this half width, None: not squashed.
    """

    components: Sequence[Component]
    parameters: Tensor
    log_std: Tensor | None = None
    mask: Tensor | None = None
    half_range: Tensor | None = None

    @cached_property
    def _bounded_log_std(self) -> Tensor:
        """Once for log-probability and entropy: the sum of their gradients tells which way a step leads."""
        assert self.log_std is not None
        return bounded(self.log_std)

    def sample(self, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Actions [N, A] made of the given noise [N, A], and their log-probabilities [N]."""
        parts = []
        for component in self.components:
            u = noise[:, component.column : component.column + component.width]
            if component.kind == "gaussian":
                mean, log_std = self._gaussian(component)
                parts.append(mean + log_std.exp() * u)
            elif component.kind == "bernoulli":
                parts.append((u < torch.sigmoid(self._logits(component))).float())
            else:
                parts.append(_inverse_cdf(self._logits(component), u[:, 0])[:, None].float())
        actions = torch.cat(parts, dim=1)
        return actions, self.logp(actions)

    def mode(self) -> Tensor:
        """The most likely action [N, A] (Gaussian: the mean, squashed or not)."""
        parts = []
        for component in self.components:
            if component.kind == "gaussian":
                parts.append(self._gaussian(component)[0])
            elif component.kind == "bernoulli":
                parts.append((self._logits(component) > 0).float())
            else:
                parts.append(self._logits(component).argmax(1, keepdim=True).float())
        return torch.cat(parts, dim=1)

    def logp(self, actions: Tensor) -> Tensor:
        """log pi(a) [N] of actions [N, A]; squashed: the density in the environment's units."""
        total = torch.zeros(len(actions), device=actions.device)
        for component in self.components:
            x = actions[:, component.column : component.column + component.width]
            if component.kind == "gaussian":
                mean, log_std = self._gaussian(component)
                z = (x - mean) * (-log_std).exp()
                total = total + (-0.5 * z.square() - log_std - _HALF_LOG_2PI).sum(1)
                if self.half_range is not None:
                    total = total - (_log_tanh_slope(x) + self._half_range(component).log()).sum(1)
            elif component.kind == "bernoulli":
                logits = self._logits(component)
                each = -functional.softplus(torch.where(x > 0.5, -logits, logits))
                total = total + torch.where(torch.isinf(logits), 0.0, each).sum(1)
            else:
                logp = torch.log_softmax(self._logits(component), dim=1)
                total = total + logp.gather(1, x.long())[:, 0]
        return total

    def entropy(self) -> Tensor:
        """Entropy [N] in nats; of a squashed Gaussian by 16-point Gauss-Hermite quadrature per dimension."""
        total = torch.zeros(len(self.parameters), device=self.parameters.device)
        for component in self.components:
            if component.kind == "gaussian":
                mean, log_std = self._gaussian(component)
                each = divergence.gaussian_entropy(log_std[..., None]).expand_as(mean)
                if self.half_range is not None:
                    slope = _expected_log_tanh_slope(mean, log_std)
                    each = each + slope + self._half_range(component).log()
                total = total + each.sum(1)
            elif component.kind == "bernoulli":
                total = total + divergence.bernoulli_entropy(self._logits(component))
            else:
                total = total + divergence.categorical_entropy(self._logits(component))
        return total

    def _logits(self, component: Component) -> Tensor:
        logits = self.parameters[:, component.parameter : component.parameter + component.count]
        if self.mask is None:
            return logits
        allowed = self.mask[:, component.mask : component.mask + component.count]
        return torch.where(allowed, logits, -torch.inf)

    def _gaussian(self, component: Component) -> tuple[Tensor, Tensor]:
        mean = self.parameters[:, component.parameter : component.parameter + component.count]
        start = component.deviation
        return mean, self._bounded_log_std[..., start : start + component.count]

    def _half_range(self, component: Component) -> Tensor:
        assert self.half_range is not None
        start = component.deviation
        return self.half_range[start : start + component.count]


def _inverse_cdf(logits: Tensor, u: Tensor) -> Tensor:
    """The smallest k with P(K <= k) > u; the last allowed k where rounding leaves the sum below u."""
    probabilities = torch.softmax(logits, dim=1)
    index = (probabilities.cumsum(1) <= u[:, None]).sum(1)
    last = logits.shape[1] - 1 - (probabilities.flip(1) > 0).int().argmax(1)
    return torch.minimum(index, last)


def _log_tanh_slope(u: Tensor) -> Tensor:
    """log(1 - tanh(u)^2), stable for large |u|: 2 (log 2 - u - softplus(-2u))."""
    return 2.0 * (math.log(2.0) - u - functional.softplus(-2.0 * u))


def _expected_log_tanh_slope(mean: Tensor, log_std: Tensor) -> Tensor:
    """E[log(1 - tanh(u)^2)] for u ~ N(mean, std^2), by Gauss-Hermite quadrature; same shape as mean."""
    nodes, weights = _hermite(mean.device)
    u = mean[..., None] + log_std.exp().expand_as(mean)[..., None] * nodes
    return (_log_tanh_slope(u) * weights).sum(-1)


def _hermite(device: torch.device) -> tuple[Tensor, Tensor]:
    nodes, weights = np.polynomial.hermite_e.hermegauss(16)
    pair = torch.as_tensor(np.stack([nodes, weights / weights.sum()]), dtype=torch.float32, device=device)
    return pair[0], pair[1]
