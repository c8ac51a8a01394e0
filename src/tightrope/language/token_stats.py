"""What a policy says of tokens: log-probability, entropy and KL, without ever keeping [B, T, vocabulary].

``shape_logits`` alone turns logits into the distribution; the sampler and the trainer both call it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

CHUNK = 1 << 22  # logits at a time: 16 MB in float32


@dataclass(frozen=True)
class Sampling:
    """How tokens are drawn: temperature, the k likeliest alone (0: all), tokens that are never drawn."""

    temperature: float = 1.0
    top_k: int = 0
    forbidden: tuple[int, ...] = ()


class TokenStatistics(NamedTuple):
    """Of N tokens: log-probability, entropy of the state, KL(policy || reference) of the state; nats."""

    logp: Tensor
    entropy: Tensor
    kl: Tensor


def shape_logits(logits: Tensor, sampling: Sampling, support: Tensor | None = None) -> Tensor:
    """Logits [N, V] of the head -> logits of the distribution in float32, [N, V], or [N, k] on a support.

    Divides by the temperature and forbids what must not be drawn. ``support`` [N, k]: the ids that top-k left
    when the token was sampled; the others have probability 0 for every role.
    """
    shaped = logits.float()
    if sampling.temperature != 1.0:
        shaped = shaped / sampling.temperature
    if sampling.forbidden:
        shaped = shaped.index_fill(1, torch.tensor(sampling.forbidden, device=shaped.device), -torch.inf)
    return shaped if support is None else shaped.gather(1, support)


def token_statistics(
    hidden: Tensor,
    head: nn.Linear,
    tokens: Tensor,
    sampling: Sampling,
    *,
    support: Tensor | None = None,
    reference: Tensor | None = None,
    reference_head: nn.Linear | None = None,
) -> TokenStatistics:
    """log p(token), the entropy and the exact KL to a reference, from hidden states [N, d]; each [N].

    ``tokens`` [N]; ``reference`` [N, d]: hidden states of the reference, None: KL 0. Differentiable in
    ``hidden`` and the head's weight; the backward pass computes each chunk of logits again.
    ValueError when a token lies outside its support.
    """
    if support is not None and not bool((support == tokens[:, None]).any(1).all()):
        raise ValueError("A token lies outside the top-k it was drawn from; store the support of sampling.")
    other = head if reference_head is None else reference_head
    arguments = (
        hidden,
        head.weight,
        head.bias,
        tokens,
        sampling,
        support,
        reference,
        other.weight,
        other.bias,
    )
    return TokenStatistics(*_Chunked.apply(*arguments))


class _Chunked(torch.autograd.Function):
    """The statistics chunk by chunk, forwards and back."""

    @staticmethod
    def forward(
        ctx: Any, hidden: Tensor, weight: Tensor, bias: Tensor | None, tokens: Tensor, sampling: Sampling,
        support: Tensor | None, reference: Tensor | None, reference_weight: Tensor,
        reference_bias: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        saved = (hidden, weight, bias, tokens, support, reference, reference_weight, reference_bias)
        ctx.save_for_backward(*saved)
        ctx.sampling = sampling
        logp, entropy, kl = (torch.empty(len(tokens), device=hidden.device) for _ in range(3))
        for rows in _chunks(len(tokens), len(weight)):
            p, logs, chosen, difference = _chunk(saved, sampling, rows)
            logp[rows] = logs.gather(1, chosen[:, None])[:, 0]
            entropy[rows] = -(p * logs).sum(1)
            kl[rows] = 0.0 if difference is None else (p * difference).sum(1)
        return logp, entropy, kl

    @staticmethod
    def backward(ctx: Any, *outer: Any) -> tuple[Any, ...]:
        hidden, weight, bias = ctx.saved_tensors[:3]
        need_hidden, need_weight, need_bias = ctx.needs_input_grad[:3]
        to_hidden = torch.empty_like(hidden) if need_hidden else None
        to_weight = torch.zeros_like(weight) if need_weight else None
        to_bias = torch.zeros_like(bias) if need_bias and bias is not None else None
        for rows in _chunks(len(hidden), len(weight)):
            gradient = _logit_gradient(ctx, rows, *(g[rows, None] for g in outer)).to(weight.dtype)
            if to_hidden is not None:
                to_hidden[rows] = gradient @ weight
            if to_weight is not None:
                to_weight += gradient.T @ hidden[rows]
            if to_bias is not None:
                to_bias += gradient.sum(0)
        return to_hidden, to_weight, to_bias, None, None, None, None, None, None


def _chunks(count: int, width: int) -> list[slice]:
    size = max(1, CHUNK // width)
    return [slice(start, start + size) for start in range(0, count, size)]


def _chunk(
    saved: tuple[Any, ...], sampling: Sampling, rows: slice
) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """Probabilities, their logarithms (0 where the probability is), places of the tokens, log p - log q."""
    hidden, weight, bias, tokens, support, reference, other, other_bias = saved
    allowed = None if support is None else support[rows]
    logits = shape_logits(nn.functional.linear(hidden[rows], weight, bias), sampling, allowed)
    logs = logits.log_softmax(1)
    p = logs.exp()
    impossible = logits == -torch.inf if sampling.forbidden else None
    logs = logs if impossible is None else logs.masked_fill(impossible, 0.0)
    chosen = tokens[rows] if allowed is None else (allowed == tokens[rows, None]).int().argmax(1)
    difference = None
    if reference is not None:
        theirs = nn.functional.linear(reference[rows], other, other_bias)
        theirs = shape_logits(theirs, sampling, allowed).log_softmax(1)
        difference = logs - theirs if impossible is None else (logs - theirs).masked_fill(impossible, 0.0)
    return p, logs, chosen, difference


def _logit_gradient(ctx: Any, rows: slice, to_logp: Tensor, to_entropy: Tensor, to_kl: Tensor) -> Tensor:
    """d/dz of logp: 1 - p;  of H: -p (log p + H);  of KL: p (log p - log q - KL); back to the head's [n,
    V].
    """
    p, logs, chosen, difference = _chunk(ctx.saved_tensors, ctx.sampling, rows)
    gradient = -to_logp * p
    gradient.scatter_add_(1, chosen[:, None], to_logp)
    entropy = -(p * logs).sum(1, keepdim=True)
    gradient -= to_entropy * p * (logs + entropy)
    if difference is not None:
        gradient += to_kl * p * (difference - (p * difference).sum(1, keepdim=True))
    if ctx.sampling.temperature != 1.0:
        gradient /= ctx.sampling.temperature
    support = ctx.saved_tensors[4]
    if support is None:
        return gradient
    whole = gradient.new_zeros(len(gradient), len(ctx.saved_tensors[1]))
    return whole.scatter_(1, support[rows], gradient)
