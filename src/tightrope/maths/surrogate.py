"""Surrogate losses: what a step asks of the policy.

Everything is per step, [B, T] in and [B, T] out, unreduced, and is a loss: to be minimised. The ratio
r = pi(a|s) / pi_old(a|s) lives in log space, `log_ratio` = log r, and is masked there, before exp.
Sources: Williams 1992 (policy gradient), Schulman et al. 2017 (PPO, https://arxiv.org/abs/1707.06347),
Ye et al. 2020 (dual clip, https://arxiv.org/abs/1912.09729).
"""

import torch
from torch import Tensor

from .divergence import k3
from .statistics import require_same_shape


def log_ratio(logp: Tensor, old_logp: Tensor, mask: Tensor) -> Tensor:
    """log r = log pi(a|s) - log pi_old(a|s) in nats, [B, T]; exactly 0 with gradient 0 where masked.

    No gradient passes through a masked step: NaN in its advantage, met later on, reaches no parameter.
    ValueError when the shapes differ.
    """
    require_same_shape(logp=logp, old_logp=old_logp, mask=mask)
    return torch.where(mask, logp - old_logp, 0.0)


def clipped_surrogate(
    log_ratio: Tensor,
    advantages: Tensor,
    clip: float,
    clip_high: float | None = None,
    dual_clip: float | None = None,
) -> Tensor:
    """The loss of PPO, [B, T]: -min(r A, clip(r, 1 - clip, 1 + clip_high) A); clip_high None means clip.

    Its gradient by r is 0 where A > 0 and r > 1 + clip_high (encouraged enough) and where A < 0 and r < 1 -
    clip (discouraged enough), and -A everywhere else. With `dual_clip` c > 1 the loss of a step with A < 0
    never exceeds c |A|, so that the gradient is 0 also where A < 0 and r > c. ValueError when the shapes
    differ, or when dual_clip is not above 1.
    """
    require_same_shape(log_ratio=log_ratio, advantages=advantages)
    if dual_clip is not None and dual_clip <= 1:
        raise ValueError(
            f"dual_clip is {dual_clip}, expected above 1 (3 is usual), or None to switch it off."
        )
    high = 1 + (clip if clip_high is None else clip_high)
    # Beyond these limits the loss is flat (exp(x) > x), so nothing changes but that exp cannot overflow
    # there: the gradient of a clipped step would be 0 * inf = NaN.
    limit = torch.where(advantages < 0, torch.inf if dual_clip is None else dual_clip, high)
    ratio = torch.minimum(log_ratio, limit.to(log_ratio.dtype)).exp()
    surrogate = torch.minimum(ratio * advantages, ratio.clamp(1 - clip, high) * advantages)
    if dual_clip is not None:
        bounded = torch.maximum(surrogate, dual_clip * advantages)
        surrogate = torch.where(advantages < 0, bounded, surrogate)
    return -surrogate


def kl_penalised_surrogate(log_ratio: Tensor, advantages: Tensor, kl_beta: float) -> Tensor:
    """The other loss of the PPO paper, [B, T]: -(r A - kl_beta * KL(old || new)), kl_beta in A per nat.

    The KL is estimated per step by k3 = r - 1 - log r. The samples come from the old policy, which the
    gradient does not touch, so the gradient of k3, (r - 1) grad log pi, has the gradient of the KL as its
    expectation. ValueError when the shapes differ.
    """
    require_same_shape(log_ratio=log_ratio, advantages=advantages)
    return -(log_ratio.exp() * advantages - kl_beta * k3(log_ratio))


def policy_gradient(logp: Tensor, advantages: Tensor, mask: Tensor | None = None) -> Tensor:
    """The loss of REINFORCE and A2C, [B, T]: -log pi(a|s) * A; 0 with gradient 0 where masked.

    ValueError when the shapes differ.
    """
    require_same_shape(logp=logp, advantages=advantages, mask=mask)
    if mask is not None:
        logp, advantages = torch.where(mask, logp, 0.0), torch.where(mask, advantages, 0.0)
    return -logp * advantages


def clipped(log_ratio: Tensor, clip: float, clip_high: float) -> tuple[Tensor, Tensor]:
    """Where r > 1 + clip_high, and where r < 1 - clip, whatever the sign of the advantage; bool [B, T]."""
    ratio = log_ratio.detach().exp()
    return ratio > 1 + clip_high, ratio < 1 - clip
