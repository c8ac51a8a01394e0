"""The compiled CPU engine: the same PPO update as algorithms/ppo.py, on the very memory of the torch
parameters.

numba is imported only when the engine is made. ``unsupported`` says beforehand what it does not cover.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tightrope.control.engine.compiled.support import unsupported

if TYPE_CHECKING:
    from tightrope.control.engine.compiled.fused import FusedEngine

__all__ = ["FusedEngine", "compilation_due", "unsupported", "when_compiled"]


def compilation_due() -> bool:
    """Whether making the first engine of this process will compile it (many seconds, once) or read a
    cache."""
    from tightrope.control.engine.compiled.numba_tools import compilation_due

    return compilation_due()


def when_compiled() -> str:
    """How often it compiles, in words: once for an installation, unless its cache is off or not writable."""
    from tightrope.control.engine.compiled.numba_tools import cache_folder

    return "in every process, as its cache is off" if cache_folder() is None else "once for this installation"


def __getattr__(name: str) -> Any:
    if name == "FusedEngine":
        from tightrope.control.engine.compiled.fused import FusedEngine

        return FusedEngine
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
