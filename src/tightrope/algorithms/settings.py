"""The settings of the update rules; imported without torch."""

from __future__ import annotations

import copy
import dataclasses
from dataclasses import dataclass
from typing import Self

from tightrope.settings.fields import SCHEDULES, Schedule, scheduled, setting
from tightrope.settings.values import Settings


@dataclass(frozen=True, kw_only=True)
class UpdateSettings(Settings):
    """What every update rule of the family reads."""

    gamma: float = setting(
        0.99, "Discount per step: a reward k steps ahead counts gamma^k.", above=0, at_most=1
    )
    gae_lambda: float = setting(
        0.95, "GAE's lambda: 0 = one-step TD error (bias), 1 = Monte Carlo (variance).", at_least=0, at_most=1
    )
    value_weight: float = setting(
        0.5, "Weight of the value loss in the total loss.", at_least=0, needs={"baseline": (True,)}
    )
    entropy_weight: float = setting(
        0.0, "Weight of the entropy bonus; more keeps the policy exploring for longer.", at_least=0
    )
    entropy_weight_schedule: Schedule = setting(
        "constant", "How entropy_weight falls over the run.", choices=SCHEDULES, needs={"entropy_weight": ...}
    )
    learning_rate: float = setting(
        3e-4, "Adam's step size (actor, and critic unless it has its own).", above=0
    )
    critic_learning_rate: float | None = setting(
        None, "Adam's step size for the critic; none: the same.", above=0, needs={"baseline": (True,)}
    )
    learning_rate_schedule: Schedule = setting(
        "linear", "How both learning rates fall over the run.", choices=SCHEDULES
    )
    adam_eps: float = setting(
        1e-5, "Adam's epsilon; 1e-5 is PPO's habit, torch's own default is 1e-8.", above=0, at_most=1
    )
    max_grad_norm: float | None = setting(
        0.5, "One joint limit on the norm of all gradients; none: gradients are not clipped.", above=0
    )
    normalise_advantages: bool = setting(True, "Advantages to mean 0 and deviation 1 within each minibatch.")
    normalise_values: bool = setting(
        True,
        "The critic learns returns at mean 0 and deviation 1; values stay in units of the return.",
        needs={"baseline": (True,)},
        before=False,
    )
    micro_batch_size: int | None = setting(
        None,
        "Rows per forward pass; splits a minibatch to save memory, the gradient stays the same.",
        at_least=1,
    )

    def at(self, progress: float) -> Self:
        """The settings at ``progress`` in [0, 1]: each scheduled number has its present value."""
        names = [f.name for f in dataclasses.fields(self) if f.name.endswith("_schedule")]
        bases = {name.removesuffix("_schedule"): getattr(self, name) for name in names}
        bases["critic_learning_rate"] = self.learning_rate_schedule
        return self.unchecked(
            **{base: scheduled(getattr(self, base), schedule, progress) for base, schedule in bases.items()}
        )

    def unchecked(self, **values: object) -> Self:
        """A copy with these values, not checked: a schedule may end at a value that no user may give."""
        copied = copy.copy(self)
        vars(copied).update(values)
        return copied


@dataclass(frozen=True, kw_only=True)
class PPOSettings(UpdateSettings):
    """Proximal policy optimisation (Schulman et al. 2017)."""

    num_epochs: int = setting(10, "Passes over each rollout; above 15 ratios drift far from 1.", at_least=1)
    minibatch_size: int = setting(64, "Steps per optimiser step (language: responses).", at_least=1)
    clip: float = setting(
        0.2, "The ratio new/old probability may move this far from 1 before its gradient is cut.", above=0
    )
    clip_schedule: Schedule = setting(
        "constant", "How clip falls over the run.", choices=SCHEDULES, needs={"kl_beta": (None,)}
    )
    clip_high: float | None = setting(
        None,
        "Another upper side for the clip (1 + clip_high); none: clip.",
        above=0,
        needs={"kl_beta": (None,)},
    )
    dual_clip: float | None = setting(
        None,
        "Bound the loss of bad actions at dual_clip * |advantage|; none: off, 3 is usual.",
        above=1,
        needs={"kl_beta": (None,)},
    )
    value_clip: float | None = setting(
        None,
        "Also keep value updates within +- this (deviations with normalise_values); none: off.",
        above=0,
    )
    target_kl: float | None = setting(
        None, "Stop the whole update before a step whose minibatch KL exceeds this; 0.015 is usual.", above=0
    )
    kl_beta: float | None = setting(
        None, "Use the KL-penalised surrogate with this weight in place of the clip; none: clip.", above=0
    )
    kl_adapt: float | None = setting(
        None,
        "With kl_beta: the KL per update aimed at, kl_beta doubles or halves to reach it; none: fixed.",
        above=0,
        needs={"kl_beta": ...},
    )
    recompute_advantages: bool = setting(
        False, "Estimate values and advantages again before each later epoch."
    )


@dataclass(frozen=True, kw_only=True)
class A2CSettings(UpdateSettings):
    """Synchronous advantage actor-critic (Mnih et al. 2016): one step per rollout."""


@dataclass(frozen=True, kw_only=True)
class ReinforceSettings(UpdateSettings):
    """REINFORCE (Williams 1992): Monte Carlo returns, one step per rollout."""

    gae_lambda: float = setting(1.0, "REINFORCE is lambda 1: whole returns.", at_least=1, at_most=1)
    baseline: bool = setting(True, "Subtract the critic's value; off: plain returns of finished episodes.")
