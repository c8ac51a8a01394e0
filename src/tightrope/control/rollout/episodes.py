"""The training episodes that ended last: what their means are taken over, and what bounds an evaluation."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np

from tightrope.control.rollout.rollout import Rollout
from tightrope.runs.checkpoint import counted

RECENT = 100  # episodes that rollout/ep_rew_mean and its like are means of, as in stable-baselines3


class FinishedEpisodes:
    """Returns, lengths and successes of the last RECENT episodes, and the longest of all.

    ``longest``: steps; infinity where it is not known, after a checkpoint of an older version.
    """

    def __init__(self) -> None:
        self._newest: deque[tuple[float, int]] = deque(maxlen=RECENT)  # return, length
        self._successes: deque[float] = deque(maxlen=RECENT)
        self.longest: float = 0
        self._heard: int | None = 0  # when an episode last finished; None: it was told that none does

    def silence(self, rollout: Rollout, step: int, budget: int, longest: int, usual: int) -> str | None:
        """A line after a rollout, once, where no episode has ended for a quarter of the budget, and not
        because they are just long. ``longest``: steps of the longest that runs; ``usual``: of one that is not
        too long.
        """
        if rollout.episodes and self._heard is not None:
            self._heard = step
        if self._heard is None or step - self._heard <= budget / 4 or longest <= usual:
            return None
        since = f"since step {self._heard:,}" if self._heard else "so far"
        self._heard = None
        return (
            f"No episode has finished {since}, at step {step:,}; the longest has run for {longest:,} steps. "
            "Returns are counted when an episode ends. If episodes should end, look at when the task "
            "terminates, or give it a time limit (gymnasium.wrappers.TimeLimit)."
        )

    def add(self, rollout: Rollout) -> dict[str, float]:
        """Count the episodes of a rollout; the metrics of these and of the last RECENT ones."""
        here = [(episode[0], episode[1]) for episode in rollout.episodes]
        self._newest.extend(here)
        self._successes.extend(rollout.successes)
        self.longest = max([self.longest, *(length for _, length in here)])
        found = {"rollout/episodes": float(len(here))}
        for name, episodes in (("ep", self._newest), ("new_ep", here)):
            if episodes:
                found[f"rollout/{name}_rew_mean"], found[f"rollout/{name}_len_mean"] = np.mean(
                    episodes, axis=0
                ).tolist()
        if self._successes:
            found["rollout/success_rate"] = float(np.mean(self._successes))
        return found

    def state(self) -> dict[str, Any]:
        """What `restore` needs, as JSON."""
        longest = self.longest if math.isfinite(self.longest) else None
        return {"newest": list(self._newest), "successes": list(self._successes), "longest": longest}

    def restore(self, state: dict[str, Any]) -> None:
        """Put back a `state`; an empty one is that of an older version."""
        longest = state.get("longest")
        self.longest = math.inf if longest is None else counted(longest)
        newest = [(float(total), counted(length)) for total, length in state.get("newest", [])]
        successes = [float(success) for success in state.get("successes", [])]
        if not np.isfinite([*(total for total, _ in newest), *successes]).all():
            raise ValueError("a return or a success of the finished episodes is not finite")
        self._newest.clear()
        self._newest.extend(newest)
        self._successes.clear()
        self._successes.extend(successes)
