"""Running statistics of observations and rewards, frozen during a rollout and its update and moved after it,
and the scale of returns, which the update moves before its first step.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from tightrope.algorithms.batch import scale_metrics
from tightrope.algorithms.nonfinite import require_restorable
from tightrope.control.settings import TrainSettings
from tightrope.control.spaces.structure import Array, Inputs
from tightrope.maths.statistics import RunningMoments
from tightrope.maths.values import ReturnScale

EDGE = 10.0  # deviations from the mean
JITTER = 1e-12  # a smaller deviation is rounding of a task's own sums


class ObservationNormaliser:
    """z = (x - mean) / deviation on the columns that are Box observations, in float64.

    Beyond +-EDGE z grows as a logarithm only, sign(z) (EDGE + log(1 + |z| - EDGE)): an outlier stays bounded,
    and of two numbers the larger stays the larger. A column that has been constant so far is divided by the
    size of its constant (or 1). Moments are those of x - ``origin`` [D], the first row: the sums of large
    numbers that differ little would round their differences away. ``mean`` and ``inverse_std`` [D] are what a
    rollout uses; they change only in ``update``. ``old``, for runs up to 2026-11-22: float32,
    sqrt(variance + 1e-8), and a clip at +-EDGE.
    """

    def __init__(self, continuous: Array, old: bool = False) -> None:
        self.continuous, self.old = continuous, old
        self.moments, self.origin = RunningMoments.empty(len(continuous)), np.zeros(len(continuous))
        self._freeze()

    @property
    def ready(self) -> bool:
        """Whether there are statistics; before, numbers are taken as they are."""
        return float(self.moments.count) > 1

    def _freeze(self) -> None:
        mean, std = self.origin + self.moments.mean.numpy(), np.sqrt(self.moments.variance.numpy())
        size = np.abs(mean)
        scale = np.where(std > JITTER, std, np.where(size > JITTER, size, 1.0))
        if self.old:
            scale = np.sqrt(self.moments.variance.numpy() + 1e-8)
        seen = self.continuous & self.ready
        self.mean, self.inverse_std = np.where(seen, mean, 0.0), np.where(seen, 1.0 / scale, 1.0)

    def __call__(self, flat: Array) -> Array:
        """Normalised copy of [..., D], float32."""
        kind: Any = np.float32 if self.old else np.float64
        flat, mean, inverse_std = (x.astype(kind, copy=False) for x in (flat, self.mean, self.inverse_std))
        z = (flat - mean) * inverse_std
        far = np.abs(z) - EDGE
        if (far > 0).any():
            beyond = 0.0 if self.old else np.log1p(np.maximum(far, 0.0))
            z = np.where(far > 0, np.sign(z) * (EDGE + beyond), z)
        return z.astype(np.float32)

    def update(self, flat: Array) -> None:
        """Add the raw observations [N, D] of a rollout, which has been learned from or is the warm-up."""
        if float(self.moments.count) == 0 and len(flat) and not self.old:
            self.origin = flat[0].astype(np.float64)
        self.moments = self.moments.update(torch.from_numpy(flat - self.origin))
        self._freeze()

    def state(self) -> dict[str, torch.Tensor]:
        """Tensors to save."""
        return {**vars(self.moments), "origin": torch.from_numpy(self.origin)}

    def load(self, state: dict[str, torch.Tensor]) -> None:
        """Load saved tensors."""
        self.moments = RunningMoments(state["count"], state["mean"], state["variance"])
        self.origin = state["origin"].numpy().copy()
        self._freeze()


class RewardNormaliser:
    """r / sqrt(Var(R)), where R_t = r_t + gamma R_{t-1} restarts after either kind of end.

    Neither is the mean subtracted nor anything clipped: either would change which policy is best.
    ``deviation`` is the present scale, 1 while all R are alike.
    """

    def __init__(self, num_envs: int, gamma: float) -> None:
        self.gamma, self.running = gamma, np.zeros(num_envs)
        self.moments = RunningMoments.empty(1)

    @property
    def deviation(self) -> float:
        """What rewards are divided by, and values multiplied by to be in the task's units."""
        return float(np.sqrt(float(self.moments.variance))) or 1.0

    def __call__(self, rewards: Array) -> Array:
        """Scaled rewards."""
        return rewards / self.deviation

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
    """Both normalisers, and the scale in which the critic learns; None for one whose setting is off."""

    def __init__(
        self,
        observations: ObservationNormaliser | None,
        rewards: RewardNormaliser | None,
        returns: ReturnScale | None = None,
    ) -> None:
        self.observations, self.rewards, self.returns = observations, rewards, returns

    @classmethod
    def of(cls, continuous: Array, num_envs: int, settings: TrainSettings) -> Normalisers:
        """Those that a run's settings ask for; ``continuous`` bool [D]: as in ObservationLayout."""
        seen = settings.normalise_observations and len(continuous) > 0
        observations = ObservationNormaliser(continuous, settings.encoder == "old") if seen else None
        rewards = RewardNormaliser(num_envs, settings.update.gamma) if settings.normalise_rewards else None
        # without a baseline there is no critic to learn anything
        learned = settings.update.normalise_values and getattr(settings.update, "baseline", True)
        return cls(observations, rewards, ReturnScale() if learned else None)

    @property
    def ready(self) -> bool:
        """Whether a rollout may be learned from: observations have statistics, where they are normalised."""
        return self.observations is None or self.observations.ready

    def encode(self, inputs: Inputs) -> Inputs:
        """Raw inputs as the networks see them."""
        if "flat" not in inputs:
            return inputs
        flat = inputs["flat"]
        seen = flat.astype(np.float32) if self.observations is None else self.observations(flat)
        return {**inputs, "flat": seen}

    def scaled_rewards(self, rollout: Any) -> Array:
        """The rewards of a rollout, normalised. The first rollout of all is scaled by its own statistics:
        there are no others.
        """
        assert self.rewards is not None
        if float(self.rewards.moments.count) == 0:
            self.rewards.update(rollout.rewards, rollout.ended, rollout.mask)
            rollout.reward_statistics_taken = True
        return self.rewards(rollout.rewards)

    def update(self, rollout: Any) -> None:
        """Move the statistics of observations and rewards, after the update on this rollout."""
        if self.observations is not None:
            self.observations.update(rollout.raw[rollout.mask])
        if self.rewards is not None and not rollout.reward_statistics_taken:
            self.rewards.update(rollout.rewards, rollout.ended, rollout.mask)

    def metrics(self) -> dict[str, float]:
        """The present scales of returns and rewards."""
        found = scale_metrics(self.returns)
        if self.rewards is not None:
            found["train/reward_scale"] = self.rewards.deviation
        return found

    def state(self) -> dict[str, torch.Tensor]:
        """All tensors, with the kind as prefix."""
        parts = {"observations": self.observations, "rewards": self.rewards}
        found = {
            f"{k}.{n}": x for k, part in parts.items() if part is not None for n, x in part.state().items()
        }
        if self.returns is not None:
            numbers = vars(self.returns).items()
            found |= {f"returns.{name}": torch.tensor(x, dtype=torch.float64) for name, x in numbers}
        return found

    def load(self, state: dict[str, torch.Tensor]) -> None:
        """Load a `state`. ValueError for statistics of other observations: the compiled engine
        would read beyond them.
        """
        for kind, part in {"observations": self.observations, "rewards": self.rewards}.items():
            if part is not None:
                prefix = f"{kind}."
                found = {k.removeprefix(prefix): x for k, x in state.items() if k.startswith(prefix)}
                if kind == "observations":
                    found.setdefault("origin", torch.zeros_like(found["mean"]))  # missing in old runs
                for name, own in part.state().items():
                    low = 0.0 if name in ("count", "variance") else -math.inf
                    require_restorable(f"{prefix}{name}", found[name], own, at_least=low)
                part.load(found)
        if self.returns is not None:
            self.returns = ReturnScale(*(float(state[f"returns.{name}"]) for name in vars(self.returns)))
