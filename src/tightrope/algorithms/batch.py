"""The data one update works on: rows are environments or prompts, columns are steps or tokens.

Before the update the scale of returns moves to it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from tightrope.maths.values import ReturnScale


@dataclass(frozen=True)
class Evaluation:
    """What a model returns for a batch: ``logp``, ``entropy`` and ``values``, each [B, T]."""

    logp: Tensor
    entropy: Tensor
    values: Tensor


@dataclass(frozen=True)
class Batch:
    """Steps to learn from. Everything per step is [B, T]; ``mask`` is True where a step counts.

    ``inputs`` is opaque: a dict of tensors whose leading axis is the row (control: [B, T, ...] observations).
    ``actions`` is [B, T, ...]; ``old_logp`` is the log-probability at sampling; ``returns``, what the critic
    learns, are old values + advantages of the critic's lambda. The three are in units of the return, or as
    `in_scale` gives them.
    """

    inputs: dict[str, Tensor]
    actions: Tensor
    old_logp: Tensor
    old_values: Tensor
    advantages: Tensor
    returns: Tensor
    mask: Tensor

    def __len__(self) -> int:
        """The number of rows."""
        return self.mask.shape[0]

    def map(self, change: Callable[[Tensor], Tensor]) -> Batch:
        """The batch with every tensor changed by one function."""
        inputs = {name: change(leaf) for name, leaf in self.inputs.items()}
        names = [field.name for field in dataclasses.fields(self) if field.name != "inputs"]
        return dataclasses.replace(self, inputs=inputs, **{n: change(getattr(self, n)) for n in names})

    def select(self, rows: Tensor | slice) -> Batch:
        """The batch of these rows only (an index tensor or a slice)."""
        return self.map(lambda x: x[rows])

    def in_scale(self, scale: ReturnScale | None, *, advantages: bool) -> Batch:
        """The batch as the critic learns it, float32: old values and returns in its scale (None: in units of
        the return). ``advantages``: these too, where only their order and their proportions count.
        """
        names = ("old_values", "returns", "advantages")
        numbers: dict[str, Any] = {name: getattr(self, name) for name in names}
        if scale is not None:
            outputs = scale.outputs(torch.stack([self.old_values, self.returns]))
            numbers |= dict(zip(names, outputs, strict=False))
            if advantages:
                numbers["advantages"] = self.advantages / scale.unit
        return dataclasses.replace(self, **{name: x.float() for name, x in numbers.items()})

    def as_steps(self) -> Batch:
        """[B, T] to [N, 1]: every counting step becomes a row; masked steps are left out."""
        steps = self.map(lambda x: x.reshape(x.shape[0] * x.shape[1], 1, *x.shape[2:]))
        return steps if bool(steps.mask.all()) else steps.select(steps.mask[:, 0].nonzero()[:, 0])

    def cleared(self) -> Batch:
        """The rows in which a step counts, with 0 in every number outside the mask, where padding may hold
        anything, NaN included. ValueError when no step counts.
        """
        self.require_steps()
        rows = self.mask.any(1)
        batch = self if bool(rows.all()) else self.select(rows.nonzero()[:, 0])
        names = ("old_logp", "old_values", "advantages", "returns")
        numbers: dict[str, Any] = {n: torch.where(batch.mask, getattr(batch, n), 0.0) for n in names}
        return dataclasses.replace(batch, **numbers)

    def require_steps(self) -> None:
        """ValueError when no step counts: a mean over nothing is no loss."""
        if not bool(self.mask.any()):
            raise ValueError(
                f"No step of the batch counts: its mask, of shape {tuple(self.mask.shape)}, is "
                f"{'False throughout' if self.mask.numel() else 'empty'}; expected at least one True. Leave "
                "the update out where a rollout has nothing to learn from."
            )

    def minibatches(self, size: int, rng: np.random.Generator) -> Iterator[Batch]:
        """All rows once, in a fresh random order, ``size`` at a time; a smaller last one is used as it is."""
        order = torch.from_numpy(rng.permutation(len(self))).to(self.mask.device)
        for start in range(0, len(self), size):
            yield self.select(order[start : start + size])

    def split(self, size: int | None) -> Iterator[Batch]:
        """Consecutive parts of at most ``size`` rows (None: the whole batch); their gradients add up to that
        of the batch.
        """
        if size is None or size >= len(self):
            yield self
            return
        for start in range(0, len(self), size):
            yield self.select(slice(start, start + size))


def moved_scale(
    batch: Batch, scale: ReturnScale, layer: nn.Linear | None, *, advantages: bool
) -> tuple[Batch, ReturnScale, tuple[float, float]]:
    """A batch in units of the return, as `Batch.in_scale` gives it after the scale has moved to it; that
    scale, and the `ReturnScale.change` to it.

    ``layer``, the critic's last one, is carried into the new scale; None: outputs have to follow by learning.
    Adam's moments stay: gradients are of order 1 in either scale.
    """
    now, (factor, shift) = scale.moved(batch.returns, batch.mask)
    if layer is not None:
        # .data: a pass that kept its graph still finds this layer, and its gradients are those of the new one
        layer.weight.data.mul_(factor)
        layer.bias.data.mul_(factor).add_(shift)
    return batch.in_scale(now, advantages=advantages), now, (factor, shift)


def scale_metrics(scale: ReturnScale | None) -> dict[str, float]:
    """The metrics that show a scale; none without one."""
    if scale is None:
        return {}
    return {"train/return_mean": scale.mean, "train/return_deviation": scale.deviation}
