"""Entropies and divergences, in nats.

k1, k2, k3 estimate KL(old || new) from steps sampled by the OLD policy, with log_ratio = log(new / old) at
the sampled action: [B, T] in, [B, T] out. Source: Schulman, http://joschu.net/blog/kl-approx.html

Entropies take the parameters of distributions, [..., d] in and [...] out: only the action axis, the last one,
is summed. A masked choice has the logit -inf; it adds 0 to every sum, without NaN in value or gradient.
"""

from math import log, pi

import torch
from torch import Tensor
from torch.nn.functional import softplus


def k1(log_ratio: Tensor) -> Tensor:
    """-log r: unbiased, of high variance, negative for half of the steps."""
    return -log_ratio


def k2(log_ratio: Tensor) -> Tensor:
    """0.5 (log r)^2: biased, of low variance, never negative."""
    return 0.5 * log_ratio.square()


def k3(log_ratio: Tensor) -> Tensor:
    """r - 1 - log r: unbiased, of low variance, never negative but for rounding."""
    # expm1 keeps the digits that exp(x) - 1 loses near r = 1
    return log_ratio.expm1() - log_ratio


def categorical_entropy(logits: Tensor) -> Tensor:
    """H = -sum_k p_k log p_k with p = softmax(logits), [..., K] -> [...]."""
    logp = logits.log_softmax(-1)
    # where comes before the product: 0 * -inf is NaN, in the value and in the gradient
    finite_logp = torch.where(logits == -torch.inf, 0.0, logp)
    return -(logp.exp() * finite_logp).sum(-1)


def gaussian_entropy(log_std: Tensor) -> Tensor:
    """H = sum_i (log std_i + 0.5 log(2 pi e)) of independent Gaussians, [..., d] -> [...]. Can be < 0."""
    return (log_std + 0.5 + 0.5 * log(2 * pi)).sum(-1)


def bernoulli_entropy(logits: Tensor) -> Tensor:
    """H = -sum_i (p_i log p_i + (1 - p_i) log(1 - p_i)) with p = sigmoid(logits), [..., n] -> [...].

    Computed as log(1 + e^z) - p z of a logit z; one of -inf or inf is no choice and contributes 0.
    """
    certain = logits.isinf()
    finite = torch.where(certain, 0.0, logits)
    p = finite.sigmoid()
    entropies = softplus(finite) - p * finite
    return torch.where(certain, 0.0, entropies).sum(-1)
