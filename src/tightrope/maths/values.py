"""The critic: its losses, per step and unreduced, in squared units of the return, and how well it fits."""

import torch
from torch import Tensor

from .shapes import require_same_shape


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
