"""The message when a step is refused: the first tensor with a number that is not finite, and its place."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import torch
from torch import Tensor, nn

from tightrope.algorithms.batch import Batch, Evaluation
from tightrope.errors import TightropeError

REFUSED = (
    "expected a finite number. That step was not taken and the weights are as before it. Look for extreme "
    "rewards, observations or a learning rate that is too high."
)
DATA = (
    ("old_logp", "old_logp"),
    ("old_values", "old value"),
    ("advantages", "advantage"),
    ("returns", "return"),
)


class NonFiniteError(TightropeError, FloatingPointError):
    """A NaN or an infinity was met before a step; the weights are as they were before that step."""


def require_restorable(name: str, saved: Tensor, like: Tensor, *, at_least: float = -math.inf) -> None:
    """ValueError for a saved tensor that is not of the shape and type of the one it is for, or that holds a
    number that is not finite or below ``at_least``.
    """
    if saved.shape != like.shape or saved.dtype != like.dtype:
        kinds = [f"{str(x.dtype).removeprefix('torch.')} {tuple(x.shape)}" for x in (saved, like)]
        raise ValueError(f"{name} is {kinds[0]}, expected {kinds[1]}")
    if saved.is_floating_point() and saved.numel():
        low, high = map(float, saved.aminmax())
        if not (math.isfinite(low) and math.isfinite(high) and low >= at_least):
            raise ValueError(f"{name} holds {low if not low >= at_least else high}, expected finite numbers")


def explain(
    model: Callable[[Batch], Evaluation],
    optimiser: torch.optim.Optimizer,
    batch: Batch,
    minibatch: Batch,
    where: str,
    sums: Tensor,
) -> str:
    """A message that names the first number that is not finite, in this order: weights, data of the rollout,
    outputs of the model, ratios and loss, gradients.

    ``batch``: the rollout, whose rows are named; ``minibatch``: the one that was refused; ``sums`` [2]: its
    KL and loss. It is made once, when a run is about to end, and may cost a forward pass.
    """
    found = _weights(model, optimiser) or _data(batch) or _outputs(model, minibatch)
    return _sentence(found or _sums(sums) or _gradients(model, optimiser), where)


def explain_loss(optimiser: torch.optim.Optimizer, loss: Tensor, where: str) -> str:
    """The same where there is no rollout: weights, the loss, gradients."""
    found = _weights(None, optimiser) or first_bad([("The loss", loss)]) or _gradients(None, optimiser)
    return _sentence(found, where)


def _sentence(found: str | None, where: str) -> str:
    nothing = "The norm of the gradient is not finite, though each number in it is"
    return f"{found or nothing} {where}; {REFUSED}"


def _sums(sums: Tensor) -> str | None:
    kl, loss = sums.tolist()
    if not math.isfinite(kl):
        return f"The ratios overflow (their KL is {kl}), though all log-probabilities are finite,"
    return None if math.isfinite(loss) else f"The loss is {loss}, though data and outputs are finite,"


def _weights(model: object, optimiser: torch.optim.Optimizer) -> str | None:
    return first_bad((f"The weight {name}", p.detach()) for name, p in _named(model, optimiser))


def _gradients(model: object, optimiser: torch.optim.Optimizer) -> str | None:
    named = ((name, p.grad) for name, p in _named(model, optimiser))
    return first_bad((f"Data and outputs are finite, but the gradient of {name}", g) for name, g in named)


def _named(model: object, optimiser: torch.optim.Optimizer) -> list[tuple[str, nn.Parameter]]:
    """The parameters that the optimiser holds, by the model's names for them where it has any."""
    named = getattr(model, "named_parameters", None)
    names = {id(p): name for name, p in named()} if named is not None else {}
    held = [p for group in optimiser.param_groups for p in group["params"]]
    return [(names.get(id(p), f"number {k} of the optimiser"), p) for k, p in enumerate(held)]


def _data(batch: Batch) -> str | None:
    inputs = [(f"input {name}", x) for name, x in batch.inputs.items() if x.shape[:2] == batch.mask.shape]
    others = [("action", batch.actions), *((words, getattr(batch, name)) for name, words in DATA)]
    return first_bad(
        (f"The {words} (row, step, ...)", _counting(x, batch.mask)) for words, x in (*inputs, *others)
    )


def _outputs(model: Callable[[Batch], Evaluation], minibatch: Batch) -> str | None:
    with torch.no_grad():
        now = model(minibatch)
    parts = (("logits or log-probability", now.logp), ("entropy", now.entropy), ("value", now.values))
    place = "(row of the minibatch, step)"
    return first_bad((f"The {words} {place}", _counting(x, minibatch.mask)) for words, x in parts)


def _counting(x: Tensor, mask: Tensor) -> Tensor:
    """0 outside the mask: these numbers were never used."""
    mask = mask.reshape(*mask.shape, *[1] * (x.dim() - mask.dim()))
    return torch.where(mask, x.detach(), torch.zeros((), dtype=x.dtype, device=x.device))


def first_bad(tensors: Iterable[tuple[str, Tensor | None]]) -> str | None:
    """``NAME[index] is nan`` for the first number that is not finite in these named tensors; None: none."""
    for name, x in tensors:
        if x is None or not x.is_floating_point():
            continue
        bad = ~torch.isfinite(x)
        if bool(bad.any()):
            index = bad.nonzero()[0].tolist()
            return f"{name}{index or ''} is {float(x.detach()[tuple(index)])}"
    return None
