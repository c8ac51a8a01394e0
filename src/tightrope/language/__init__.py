"""Story two: causal language models. SFT, a reward model, and PPO against any reward.

from tightrope.language import align
run = align(model="path/to/model", prompts=prompts, reward=reward, total_episodes=4096, seed=1)
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tightrope.language.alignment.align import align
    from tightrope.language.compare import sample_run
    from tightrope.language.reward.model import load_reward
    from tightrope.language.settings import RECIPES, AlignSettings, RewardSettings, SFTSettings
    from tightrope.language.supervised.preferences import train_reward
    from tightrope.language.supervised.sft import train_sft

__all__ = [
    "AlignSettings",
    "RECIPES",
    "RewardSettings",
    "SFTSettings",
    "align",
    "load_reward",
    "sample_run",
    "train_reward",
    "train_sft",
]

_HOMES = {
    "align": "alignment.align",
    "load_reward": "reward.model",
    "sample_run": "compare",
    "train_reward": "supervised.preferences",
    "train_sft": "supervised.sft",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used: the settings can be imported without torch."""
    if name in __all__:
        home = importlib.import_module(f"tightrope.language.{_HOMES.get(name, 'settings')}")
        value = getattr(home, name)
        globals()[name] = value
        return value
    raise AttributeError(
        f"module 'tightrope.language' has no attribute {name!r}; it has {', '.join(__all__)}"
    )
