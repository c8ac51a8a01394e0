"""The choice of the engine and of the device: a pure function of the settings and the machine."""

from __future__ import annotations

from collections.abc import Callable

import torch

from tightrope.control.engine.base import Engine
from tightrope.control.engine.torch_engine import TorchEngine
from tightrope.control.policy.policy import Policy
from tightrope.control.settings import TrainSettings


def usable_device(name: str) -> torch.device:
    """The torch device of that name. ValueError: none on this machine, or torch is built without it."""
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"device is {name!r}, which cannot be used here ({reason}). Choose cpu.") from error
    if device.type == "meta":
        raise ValueError("device is 'meta', which holds no numbers. Choose cpu.")
    return device


def choose_engine(
    policy: Policy,
    optimiser: torch.optim.Optimizer,
    settings: TrainSettings,
    cores: int,
    notify: Callable[[str], None],
) -> tuple[Engine, str]:
    """The engine for these settings, and a line that says which and why.

    Raises ValueError when ``engine`` is ``fused`` and the compiled engine does not cover the settings.
    """
    if settings.engine == "torch":
        return TorchEngine(policy, optimiser, settings), "engine: torch, as asked"
    from tightrope.control.engine.compiled.plan import unsupported

    reason = unsupported(policy, settings.update, policy.device, settings.algorithm)
    if reason is None and settings.compile:
        reason = "--compile"
    if reason is None:
        from tightrope.control.engine.compiled.cache import compilation_due, when_compiled

        if compilation_due():
            notify(f"compiling the CPU engine: about 15 seconds, {when_compiled()} ...")
        from tightrope.control.engine.compiled_engine import CompiledEngine

        engine = CompiledEngine(policy, optimiser, min(2, cores), notify)
        return engine, "engine: fused (compiled for this CPU)"
    if settings.engine == "fused":
        raise ValueError(
            f"engine is 'fused', which does not cover {reason}. Use --engine auto or torch, or change that "
            "setting."
        )
    line = f"engine: torch (the compiled engine does not cover {reason})"
    return TorchEngine(policy, optimiser, settings), line
