"""The critic: the unit it learns in, its losses, per step and unreduced, and how well it fits."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from .statistics import require_same_shape


def squared_error(values: Tensor, returns: Tensor, mask: Tensor | None = None) -> Tensor:
    """0.5 (V - R)^2, [B, T]; its gradient by V is V - R. Both are 0 where masked, whatever lies there.

    ValueError when the shapes differ.
    """
    require_same_shape(values=values, returns=returns, mask=mask)
    error = values - returns
    if mask is not None:
        error = torch.where(mask, error, 0.0)
    return 0.5 * error.square()


def clipped_squared_error(
    values: Tensor, old_values: Tensor, returns: Tensor, value_clip: float, mask: Tensor | None = None
) -> Tensor:
    """0.5 max((V - R)^2, (V_clipped - R)^2), [B, T]; 0 with gradient 0 where masked.

    V_clipped = V_old + clip(V - V_old, -value_clip, value_clip). The max is pessimistic: a value that has
    moved further than value_clip (in units of the return) towards its target gets gradient 0, one that has
    moved away from it is still pulled back. Source: the PPO2 code of OpenAI baselines.
    ValueError when the shapes differ.
    """
    require_same_shape(values=values, old_values=old_values)
    clipped = old_values + (values - old_values).clamp(-value_clip, value_clip)
    return torch.maximum(squared_error(values, returns, mask), squared_error(clipped, returns, mask))


def explained_variance(values: Tensor, returns: Tensor, mask: Tensor) -> Tensor:
    """1 - Var(R - V) / Var(R) over the mask, a scalar.

    1 is a perfect critic, 0 one no better than a constant, below 0 a worse one. Where all returns are equal
    (or none counts) there is nothing to explain, the ratio is undefined and the answer is 0, so that no log
    holds NaN. Summed in float64, where equal float32 returns have a variance of exactly 0.
    ValueError when the shapes differ.
    """
    require_same_shape(values=values, returns=returns, mask=mask)
    kept = returns[mask].double()
    if not kept.numel():
        return values.new_zeros(())
    total, residual = kept.var(correction=0), (kept - values[mask].double()).var(correction=0)
    known = total > 0
    return torch.where(known, 1 - residual / torch.where(known, total, 1.0), 0.0).to(values.dtype)


ROLLOUT_WEIGHT = 0.1  # of the newest rollout in the statistics of returns: about the last ten count
ALIKE = 1e-12  # returns that differ by less, as a share of their mean, differ by the rounding of float64


@dataclass(frozen=True)
class ReturnScale:
    """The unit that a critic learns in: V = mean + deviation * output, in units of the return.

    The targets of the output, (R - mean) / deviation, are of order 1 for rewards of any size, offset and
    rarity. ``mean`` and ``deviation`` are those of the returns of about the last ten rollouts, in float64. A
    deviation of 0 says that all returns so far were alike: outputs then count for nothing, and V = mean. It
    is so before the first rollout, whatever the weights of a new critic say. ``weight``: how much of the
    statistics comes from rollouts, 0 before the first. Nothing is changed in place.
    Source: van Hasselt et al. 2016 (PopArt), https://arxiv.org/abs/1602.07714
    """

    mean: float = 0.0
    deviation: float = 0.0
    weight: float = 0.0

    def __post_init__(self) -> None:
        """ValueError for numbers that no statistics can have."""
        numbers = (self.mean, self.deviation, self.weight)
        if not all(type(x) is float and math.isfinite(x) for x in numbers) or min(numbers[1:]) < 0:
            raise ValueError(f"mean, deviation and weight of returns are {numbers}; expected finite floats, "
                             "the last two at least 0.")  # fmt: skip

    def update(self, returns: Tensor, mask: Tensor) -> "ReturnScale":
        """The scale after a rollout whose steps had these returns; no counting step changes nothing.

        With the share a of this rollout (1 for the first, then falling to 0.1), its mean m and variance v,
        and d = m - mean:  mean' = mean + a d,  deviation'^2 = max(v, (1 - a) deviation^2 + a v + a (1 - a)
        d^2). The maximum keeps targets at order 1 in the rollout in which returns first become large.
        Returns that are not finite change nothing: the check before the step names them. ValueError when the
        shapes differ.
        """
        require_same_shape(returns=returns, mask=mask)
        kept = returns[mask].double()
        if not kept.numel():
            return self
        spread, centre = (float(x) for x in torch.var_mean(kept, correction=0))
        if not math.isfinite(spread):
            return self
        weight = self.weight + ROLLOUT_WEIGHT * (1 - self.weight)
        share = ROLLOUT_WEIGHT / weight
        shift = centre - self.mean
        mean = self.mean + share * shift
        running = (1 - share) * self.deviation**2 + share * spread + share * (1 - share) * shift**2
        deviation = math.sqrt(max(spread, running))
        return ReturnScale(mean, deviation if deviation > ALIKE * abs(mean) else 0.0, weight)

    def values(self, outputs: Tensor) -> Tensor:
        """V in units of the return, float64, of the critic's outputs."""
        return self.mean + self.deviation * outputs.double()

    def outputs(self, values: Tensor) -> Tensor:
        """What the critic has to give for these values, or returns, in the dtype of ``values``."""
        return (values - self.mean) / self.unit

    @property
    def unit(self) -> float:
        """What is 1 in the critic's scale, in units of the return: the deviation; 1 while there is none."""
        return self.deviation or 1.0

    def change(self, new: "ReturnScale") -> tuple[float, float]:
        """a and b such that the output a x + b has the value under ``new`` that x has here.

        a = deviation / new.deviation, b = (mean - new.mean) / new.deviation: values stay, the scale moves.
        1 and 0 where outputs counted for nothing, or will: there is no value to keep.
        """
        if not (self.deviation and new.deviation):
            return 1.0, 0.0
        return self.deviation / new.deviation, (self.mean - new.mean) / new.deviation

    def moved(self, returns: Tensor, mask: Tensor) -> tuple["ReturnScale", tuple[float, float]]:
        """`update` after a rollout, and the `change` to it."""
        new = self.update(returns, mask)
        return new, self.change(new)
