"""The distribution over next tokens: from logits to what is sampled and trained, and its statistics.

`shape_logits` is the only place that turns logits into the distribution; sampler and trainer both call it.
`token_statistics` computes log-probability, entropy and KL without ever keeping [B, T, vocabulary].
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from tightrope.language.model.architecture import CAP, FACTOR

CHUNK = 1 << 23  # logits at a time: 34 MB in float32


@dataclass(frozen=True)
class Sampling:
    """How tokens are drawn: temperature, only the k likeliest (0, or more than there are: all), tokens that
    are never drawn. ``cap``: logits x of the head become cap tanh(x / cap) first, as the model does.
    """

    temperature: float = 1.0
    top_k: int = 0
    forbidden: tuple[int, ...] = ()
    cap: float | None = None

    def choices(self, size: int) -> int:
        """How many of ``size`` ids top-k chooses among."""
        return min(self.top_k, size - len(self.forbidden))


@functools.lru_cache(maxsize=8)
def _places(ids: tuple[int, ...], device: torch.device) -> Tensor:
    return torch.tensor(ids, device=device)


def shape_logits(
    logits: Tensor, sampling: Sampling, support: Tensor | None = None, *, in_place: bool = False
) -> Tensor:
    """Logits [N, V] of the head -> logits of the distribution in float32, [N, V], or [N, k] on a support.

    Caps them, divides by the temperature and forbids what must not be drawn. ``support`` [N, k]: the ids
    that top-k left when the token was sampled; the others have probability 0 for every role. ``in_place``:
    float32 logits may be written over.
    """
    shaped = logits.float() if in_place else logits.to(torch.float32, copy=True)
    if sampling.cap is not None:
        shaped.div_(sampling.cap).tanh_().mul_(sampling.cap)
    if sampling.temperature != 1.0:
        shaped.div_(sampling.temperature)
    if sampling.forbidden:
        shaped.index_fill_(1, _places(sampling.forbidden, shaped.device), -torch.inf)
    return shaped if support is None else shaped.gather(1, support)


def at_head(sampling: Sampling, head: nn.Linear) -> Sampling:
    """``sampling`` corrected for the factor and the cap between the head's output and the model's logits:
    cap tanh(factor x / cap) / T = c tanh(x / c) / (T / factor) with c = cap / factor.
    """
    factor: float = getattr(head, FACTOR, 1.0)
    cap: float | None = getattr(head, CAP, None)
    if factor == 1.0 and cap is None:
        return sampling
    bend = None if cap is None else cap / factor
    return dataclasses.replace(sampling, temperature=sampling.temperature / factor, cap=bend)


def next_logits(hidden: Tensor, head: nn.Linear, sampling: Sampling) -> Tensor:
    """Logits [N, V] of the distribution of the token that follows hidden states [N, d]."""
    return shape_logits(nn.functional.linear(hidden, head.weight, head.bias), at_head(sampling, head))


class TokenStatistics(NamedTuple):
    """Of N tokens: log-probability, entropy of the state, KL(policy || reference) of the state, and the
    token's log-probability by the reference; nats.
    """

    logp: Tensor
    entropy: Tensor
    kl: Tensor
    reference_logp: Tensor


def token_statistics(
    hidden: Tensor,
    head: nn.Linear,
    tokens: Tensor,
    sampling: Sampling,
    *,
    support: Tensor | None = None,
    reference: Tensor | None = None,
    reference_head: nn.Linear | None = None,
    ahead: bool = False,
) -> TokenStatistics:
    """log p(token), the entropy and the exact KL to a reference, from hidden states [N, d]; each [N].

    ``tokens`` [N]; ``reference`` [N, d]: hidden states of the reference, None: KL and its log p are 0.
    Differentiable in ``hidden`` and the head's weight, but for the reference's log p; the backward pass
    computes each chunk of logits again. ``ahead``: it need not, because the gradient of log p is computed in
    the forward pass, where the logits are; worth it when neither entropy nor KL nor the head are trained.
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
        at_head(sampling, head),
        support,
        reference,
        other.weight,
        other.bias,
        ahead and torch.is_grad_enabled() and hidden.requires_grad,
    )
    return TokenStatistics(*_Chunked.apply(*arguments))


