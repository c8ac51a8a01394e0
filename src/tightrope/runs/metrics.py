"""Every metric, declared once: name, unit, sign, healthy range, meaning. What is not in the table cannot be
logged.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Good = Literal["up", "down", "inside", "any"]


@dataclass(frozen=True, kw_only=True)
class Metric:
    """One number of a run.

    ``good`` says how to read it: ``up`` and ``down`` name the better direction, ``inside`` means that it
    belongs between ``low`` and ``high``, ``any`` that it describes and does not judge. ``negative`` is True
    where values below 0 are possible. ``low`` and ``high`` bound the healthy range; None where there is no
    such bound.
    """

    name: str
    unit: str
    good: Good
    doc: str
    negative: bool = False
    low: float | None = None
    high: float | None = None

    @property
    def healthy(self) -> str:
        """The healthy range in words; an empty string where there is none."""
        if self.low is not None and self.high is not None:
            return f"{self.low:g} to {self.high:g}"
        if self.low is not None:
            return f"at least {self.low:g}"
        return f"at most {self.high:g}" if self.high is not None else ""


def _metric(
    name: str,
    unit: str,
    good: Good,
    doc: str,
    negative: bool = False,
    low: float | None = None,
    high: float | None = None,
) -> Metric:
    return Metric(name=name, unit=unit, good=good, doc=doc, negative=negative, low=low, high=high)


_TABLE = (
    _metric(
        "rollout/ep_rew_mean",
        "reward",
        "up",
        "Mean return of the training episodes that ended in this rollout.",
        negative=True,
    ),
    _metric(
        "rollout/ep_len_mean",
        "steps",
        "any",
        "Mean length of the training episodes that ended in this rollout.",
    ),
    _metric("rollout/episodes", "episodes", "any", "Episodes that ended in this rollout."),
    _metric("time/fps", "steps/s", "up", "Agent steps per second of this update."),
    _metric(
        "time/seconds", "s", "any", "Seconds of training so far; evaluations and saving are not counted."
    ),
    _metric("time/env_seconds", "s", "down", "Seconds of this update that the environments took."),
    _metric("time/act_seconds", "s", "down", "Seconds of this update that choosing actions took."),
    _metric(
        "time/update_seconds", "s", "down", "Seconds of this update that advantages and gradient steps took."
    ),
    _metric(
        "train/approx_kl",
        "nats",
        "inside",
        "k3 estimate of KL(old || new): mean of ratio - 1 - log ratio, never negative; above 0.05 for "
        "several updates the policy moves too far on old data.",
        low=0.0,
        high=0.05,
    ),
    _metric(
        "train/clip_fraction",
        "fraction",
        "inside",
        "Share of steps whose ratio lies outside the clip; always 0: steps too timid, above 0.3: too bold.",
        low=0.0,
        high=0.3,
    ),
    _metric(
        "train/clip_fraction_high", "fraction", "inside", "Share of ratios above 1 + clip.", low=0.0, high=0.2
    ),
    _metric(
        "train/clip_fraction_low", "fraction", "inside", "Share of ratios below 1 - clip.", low=0.0, high=0.2
    ),
    _metric(
        "train/policy_gradient_loss",
        "advantage",
        "any",
        "Mean clipped surrogate with the sign turned: minimised. Small and about 0; its size is no progress.",
        negative=True,
    ),
    _metric(
        "train/value_loss",
        "return^2",
        "down",
        "Half the critic's mean squared error; rises with the returns as a policy learns.",
    ),
    _metric(
        "train/entropy",
        "nats",
        "any",
        "Mean entropy +H of the policy (stable-baselines3's entropy_loss is -H); falls as it commits itself; "
        "negative values are normal for Box actions, whose density may exceed 1.",
        negative=True,
    ),
    _metric(
        "train/explained_variance",
        "fraction",
        "up",
        "1 - Var(returns - values) / Var(returns) on the rollout: 1 a perfect critic, 0 = a constant, "
        "below 0 worse than that.",
        negative=True,
        low=0.0,
        high=1.0,
    ),
    _metric("train/learning_rate", "1", "any", "Adam's step size in this update.", high=1e-2),
    _metric(
        "train/critic_learning_rate", "1", "any", "Adam's step size of the critic in this update.", high=1e-2
    ),
    _metric("train/clip", "1", "any", "The clip in this update; above 0.3 it hardly acts.", high=0.3),
    _metric("train/entropy_weight", "1", "any", "Weight of the entropy bonus in this update.", high=0.1),
    _metric("train/kl_beta", "1", "any", "Weight of the KL penalty in this update."),
    _metric(
        "train/grad_norm",
        "1",
        "any",
        "Mean norm of all gradients together, before it is limited to max_grad_norm.",
    ),
    _metric(
        "train/ratio_min",
        "1",
        "inside",
        "Smallest ratio new/old probability of the update.",
        low=0.1,
        high=1.0,
    ),
    _metric(
        "train/ratio_max",
        "1",
        "inside",
        "Largest ratio new/old probability of the update.",
        low=1.0,
        high=10.0,
    ),
    _metric(
        "train/log_ratio_first",
        "nats",
        "down",
        "Largest |log ratio| before the first gradient step: 0 up to rounding: what is sampled is trained.",
        low=0.0,
        high=1e-5,
    ),
    _metric("train/minibatches", "steps", "any", "Optimiser steps of this update; fewer after a KL stop."),
    _metric("eval/mean_reward", "reward", "up", "Mean return of the evaluation episodes.", negative=True),
    _metric("eval/std_reward", "reward", "any", "Standard deviation of the evaluation episodes' returns."),
    _metric("eval/mean_length", "steps", "any", "Mean length of the evaluation episodes."),
    _metric("eval/episodes", "episodes", "any", "Number of evaluation episodes."),
)

METRICS: dict[str, Metric] = {metric.name: metric for metric in _TABLE}


def check_names(names: Iterable[str]) -> None:
    """Raise ValueError for the first name that is not in the table, with the nearest one that is."""
    for name in names:
        if name not in METRICS:
            near = difflib.get_close_matches(str(name), METRICS, n=1, cutoff=0.5)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            raise ValueError(
                f"{name!r} is not a declared metric.{hint} Metrics are declared in tightrope.runs.metrics."
            )
