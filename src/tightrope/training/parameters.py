"""Save and restore every tensor that training changes."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from tightrope.algorithms.nonfinite import require_restorable
from tightrope.algorithms.optimise import optimiser_tensors, restore_optimiser

Tensors = dict[str, dict[str, Tensor]]


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
