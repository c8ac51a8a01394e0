"""Save and restore every tensor that training changes, also around one update."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor, nn

from tightrope.algorithms.nonfinite import require_restorable
from tightrope.algorithms.optimise import optimiser_tensors, restore_optimiser
from tightrope.runs import signals

Tensors = dict[str, dict[str, Tensor]]
COPY_FROM = 0.5  # seconds of an update from which a copy of what it changes costs nothing beside it


def tensors_of(parameters: Sequence[nn.Parameter], optimiser: torch.optim.Optimizer) -> Tensors:
    """Every tensor that training changes, in the order of ``parameters``, and the optimiser's moments."""
    trained = {f"{index:05d}": parameter.data for index, parameter in enumerate(parameters)}
    return {"trained": trained, "optimiser": optimiser_tensors(optimiser)}


@torch.no_grad()
def restore_tensors(
    tensors: Tensors, parameters: Sequence[nn.Parameter], optimiser: torch.optim.Optimizer
) -> None:
    """Copy what `tensors_of` gave into the same parameters and their optimiser."""
    saved = [tensors["trained"][f"{index:05d}"] for index in range(len(parameters))]
    for index, parameter in enumerate(parameters):
        require_restorable(f"trained tensor {index}", saved[index], parameter)
    for index, parameter in enumerate(parameters):
        parameter.copy_(saved[index])
    restore_optimiser(optimiser, tensors["optimiser"])


@contextlib.contextmanager
def whole_update(
    seconds: float | None, tensors: Callable[[], Tensors], put_back: Callable[[Tensors], None] | None
) -> Iterator[None]:
    """Around an iteration, whose update changes ``tensors()`` in place; what it learns from is collected
    inside `signals.interruptible`, before the update. After a signal the update is finished if it takes less
    than PATIENCE, by the ``seconds`` that the one before took (None: not known). Otherwise it is undone by
    ``put_back`` and a copy; with ``put_back`` None no copy is kept, and it is finished all the same.
    """
    copy: Tensors | None = None
    if put_back is not None and (seconds is None or seconds > COPY_FROM):
        copy = {name: {key: x.clone() for key, x in group.items()} for name, group in tensors().items()}
    try:
        with signals.uninterrupted("the update under way", seconds, can_undo=copy is not None):
            yield
    except KeyboardInterrupt:
        if copy is not None and put_back is not None:
            put_back(copy)
        raise
