"""tightrope: PPO from CartPole to RLHF on one verified core.

agent = tightrope.PPO("CartPole-v1", seed=1).learn(100_000)
action, _ = agent.predict(observation)
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from tightrope.errors import TightropeError

if TYPE_CHECKING:
    from tightrope.control.agent import A2C, PPO, Reinforce
    from tightrope.control.saving import load

__version__ = "0.2.0"
__all__ = ["A2C", "PPO", "Reinforce", "TightropeError", "__version__", "load"]

_HOMES = {
    "A2C": "tightrope.control.agent",
    "PPO": "tightrope.control.agent",
    "Reinforce": "tightrope.control.agent",
    "load": "tightrope.control.saving",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used: ``import tightrope`` alone costs no torch."""
    if name in _HOMES:
        return getattr(importlib.import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'tightrope' has no attribute {name!r}; it has {', '.join(__all__)}")
