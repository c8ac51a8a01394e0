"""Properties of the surrogate losses: functions of (maths, case), see properties.py."""

import math
from functools import partial
from types import ModuleType

import numpy as np
import torch
from maths_cases import Case, close, poisoned, same, with_gradients
from torch import Tensor


def loss_of_a_step(ratio: float, advantage: float, low: float, high: float, dual: float | None) -> float:
    gain = min(ratio * advantage, min(max(ratio, 1 - low), 1 + high) * advantage)
    return -max(gain, dual * advantage) if dual is not None and advantage < 0 else -gain


CLIPS = ((0.2, None, None), (0.1, 0.4, None), (0.3, None, 2.0), (0.2, 0.3, 1.5))


def clipped_surrogate_is_its_equation(maths: ModuleType, c: Case) -> None:
    for low, high, dual in CLIPS:
        result = maths.surrogate.clipped_surrogate(c.log_ratio, c.advantages, low, high, dual)
        for place in np.ndindex(*result.shape):
            ratio, advantage = math.exp(c.log_ratio[place]), float(c.advantages[place])
            expected = loss_of_a_step(ratio, advantage, low, low if high is None else high, dual)
            assert math.isclose(float(result[place]), expected, rel_tol=1e-9, abs_tol=1e-12)


def the_clip_has_four_cases(maths: ModuleType, c: Case) -> None:
    """The gradient by the ratio is 0 exactly where the step has moved far enough, and -A elsewhere."""
    for low, high, dual in CLIPS:
        log_ratio = c.log_ratio.clone().requires_grad_()
        maths.surrogate.clipped_surrogate(log_ratio, c.advantages, low, high, dual).sum().backward()
        ratio, good, bad = c.log_ratio.exp(), c.advantages > 0, c.advantages < 0
        flat = good & (ratio > 1 + (low if high is None else high)) | bad & (ratio < 1 - low)
        if dual is not None:
            flat |= bad & (ratio > dual)
        assert log_ratio.grad is not None
        by_ratio = log_ratio.grad / ratio
        same(by_ratio[flat], torch.zeros_like(by_ratio[flat]))
        close(by_ratio[~flat], -c.advantages[~flat])


def dual_clip_bounds_the_loss(maths: ModuleType, c: Case) -> None:
    far = c.log_ratio + 50
    loss = maths.surrogate.clipped_surrogate(far, c.advantages, 0.2, None, 3.0)
    bad = c.advantages < 0
    close(loss[bad], 3 * c.advantages[bad].abs())
    unbounded = maths.surrogate.clipped_surrogate(far, c.advantages, 0.2)
    same(loss[~bad], unbounded[~bad])
    assert (unbounded[bad] > 1000 * loss[bad]).all()


def a_clipped_step_never_overflows(maths: ModuleType, c: Case) -> None:
    """exp(1000) is inf, and 0 * inf would be NaN in the gradient of the whole minibatch."""
    advantages = torch.tensor([[1.0, -1.0, -1.0, 0.0]], dtype=torch.float64)
    far = torch.tensor([[1000.0, -1000.0, 1000.0, 1000.0]], dtype=torch.float64)
    loss = partial(maths.surrogate.clipped_surrogate, advantages=advantages, clip=0.2, dual_clip=3.0)
    value, gradient = with_gradients(loss, far)
    close(value, torch.tensor([[-1.2, 0.8, 3.0, 0.0]], dtype=torch.float64))
    same(gradient, torch.zeros_like(far))


def at_ratio_1_ppo_is_the_policy_gradient(maths: ModuleType, c: Case) -> None:
    logp, none = c.log_ratio, torch.ones_like(c.mask)
    surrogate = maths.surrogate

    def ppo(new: Tensor) -> Tensor:
        return surrogate.clipped_surrogate(surrogate.log_ratio(new, logp, none), c.advantages, 0.2, None, 3.0)

    def penalised(new: Tensor) -> Tensor:
        return surrogate.kl_penalised_surrogate(surrogate.log_ratio(new, logp, none), c.advantages, 0.5)

    for loss in (ppo, penalised, partial(surrogate.policy_gradient, advantages=c.advantages)):
        new = logp.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(loss(new).sum(), new)
        close(gradient, -c.advantages)


def masked_log_ratios_are_0(maths: ModuleType, c: Case) -> None:
    """NaN in the padding, or a NaN advantage there, reaches no gradient."""
    advantages = poisoned(c.advantages, ~c.mask)

    def loss(logp: Tensor, old_logp: Tensor, advantages: Tensor) -> Tensor:
        log_ratio = maths.surrogate.log_ratio(logp, old_logp, c.mask)
        same(log_ratio[~c.mask], torch.zeros_like(log_ratio[~c.mask]))
        losses = maths.surrogate.clipped_surrogate(log_ratio, advantages, 0.2)
        losses = losses + maths.surrogate.kl_penalised_surrogate(log_ratio, advantages, 0.1)
        losses = losses + maths.surrogate.policy_gradient(logp, advantages, c.mask)
        return maths.statistics.masked_mean(losses, c.mask)

    clean = with_gradients(partial(loss, advantages=c.advantages), c.log_ratio, c.old_values)
    dirty = (poisoned(c.log_ratio, ~c.mask), poisoned(c.old_values, ~c.mask))
    same(with_gradients(partial(loss, advantages=advantages), *dirty), clean)


def the_kl_penalty_is_its_equation(maths: ModuleType, c: Case) -> None:
    result = maths.surrogate.kl_penalised_surrogate(c.log_ratio, c.advantages, 0.7)
    for place in np.ndindex(*result.shape):
        ratio = math.exp(c.log_ratio[place])
        expected = -(ratio * float(c.advantages[place]) - 0.7 * (ratio - 1 - float(c.log_ratio[place])))
        assert math.isclose(float(result[place]), expected, rel_tol=1e-9, abs_tol=1e-12)


def clip_indicators_see_the_ratio_alone(maths: ModuleType, c: Case) -> None:
    ratio = c.log_ratio.exp()
    high, low = maths.surrogate.clipped(c.log_ratio, 0.1, 0.3)
    same(high, ratio > 1.3)
    same(low, ratio < 0.9)


PROPERTIES = (
    clipped_surrogate_is_its_equation,
    the_clip_has_four_cases,
    dual_clip_bounds_the_loss,
    a_clipped_step_never_overflows,
    at_ratio_1_ppo_is_the_policy_gradient,
    masked_log_ratios_are_0,
    the_kl_penalty_is_its_equation,
    clip_indicators_see_the_ratio_alone,
)
