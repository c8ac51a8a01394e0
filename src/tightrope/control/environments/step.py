"""The arrays through which copies of an environment speak, and what a step of all of them gave.

They are preallocated, and shared memory where workers step the copies.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tightrope.control.spaces import ActionLayout, Inputs, ObservationLayout


class Step(NamedTuple):
    """What one step of all B copies gave; rewards and flags are good until the next step."""

    inputs: Inputs  # what the next action is chosen from
    action_mask: np.ndarray | None  # bool [B, L], for the next action
    rewards: np.ndarray  # float64 [B]
    terminated: np.ndarray  # bool [B]
    truncated: np.ndarray  # bool [B]; never True where terminated is
    phantom: np.ndarray | None  # bool [B]: NEXT_STEP's reset, no transition; None: there is none in this step
    final_rows: np.ndarray | None  # int [F]: truncated rows whose ``inputs`` are the next episode's already
    final_inputs: Inputs | None  # [F, ...]: the true last observations of these rows
    cut: np.ndarray | None = None  # bool [B]: made anew after a fault; this step did not take place there


@dataclass(frozen=True, eq=False)
class Slots:
    """The arrays through which N copies speak; row i belongs to copy i."""

    inputs: Inputs
    final_inputs: Inputs
    actions: np.ndarray  # float32 [N, A], already squashed where that was asked for
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    masks: np.ndarray  # bool [N, L]
    cut: np.ndarray  # bool [N]: made anew in this step
    renewals: np.ndarray  # int64 [N]: how often made anew since all were reset
    under_way: np.ndarray  # int64 [N]: in the first place of a group the row it is stepping, else -1

    @classmethod
    def allocate(
        cls,
        num: int,
        observations: ObservationLayout,
        actions: ActionLayout,
        zeros: Callable[..., Any] = np.zeros,
    ) -> Slots:
        """Slots for ``num`` copies; ``zeros(shape, dtype)`` makes each array."""
        return cls(
            inputs=observations.allocate(num, zeros),
            final_inputs=observations.allocate(num, zeros),
            actions=zeros((num, actions.num_columns), np.float32),
            rewards=zeros((num,), np.float64),
            terminated=zeros((num,), np.bool_),
            truncated=zeros((num,), np.bool_),
            masks=zeros((num, actions.num_logits), np.bool_),
            cut=zeros((num,), np.bool_),
            renewals=zeros((num,), np.int64),
            under_way=zeros((num,), np.int64),
        )

    def map(self, function: Callable[[Any], Any]) -> Slots:
        """The same slots with ``function`` applied to each array."""
        return Slots(
            {name: function(array) for name, array in self.inputs.items()},
            {name: function(array) for name, array in self.final_inputs.items()},
            *(function(a) for a in (self.actions, self.rewards, self.terminated, self.truncated, self.masks)),
            *(function(a) for a in (self.cut, self.renewals, self.under_way)),
        )

    def step(self, has_masks: bool) -> Step:
        """A copy of what the last step left here."""
        rows = np.flatnonzero(self.truncated) if self.truncated.any() else None
        return Step(
            {name: array.copy() for name, array in self.inputs.items()},
            self.masks.copy() if has_masks else None,
            self.rewards.copy(),
            self.terminated.copy(),
            self.truncated.copy(),
            None,
            rows,
            None if rows is None else {name: array[rows] for name, array in self.final_inputs.items()},
            self.cut.copy() if self.cut.any() else None,
        )
