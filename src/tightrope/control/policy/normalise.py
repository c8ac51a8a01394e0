"""Running statistics of observations and rewards: frozen during a rollout and its update, moved after it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from tightrope.algorithms.nonfinite import require_restorable
from tightrope.control.spaces import Array, Inputs
from tightrope.maths.statistics import RunningMoments

CLIP = 10.0


class ObservationNormaliser:
    """(x - mean) / sqrt(variance + 1e-8), clipped to +-10, on the columns that are Box observations.

    ``mean`` and ``inverse_std`` [D] float32 are what a rollout uses; they change only in ``update``.
    """

    def __init__(self, continuous: Array) -> None:
        self.continuous = continuous
        self.moments = RunningMoments.empty(len(continuous))
        self._freeze()

    def _freeze(self) -> None:
        mean, std = self.moments.mean.numpy(), np.sqrt(self.moments.variance.numpy() + 1e-8)
        seen = float(self.moments.count) > 1
        self.mean = np.where(self.continuous & seen, mean, 0.0).astype(np.float32)
        self.inverse_std = np.where(self.continuous & seen, 1.0 / std, 1.0).astype(np.float32)

    def __call__(self, flat: Array) -> Array:
        """Normalised copy of [..., D] float32."""
        return np.clip((flat - self.mean) * self.inverse_std, -CLIP, CLIP)

    def update(self, flat: Array) -> None:
        """Add the raw observations [N, D] of a rollout that has been learned from."""
        self.moments = self.moments.update(torch.from_numpy(flat))
        self._freeze()

    def state(self) -> dict[str, torch.Tensor]:
        """Tensors to save."""
        return dict(vars(self.moments))

    def load(self, state: dict[str, torch.Tensor]) -> None:
        """Load saved tensors."""
        self.moments = RunningMoments(state["count"], state["mean"], state["variance"])
        self._freeze()


class RewardNormaliser:
    """r / sqrt(Var(R) + 1e-8), clipped to +-10, where R_t = r_t + gamma R_{t-1} restarts after either kind of
    end.

    The mean is not subtracted: that would change which policy is best. ``deviation`` is the present scale.
    """

    def __init__(self, num_envs: int, gamma: float) -> None:
        self.gamma, self.running = gamma, np.zeros(num_envs)
        self.moments = RunningMoments.empty(1)

    @property
    def deviation(self) -> float:
        """What rewards are divided by, and values multiplied by to be in the task's units."""
        return float(np.sqrt(float(self.moments.variance) + 1e-8)) if float(self.moments.count) > 1 else 1.0

    def __call__(self, rewards: Array) -> Array:
        """Scaled rewards, float32."""
        return np.clip(rewards / self.deviation, -CLIP, CLIP).astype(np.float32)

    def update(self, rewards: Array, ended: Array, mask: Array) -> None:
        """Add the raw rewards [B, T] of a rollout; masked steps do not exist."""
        series = np.empty_like(rewards)
        for t in range(rewards.shape[1]):
            stepped = self.running * self.gamma + rewards[:, t]
            series[:, t] = stepped
            self.running = np.where(ended[:, t], 0.0, np.where(mask[:, t], stepped, self.running))
        self.moments = self.moments.update(torch.from_numpy(series[mask][:, None]))

    def restart(self, num_envs: int) -> None:
        """New episodes begin: another environment, or a resumed run."""
        self.running = np.zeros(num_envs)

    def state(self) -> dict[str, torch.Tensor]:
        """Tensors to save."""
        return {**vars(self.moments), "running": torch.from_numpy(self.running.copy())}

    def load(self, state: dict[str, torch.Tensor]) -> None:
        """Load saved tensors."""
        self.moments = RunningMoments(state["count"], state["mean"], state["variance"])
        self.running = state["running"].numpy().copy()


class Normalisers:
    """Both normalisers; None for one whose setting is off."""

    def __init__(self, observations: ObservationNormaliser | None, rewards: RewardNormaliser | None) -> None:
        self.observations, self.rewards = observations, rewards

    def encode(self, inputs: Inputs) -> Inputs:
        """Raw inputs as the networks see them."""
        if self.observations is None or "flat" not in inputs:
            return inputs
        return {**inputs, "flat": self.observations(inputs["flat"])}

    def scaled_rewards(self, rollout: Any) -> Array:
        """The rewards of a rollout to learn from, float32. The first rollout of all is scaled by its own
        statistics: there are no others.
        """
        if self.rewards is None:
            return rollout.rewards.astype(np.float32)
        if float(self.rewards.moments.count) == 0:
            self.rewards.update(rollout.rewards, rollout.ended, rollout.mask)
            rollout.reward_statistics_taken = True
        return self.rewards(rollout.rewards)

    def update(self, rollout: Any) -> None:
        """Move the statistics, after the update on this rollout."""
        if self.observations is not None:
            self.observations.update(rollout.raw[rollout.mask])
        if self.rewards is not None and not rollout.reward_statistics_taken:
            self.rewards.update(rollout.rewards, rollout.ended, rollout.mask)

    def state(self) -> dict[str, torch.Tensor]:
        """All tensors, with the kind as prefix."""
        parts = {"observations": self.observations, "rewards": self.rewards}
        return {
            f"{k}.{n}": x for k, part in parts.items() if part is not None for n, x in part.state().items()
        }

    def load(self, state: dict[str, torch.Tensor]) -> None:
        """Load a `state`. ValueError for statistics of other observations: the compiled engine
        would read beyond them.
        """
        for kind, part in {"observations": self.observations, "rewards": self.rewards}.items():
            if part is not None:
                prefix = f"{kind}."
                found = {k.removeprefix(prefix): x for k, x in state.items() if k.startswith(prefix)}
                for name, own in part.state().items():
                    low = 0.0 if name in ("count", "variance") else -math.inf
                    require_restorable(f"{prefix}{name}", found[name], own, at_least=low)
                part.load(found)
