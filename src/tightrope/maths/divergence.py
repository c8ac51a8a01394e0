"""Entropies and divergences, in nats.

k1, k2, k3 estimate KL(old || new) from steps sampled by the OLD policy, with log_ratio = log(new / old) at
the sampled action: [B, T] in, [B, T] out. Source: Schulman, http://joschu.net/blog/kl-approx.html

The exact ones take the parameters of distributions, [..., d] in and [...] out: the action axis, the last one,
alone is summed. A masked choice has the logit -inf; it contributes 0 to every sum, without NaN in value or
gradient.
"""

from math import log, pi

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid


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


def categorical_kl(logits_p: Tensor, logits_q: Tensor) -> Tensor:
    """KL(p || q) = sum_k p_k (log p_k - log q_k), [..., K] -> [...].

    Choices masked in p contribute 0; one that p allows and q masks makes the result inf, as it should.
    """
    masked = logits_p == -torch.inf
    logp = logits_p.log_softmax(-1)
    difference = torch.where(masked, 0.0, logp) - torch.where(masked, 0.0, logits_q.log_softmax(-1))
    return (logp.exp() * difference).sum(-1)


def gaussian_entropy(log_std: Tensor) -> Tensor:
    """H = sum_i (log std_i + 0.5 log(2 pi e)) of independent Gaussians, [..., d] -> [...]. Can be < 0."""
    return (log_std + 0.5 * (log(2 * pi) + 1)).sum(-1)


def gaussian_kl(mean_p: Tensor, log_std_p: Tensor, mean_q: Tensor, log_std_q: Tensor) -> Tensor:
    """KL(p || q) of independent Gaussians, [..., d] -> [...]; the standard deviations may be [d].

    sum_i log(std_q / std_p) + (std_p^2 + (mean_p - mean_q)^2) / (2 std_q^2) - 1/2
    """
    log_scale = log_std_p - log_std_q
    distance = (mean_p - mean_q) * (-log_std_q).exp()
    return (0.5 * ((2 * log_scale).expm1() + distance.square()) - log_scale).sum(-1)


def bernoulli_entropy(logits: Tensor) -> Tensor:
    """H = -sum_i (p_i log p_i + (1 - p_i) log(1 - p_i)) with p = sigmoid(logits), [..., n] -> [...]."""
    masked = logits == -torch.inf
    safe = torch.where(masked, 0.0, logits)
    entropies = -(safe.sigmoid() * logsigmoid(safe) + (-safe).sigmoid() * logsigmoid(-safe))
    return torch.where(masked, 0.0, entropies).sum(-1)


def bernoulli_kl(logits_p: Tensor, logits_q: Tensor) -> Tensor:
    """KL(p || q) = sum_i p_i log(p_i / q_i) + (1 - p_i) log((1 - p_i) / (1 - q_i)), [..., n] -> [...].

    A bit masked in p is no choice and contributes 0; one that p leaves free and q masks makes the result inf.
    """
    masked = logits_p == -torch.inf
    p, q = torch.where(masked, 0.0, logits_p), torch.where(masked, 0.0, logits_q)
    ones = p.sigmoid() * (logsigmoid(p) - logsigmoid(q))
    zeros = (-p).sigmoid() * (logsigmoid(-p) - logsigmoid(-q))
    return torch.where(masked, 0.0, ones + zeros).sum(-1)
