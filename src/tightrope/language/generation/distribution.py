"""From logits to the distribution that is sampled and trained: the one place that both call."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from tightrope.language.model.logit_factor import FACTOR


@dataclass(frozen=True)
class Sampling:
    """How tokens are drawn: temperature, the k likeliest alone (0, or more than there are: all), tokens that
    are never drawn.
    """

    temperature: float = 1.0
    top_k: int = 0
    forbidden: tuple[int, ...] = ()


def shape_logits(
    logits: Tensor, sampling: Sampling, support: Tensor | None = None, *, in_place: bool = False
) -> Tensor:
    """Logits [N, V] of the head -> logits of the distribution in float32, [N, V], or [N, k] on a support.

    Divides by the temperature and forbids what must not be drawn. ``support`` [N, k]: the ids that top-k left
    when the token was sampled; the others have probability 0 for every role. ``in_place``: float32 logits
    may be written over.
    """
    shaped = logits.float() if in_place else logits.to(torch.float32, copy=True)
    if sampling.temperature != 1.0:
        shaped.div_(sampling.temperature)
    if sampling.forbidden:
        shaped.index_fill_(1, torch.tensor(sampling.forbidden, device=shaped.device), -torch.inf)
    return shaped if support is None else shaped.gather(1, support)


def at_head(sampling: Sampling, head: nn.Linear) -> Sampling:
    """How to draw from the head's own logits, so that the model's are drawn from as ``sampling`` says."""
    factor: float = getattr(head, FACTOR, 1.0)
    if factor == 1.0:
        return sampling
    return dataclasses.replace(sampling, temperature=sampling.temperature / factor)
