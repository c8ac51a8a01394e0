"""The episodes that run between two rollouts, and how they are saved and continued."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch

from tightrope.control.environments import state as states
from tightrope.control.rollout import replay
from tightrope.control.spaces.structure import Array, Inputs
from tightrope.runs.growing import GROUP as ACTIONS

Groups = dict[str, dict[str, torch.Tensor]]  # tensors by group and name


class Boundary(NamedTuple):
    """The running episodes between two rollouts. Collecting the next one changes nothing in it."""

    inputs: Inputs  # the observations from which the next actions are chosen, not normalised
    action_mask: Array | None
    returns: Array  # of the running episodes so far
    lengths: Array
    running: replay.Running | None  # None: the environments do not replay
    environments: Any  # the state of a vector environment that gives it, else None


def saved_episodes(at: Boundary) -> tuple[dict[str, Any] | None, dict[str, Array]]:
    """A boundary as JSON, and the logs that grow with it; None where its episodes cannot be continued."""
    found: dict[str, Any] = {"returns": states.encode(at.returns), "lengths": states.encode(at.lengths)}
    if at.running is not None:
        lost = np.array([part is None for part in at.running.parts])
        origins = np.where(lost[:, None] & [False, False, True], -1, at.running.origins)
        found |= {"origins": origins.tolist(), "first": at.running.first.tolist()}
        return {**found, "carried": at.running.carried}, at.running.logs()
    if at.environments is None:
        return None, {}
    seen = {"inputs": at.inputs, "action_mask": at.action_mask, "environments": at.environments}
    return {**found, **{name: states.encode(value) for name, value in seen.items()}}, {}


class Before(NamedTuple):
    """What an update changes before it is complete, as it was."""

    rng: dict[str, Any]
    restarts: int
    boundary: Boundary | None  # None: no episodes are running
    saved: tuple[Any, Groups]

    def episodes(self) -> tuple[Any, Groups]:
        """The running episodes as JSON and tensors."""
        if self.boundary is None:
            return self.saved
        episodes, logs = saved_episodes(self.boundary)
        return episodes, {ACTIONS: {name: torch.from_numpy(x) for name, x in logs.items()}} if logs else {}


def begin(collector: Any, saved: tuple[Any, Groups], seed: int, steps: int) -> list[str]:
    """Continue saved episodes, or begin new ones at an agent step; what is to be told about it."""
    episodes, logs = saved
    if not (isinstance(episodes, dict) and "returns" in episodes):  # older versions saved something else
        collector.reset(seed, steps)  # as number of the episodes: one that is not used yet
        return []
    arrays = {name: tensor.numpy() for name, tensor in logs.get(ACTIONS, {}).items()}
    differences = collector.resume(seed, episodes, arrays)
    if not differences:
        return []
    shown = "; ".join(differences[:3]) + (" ..." if len(differences) > 3 else "")
    return [
        f"{len(differences)} of {collector.environments.num_envs} copies did not repeat their episode from "
        f"its seed and actions, and begin a new one: {shown}. Training goes on, but not with the bits of "
        "a run without a break."
    ]
