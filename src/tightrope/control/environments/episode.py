"""How episodes begin, and what a step of them returns.

The seed of an episode is a pure function of (run seed, stream, copy, episode).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tightrope.control.spaces.structure import Inputs

TRAINING, EVALUATION, TESTS = 0x7274, 0x6576, 0x7465  # streams; no two share a seed, but by chance
AT_ONCE = 256  # seeds that are drawn at once: 0.1 us each, 14 us one by one


@functools.lru_cache(maxsize=4096)
def _block(run: int, stream: int, copy: int, block: int) -> np.ndarray:
    # spawn_key, because SeedSequence([1]) and SeedSequence([1, 0]) are the same
    sequence = np.random.SeedSequence(entropy=run, spawn_key=(stream, copy, block))
    return sequence.generate_state(AT_ONCE) >> 1  # 31 bits: Atari and others keep seeds in an int32


def episode_seed(run: int, stream: int, copy: int, episode: int) -> int:
    """The seed of an episode of a copy, below 2**31."""
    block, place = divmod(episode, AT_ONCE)
    return int(_block(run, stream, copy, block)[place])


class Seeding(NamedTuple):
    """Which resets of a run are seeded, and with what.

    ``reseed_after``: the next episode is seeded once a copy has made this many steps since its last seeded
    reset; 0: each episode. None: only the first, copy i with ``run`` + i, as older versions did.
    """

    run: int
    stream: int = TRAINING
    reseed_after: int | None = None
    carried: Sequence[str] = ()  # attributes that environments keep from episode to episode, see state.py

    def seed(self, copy: int, episode: int) -> int:
        """The seed of an episode."""
        if self.reseed_after is None and episode == 0:
            return self.run + copy
        return episode_seed(self.run, self.stream, copy, episode)

    def due(self, steps: int) -> bool:
        """Whether an episode that begins ``steps`` after the last seeded reset is seeded."""
        return self.reseed_after is not None and steps >= self.reseed_after


class Start(NamedTuple):
    """How a copy begins: with which episode, after how many steps in which it only waits, and with what it
    had carried from earlier episodes, encoded (see state.py).
    """

    episode: int = 0
    wait: int = 0
    carried: object = None


class Step(NamedTuple):
    """What one step of all B environments returned; rewards and flags are valid until the next step."""

    inputs: Inputs  # what the next action is chosen from
    action_mask: np.ndarray | None  # bool [B, L], for the next action
    rewards: np.ndarray  # float64 [B]
    terminated: np.ndarray  # bool [B]
    truncated: np.ndarray  # bool [B]; never True where terminated is
    phantom: np.ndarray | None = None  # bool [B]: NEXT_STEP's reset, not a transition; None: none here
    final_rows: np.ndarray | None = None  # int [F]: truncated rows whose ``inputs`` are the next episode's
    final_inputs: Inputs | None = None  # [F, ...]: the true last observations of these rows
    cut: np.ndarray | None = None  # bool [B]: restarted after a fault; this step did not take place there
    success: np.ndarray | None = None  # float64 [B]: of episodes that ended here; NaN: not said (masks.py)
    origins: np.ndarray | None = None  # `Environments.origins`, where an episode ended
