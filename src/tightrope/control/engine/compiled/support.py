"""What the compiled engine covers, and the reason where it does not."""

from __future__ import annotations

import importlib.util
import os
from typing import Any

import torch
from torch import nn

from tightrope.algorithms.settings import PPOSettings, UpdateSettings

ACTIVATIONS = (nn.Tanh, nn.ReLU, nn.ELU, nn.SiLU)


def unsupported(policy: Any, settings: UpdateSettings, device: Any, algorithm: str) -> str | None:
    """Why this runs on torch, in a few words that follow "does not cover"; None when the engine covers it."""
    if algorithm != "ppo" or not isinstance(settings, PPOSettings):
        return f"the algorithm {algorithm}"
    if torch.device(device).type != "cpu":
        return f"the device {device}"
    for name in ("dual_clip", "kl_beta"):
        if getattr(settings, name) is not None:
            return name
    if settings.recompute_advantages:
        return "recompute_advantages"
    return _uncovered_policy(policy) or _missing_package()


def _uncovered_policy(policy: Any) -> str | None:
    if getattr(policy, "own", None) is not None or getattr(policy, "actor", None) is None:
        return "own modules"
    if len(getattr(policy, "encoders", ())) or policy.observation_layout.image_shapes:
        return "image observations"
    if getattr(policy, "gsde", False):
        return "gSDE"
    if getattr(policy, "std", "independent") == "state":
        return "a deviation that depends on the state"
    if getattr(policy, "half_range", None) is not None:
        return "squash"
    for name in ("trunk", "actor", "critic"):
        reason = _uncovered_network(getattr(policy, name), ends_linear=name != "trunk")
        if reason is not None:
            return f"{reason} in the {name}"
    known = sum(
        1
        for part in (policy.trunk, policy.actor, policy.critic)
        if part is not None
        for _ in part.parameters()
    )
    if known + (policy.log_std is not None) != sum(1 for _ in policy.parameters()):
        return "parameters beside trunk, actor, critic and log_std"
    if not all(p.requires_grad and p.dtype == torch.float32 for p in policy.parameters()):
        return "frozen parameters or numbers other than float32"
    return None


def _uncovered_network(network: nn.Module | None, *, ends_linear: bool) -> str | None:
    if network is None:
        return None
    if not isinstance(network, nn.Sequential) or not len(network) or not isinstance(network[0], nn.Linear):
        return "a network that is no sequence of layers"
    linear = False
    for module in network:
        if isinstance(module, nn.Linear):
            if module.bias is None:
                return "layers without bias"
            linear = True
        elif isinstance(module, ACTIVATIONS) and linear:
            if isinstance(module, nn.ELU) and module.alpha != 1:
                return "ELU with another alpha than 1"
            linear = False
        else:
            return f"{type(module).__name__} layers"
    return None if linear == ends_linear else "a network that ends in the wrong kind of layer"


def _missing_package() -> str | None:
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        return "NUMBA_DISABLE_JIT"
    for name in ("numba", "scipy"):
        if importlib.util.find_spec(name) is None:
            return f"an installation without {name}"
    return None
