"""The arrays of a rollout, and the checks that they pass before anything is learned from them."""

from __future__ import annotations

import numpy as np
from torch import nn

from tightrope.algorithms.nonfinite import NonFiniteError, first_bad
from tightrope.control.engine.base import Acted
from tightrope.control.environments.base import Environments
from tightrope.control.environments.faults import action_text, circumstances
from tightrope.control.spaces import Inputs
from tightrope.errors import TightropeError

Array = np.ndarray


class BadNumbers(TightropeError, ValueError):
    """An environment returned a NaN or an infinity; nothing was learned from it."""


class Rollout:
    """What happened in T steps of B environments, in arrays [B, T, ...] that are allocated once.

    ``mask`` False: not a transition. That is NEXT_STEP's reset row, or, with ``ended`` beside it, the step in
    which an environment failed and was restarted; its input is the last observation of the episode that was
    cut, from whose value the step before it is bootstrapped.

    ``inputs``: what the policy saw (normalised). ``raw``: flat observations, and ``rewards``, as they came.
    ``last``: encoded observation after the last step. ``finals``: (column, rows, encoded true final
    observations) of truncated episodes whose next row already belongs to a new episode.
    """

    def __init__(
        self, environments: Environments, num_steps: int, *, keep_raw: bool, has_masks: bool
    ) -> None:
        layout = environments.observation_layout
        actions = environments.action_layout
        shape = (environments.num_envs, num_steps)
        self.inputs: Inputs = {}
        if layout.size:
            self.inputs["flat"] = np.zeros((*shape, layout.size), np.float32)
        for i, image in enumerate(layout.image_shapes):
            self.inputs[f"image{i}"] = np.zeros((*shape, *image), np.uint8)
        self.raw = self.inputs.get("flat", np.zeros((*shape, 0)))
        if keep_raw:
            self.raw = np.zeros_like(self.inputs["flat"])
        if has_masks:
            self.inputs["action_mask"] = np.ones((*shape, actions.num_logits), bool)
        self.actions = np.zeros((*shape, actions.num_columns), np.float32)
        self.logp = np.zeros(shape, np.float32)
        self.rewards = np.zeros(shape, np.float64)
        self.terminated = np.zeros(shape, bool)
        self.truncated = np.zeros(shape, bool)
        self.mask = np.ones(shape, bool)
        self.ended = np.zeros(shape, bool)
        self.last: Inputs = {}
        self.finals: list[tuple[int, Array, Inputs]] = []
        self.episodes: list[tuple[float, int, bool]] = []
        self.reward_statistics_taken = False
        self.env_seconds = 0.0
        self.restarts: int | None = None  # of environments; None: the settings do not allow it

    @property
    def steps(self) -> int:
        """How many transitions there are."""
        return int(self.mask.sum())

    def clear(self) -> None:
        """Make the arrays ready to be filled again."""
        self.mask.fill(True)
        self.ended.fill(False)
        self.finals = []
        self.reward_statistics_taken = False

    def acted(self, rows: slice, t: int) -> Acted:
        """Where an engine writes what it does in ``rows`` at step ``t``."""
        inputs = {name: x[rows, t] for name, x in self.inputs.items()}
        return Acted(inputs, self.actions[rows, t], self.logp[rows, t])


# --------------------------------------------------------------------------------------------------- checks


def check_numbers(
    rollout: Rollout, environments: Environments, last: Inputs, num_steps: int, first_step: int
) -> None:
    """Raise BadNumbers for the first NaN or infinity that an environment returned in ``num_steps`` columns.

    ``last``: observations after the last step, as they came. ``first_step``: number of the first column.
    """
    rows = np.arange(len(rollout.logp))
    # what, numbers [N, t, k], their rows, the step of the first, the column of the action that led there
    checks = [("observation", rollout.raw[:, :num_steps], rows, first_step, -1)]
    checks.append(("reward", rollout.rewards[:, :num_steps, None], rows, first_step, 0))
    if "flat" in last:
        checks.append(("observation", last["flat"][:, None], rows, first_step + num_steps, num_steps - 1))
    for t, final_rows, x in rollout.finals:
        if "flat" in x:
            checks.append(("final observation", x["flat"][:, None], final_rows, first_step + t + 1, t))
    for what, numbers, which, first, column in checks:
        good = np.isfinite(numbers)
        if good.all():
            continue
        place, t, index = np.argwhere(~good)[0]
        row = int(which[place])
        where = f"step {first + t}" + ("" if what == "reward" else f", index {index}")
        action = None
        if column + t >= 0:
            chosen = rollout.actions[row, column + t]
            action = action_text(environments.action_layout.to_env_single(chosen, environments.squash))
        raise BadNumbers(
            f"Environment {row} of {environments.spec_id} returned {what} = {numbers[place, t, index]} at "
            f"{where}{circumstances(environments.worker_of(row), environments.seed_of(row), action)}; "
            "expected finite numbers. The policy was not updated with it. Fix the environment, or clip and "
            "check its state there; --on-env-fault restart restarts it and continues."
        )


def check_policy(rollout: Rollout, policy: nn.Module, num_steps: int, first_step: int) -> None:
    """NonFiniteError when the policy gave a log-probability that is not finite; a bad weight is named."""
    bad = ~np.isfinite(rollout.logp[:, :num_steps])
    if not bad.any():
        return
    row, t = np.argwhere(bad)[0]
    weight = first_bad((f"the weight {name}", p) for name, p in policy.named_parameters())
    raise NonFiniteError(
        f"The policy gave the log-probability {rollout.logp[row, t]} to its action in environment {row} at "
        f"step {first_step + t}; expected a finite number"
        + (f", but {weight}. " if weight else ": its logits overflow. ")
        + "It was not updated with this rollout. Look for a learning rate that is too high."
    )