class _Chunked(torch.autograd.Function):
    """The statistics chunk by chunk, forwards and back."""

    @staticmethod
    def forward(
        ctx: Any, hidden: Tensor, weight: Tensor, bias: Tensor | None, tokens: Tensor, sampling: Sampling,
        support: Tensor | None, reference: Tensor | None, reference_weight: Tensor,
        reference_bias: Tensor | None, ahead: bool,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
        saved = (hidden, weight, bias, tokens, support, reference, reference_weight, reference_bias)
        ctx.save_for_backward(*saved)
        ctx.sampling, ctx.slope = sampling, torch.empty_like(hidden) if ahead else None
        chunks = _Chunks(saved, sampling)
        logp, entropy, kl, theirs = (torch.zeros(len(tokens), device=hidden.device) for _ in range(4))
        for rows in chunks:
            p, logs, chosen = chunks.policy(rows)
            logp[rows] = logs.gather(1, chosen)[:, 0]
            entropy[rows] = -_dot(p, logs)[:, 0]  # in buffers: a test holds it to maths.divergence
            if reference is not None:
                others = chunks.reference(rows)
                theirs[rows] = others.gather(1, chosen)[:, 0]
                kl[rows] = _dot(p, logs.sub_(others))[:, 0]
            if ctx.slope is not None:
                slope = p.neg_().scatter_add_(1, chosen, torch.ones_like(p[:, :1]))
                ctx.slope[rows] = chunks.to_head(slope, rows) @ weight
        ctx.mark_non_differentiable(theirs)
        return logp, entropy, kl, theirs

    @staticmethod
    def backward(ctx: Any, *outer: Tensor) -> tuple[Any, ...]:
        hidden, weight, bias = ctx.saved_tensors[:3]
        need_hidden, need_weight, need_bias = ctx.needs_input_grad[:3]
        states = [g if bool(g.any()) else None for g in outer[1:3]]
        if ctx.slope is not None and states == [None, None] and not (need_weight or need_bias):
            return ctx.slope * outer[0][:, None].to(hidden.dtype), *[None] * 9
        to_hidden = torch.empty_like(hidden) if need_hidden else None
        to_weight: Tensor | None = None
        to_bias = torch.zeros_like(bias) if need_bias and bias is not None else None
        chunks = _Chunks(ctx.saved_tensors, ctx.sampling)
        for rows in chunks:
            here = [None if g is None else g[rows, None] for g in states]
            gradient = chunks.gradient(rows, outer[0][rows, None], *here)
            if to_hidden is not None:
                to_hidden[rows] = gradient @ weight
            if need_weight and to_weight is None:
                to_weight = gradient.T @ hidden[rows]
            elif to_weight is not None:
                to_weight.addmm_(gradient.T, hidden[rows])
            if to_bias is not None:
                to_bias += gradient.sum(0)
        return to_hidden, to_weight, to_bias, *[None] * 7


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Row by row, [n, 1], without their product in memory."""
    return torch.bmm(a[:, None, :], b[:, :, None])[:, :, 0]


class _Chunks:
    """Some rows at a time, in buffers that every chunk writes over: fresh memory costs more than the sums."""

    def __init__(self, saved: tuple[Any, ...], sampling: Sampling) -> None:
        self.hidden, self.weight, self.bias, self.tokens, self.support = saved[:5]
        self.others, self.sampling = saved[5:], sampling
        self.size = max(1, min(len(self.tokens), CHUNK // len(self.weight)))
        self._buffers: dict[str, Tensor] = {}

    def __iter__(self) -> Iterator[slice]:
        for start in range(0, len(self.tokens), self.size):
            yield slice(start, min(start + self.size, len(self.tokens)))

    def policy(self, rows: slice) -> tuple[Tensor, Tensor, Tensor]:
        """p and log p (0 where p is), [n, V] or on a support [n, k], and the places of the tokens [n, 1]."""
        allowed = None if self.support is None else self.support[rows]
        tokens = self.tokens[rows, None]
        chosen = tokens if allowed is None else (allowed == tokens).int().argmax(1, keepdim=True)
        return *self._distribution("p", self.hidden[rows], self.weight, self.bias, allowed), chosen

    def reference(self, rows: slice) -> Tensor:
        """log p of the reference, 0 where it is 0."""
        hidden, weight, bias = self.others
        allowed = None if self.support is None else self.support[rows]
        return self._distribution("q", hidden[rows], weight, bias, allowed)[1]

    def gradient(
        self, rows: slice, to_logp: Tensor, to_entropy: Tensor | None, to_kl: Tensor | None
    ) -> Tensor:
        """d/dz of logp: 1 - p;  of H: -p (log p + H);  of KL: p (log p - log q - KL); back to the head's
        [n, V]. None for a gradient that is 0 throughout.
        """
        p, logs, chosen = self.policy(rows)
        inner = -to_logp
        if to_entropy is not None:
            inner = inner - to_entropy * (logs - _dot(p, logs))
        if to_kl is not None and self.others[0] is not None:
            difference = logs.sub_(self.reference(rows))
            inner = inner + to_kl * (difference - _dot(p, difference))
        return self.to_head(p.mul_(inner).scatter_add_(1, chosen, to_logp), rows)

    def to_head(self, gradient: Tensor, rows: slice) -> Tensor:
        """A gradient of shaped logits, written over, as one of the head's own logits [n, V]; comes after
        `policy` of these rows.
        """
        if self.sampling.cap is not None:
            gradient *= self._buffers["slope"][: len(gradient)]
        if self.sampling.temperature != 1.0:
            gradient /= self.sampling.temperature
        if self.support is not None:
            whole = gradient.new_zeros(len(gradient), len(self.weight))
            gradient = whole.scatter_(1, self.support[rows], gradient)
        return gradient.to(self.weight.dtype)

    def _distribution(
        self, name: str, hidden: Tensor, weight: Tensor, bias: Tensor | None, allowed: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Probabilities and their logarithms."""
        logits = self._buffer(f"log {name}", len(hidden), len(weight), weight.dtype)
        torch.mm(hidden, weight.T, out=logits)
        if bias is not None:
            logits += bias
        logs = shape_logits(logits, self.sampling, allowed, in_place=True)
        if self.sampling.cap is not None and name == "p":
            slope = self._buffer("slope", len(logs), logs.shape[1], logs.dtype)
            # d/dx of cap tanh(x / cap); a forbidden token is at -inf and has none
            torch.mul(logs, self.sampling.temperature / self.sampling.cap, out=slope)
            slope.square_().neg_().add_(1.0).clamp_(min=0.0)
        logs -= logs.amax(1, keepdim=True)
        p = torch.exp(logs, out=self._buffer(name, len(logs), logs.shape[1], logs.dtype))
        total = p.sum(1, keepdim=True)
        p /= total
        logs -= total.log()
        if self.sampling.forbidden:  # 0 log 0 is 0
            forbidden = _places(self.sampling.forbidden, logs.device)
            logs.index_fill_(1, forbidden, 0.0) if allowed is None else logs.masked_fill_(
                logs == -torch.inf, 0.0
            )
        return p, logs

    def _buffer(self, name: str, rows: int, width: int, dtype: torch.dtype) -> Tensor:
        if name not in self._buffers:
            self._buffers[name] = torch.empty(self.size, width, dtype=dtype, device=self.hidden.device)
        return self._buffers[name][:rows]
