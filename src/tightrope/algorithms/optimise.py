"""Adam: built for an actor and a critic, its learning rates set, its state saved and restored."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn

from tightrope.algorithms.nonfinite import require_restorable
from tightrope.algorithms.settings import UpdateSettings


def _bare(name: str) -> Any:
    """Adam's own method without the decorators of torch's compiler.

    Calling a decorated one imports the whole compiler: 70 MB and more than a second, for nothing here.
    """
    method = getattr(torch.optim.Adam, name)
    return getattr(method, "__wrapped__", method)


class Adam(torch.optim.Adam):
    """torch's Adam, its mathematics and its state; only the way in is lighter."""

    add_param_group = _bare("add_param_group")
    load_state_dict = _bare("load_state_dict")
    state_dict = _bare("state_dict")
    zero_grad = _bare("zero_grad")
    step = torch.no_grad()(_bare("step"))


def make_optimiser(
    parameters: Iterable[nn.Parameter], critic: Iterable[nn.Parameter], settings: UpdateSettings
) -> Adam:
    """Adam with two groups, ``actor`` (everything else) and ``critic``, each with its own learning rate."""
    critic = list(critic)
    ids = {id(p) for p in critic}
    groups = [
        {"params": [p for p in parameters if id(p) not in ids], "lr": settings.learning_rate},
        {"params": critic, "lr": settings.critic_learning_rate or settings.learning_rate},
    ]
    groups = [group for group in groups if group["params"]]
    return Adam(groups, eps=settings.adam_eps, fused=True)


def set_learning_rates(optimiser: torch.optim.Optimizer, settings: UpdateSettings) -> None:
    """Put the present learning rates into the optimiser's groups (first actor, then critic)."""
    critic = settings.critic_learning_rate
    rates = [settings.learning_rate, settings.learning_rate if critic is None else critic]
    for group, rate in zip(optimiser.param_groups, rates, strict=False):
        group["lr"] = rate


def optimiser_tensors(optimiser: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Adam's moments and step counts, named ``<index of the parameter>.<what>``."""
    state = optimiser.state_dict()["state"]
    return {f"{index}.{name}": x for index, entry in state.items() for name, x in entry.items()}


def restore_optimiser(optimiser: torch.optim.Optimizer, tensors: dict[str, Tensor]) -> None:
    """Adam's moments, copied in place where they exist: the compiled engine may hold views of them. Those
    that are not saved become 0, as before the first step. Raises ValueError for those of other parameters.
    """
    parameters = [p for group in optimiser.param_groups for p in group["params"]]
    for number, parameter in enumerate(parameters):
        for kind, moment in optimiser.state.get(parameter, {}).items():
            if f"{number}.{kind}" not in tensors:
                moment.zero_()
    for name, saved in tensors.items():
        index, kind = name.split(".", 1)
        parameter = parameters[int(index)]
        like = torch.zeros(()) if kind == "step" else parameter
        low = -math.inf if kind == "exp_avg" else 0.0
        require_restorable(f"{name} of the optimiser", saved, like, at_least=low)
        entry = optimiser.state[parameter]
        if kind in entry:
            entry[kind].copy_(saved)
        else:
            entry[kind] = saved.to(parameter.device).clone()
