"""Every metric: name, unit, sign, healthy range, meaning. Only metrics in this table can be recorded."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Literal

from tightrope.metrics.declare import Metric, metric
from tightrope.metrics.language import LANGUAGE_TABLE

_TABLE = (
    metric(
        "rollout/ep_rew_mean",
        "reward",
        "up",
        "Mean return of the last 100 training episodes.",
        negative=True,
    ),
    metric(
        "rollout/ep_len_mean",
        "steps",
        "any",
        "Mean length of the last 100 training episodes.",
    ),
    metric(
        "rollout/new_ep_rew_mean",
        "reward",
        "up",
        "Mean return of the training episodes that ended in this rollout; absent: none did.",
        negative=True,
    ),
    metric(
        "rollout/new_ep_len_mean",
        "steps",
        "any",
        "Mean length of the training episodes that ended in this rollout; absent: none did.",
    ),
    metric(
        "rollout/success_rate",
        "fraction",
        "up",
        'Share of successes among the last 100 training episodes with info["is_success"] in their last step; '
        "absent: no episode had it.",
        low=0.0,
        high=1.0,
    ),
    metric("rollout/episodes", "episodes", "any", "Episodes that ended in this rollout."),
    metric(
        "rollout/environment_restarts",
        "restarts",
        "down",
        "Environments, or processes of them, restarted after a fault in this rollout; with on_env_fault "
        "restart alone.",
        high=0.0,
    ),
    metric(
        "rollout/action_clip_fraction",
        "fraction",
        "any",
        "Share of the policy's numbers for bounded Box actions that lie outside the bounds and were cut off "
        "there; near 1: the policy only pushes against its bounds. None of these numbers with action_bounds "
        "squash.",
        low=0.0,
        high=0.9,
    ),
    metric(
        "rollout/observation_outlier_fraction",
        "fraction",
        "down",
        "Share of normalised observation numbers beyond 10 deviations, where they grow as a logarithm only; "
        "often above 0.01: their scale still changes, or it has heavy tails.",
        low=0.0,
        high=0.01,
    ),
    metric("time/fps", "steps/s", "up", "Agent steps per second of this update."),
    metric("time/seconds", "s", "any", "Seconds of training so far; evaluations and saving are not counted."),
    metric("time/env_seconds", "s", "down", "Seconds of this update that the environments took."),
    metric("time/act_seconds", "s", "down", "Seconds of this update that choosing actions took."),
    metric(
        "time/update_seconds", "s", "down", "Seconds of this update that advantages and gradient steps took."
    ),
    metric(
        "time/checkpoint_seconds",
        "s",
        "down",
        "Seconds that training waited for the checkpoint before this update: written and read back.",
    ),
    metric("time/checkpoint_megabytes", "MB", "down", "Size of that checkpoint."),
    metric(
        "train/approx_kl",
        "nats",
        "inside",
        "k3 estimate of KL(old || new) in the last epoch: mean of ratio - 1 - log ratio before each of its "
        "steps, never negative; above 0.05 for several updates the policy moves too far on old data.",
        low=0.0,
        high=0.05,
    ),
    metric(
        "train/kl_after",
        "nats",
        "inside",
        "The same on the whole rollout after the last step of the update, which kl_beta is adapted to; with "
        "kl_adapt alone.",
        low=0.0,
        high=0.05,
    ),
    metric(
        "train/clip_fraction",
        "fraction",
        "inside",
        "Share of steps whose ratio lies outside the clip; always 0: steps too timid, above 0.3: too bold.",
        low=0.0,
        high=0.3,
    ),
    metric(
        "train/clip_fraction_high", "fraction", "inside", "Share of ratios above 1 + clip.", low=0.0, high=0.2
    ),
    metric(
        "train/clip_fraction_low", "fraction", "inside", "Share of ratios below 1 - clip.", low=0.0, high=0.2
    ),
    metric(
        "train/policy_gradient_loss",
        "advantage",
        "any",
        "Mean policy term of the loss, for PPO the clipped surrogate with the sign turned: minimised. Small "
        "and about 0; its size is no progress.",
        negative=True,
    ),
    metric(
        "train/value_loss",
        "deviations^2",
        "down",
        "Half the critic's mean squared error, with value_clip the clipped one, in squared deviations of the "
        "return (train/return_deviation); without normalise_values in squared units of the return.",
    ),
    metric(
        "train/return_mean",
        "return",
        "any",
        "With normalise_values: the mean of the returns of about the last ten rollouts, which the critic's "
        "targets are centred on.",
        negative=True,
    ),
    metric(
        "train/return_deviation",
        "return",
        "any",
        "With normalise_values: the deviation of these returns, by which the critic's targets are divided; "
        "0: all returns are alike so far.",
    ),
    metric(
        "train/reward_scale",
        "reward",
        "any",
        "With normalise_rewards: what the rewards of this rollout were divided by.",
    ),
    metric(
        "train/entropy",
        "nats",
        "any",
        "Mean entropy +H of the policy (stable-baselines3's entropy_loss is -H); falls as it commits itself; "
        "negative values are normal for Box actions, whose density may exceed 1.",
        negative=True,
    ),
    metric(
        "train/explained_variance",
        "fraction",
        "up",
        "1 - Var(returns - values) / Var(returns) on the rollout: 1 a perfect critic, 0 = a constant, "
        "below 0 worse than that.",
        negative=True,
        low=0.0,
        high=1.0,
    ),
    metric("train/learning_rate", "1", "any", "Adam's step size in this update.", high=1e-2),
    metric(
        "train/critic_learning_rate", "1", "any", "Adam's step size of the critic in this update.", high=1e-2
    ),
    metric("train/clip", "1", "any", "The clip in this update; above 0.3 it hardly acts.", high=0.3),
    metric("train/entropy_weight", "1", "any", "Weight of the entropy bonus in this update.", high=0.1),
    metric("train/kl_beta", "1", "any", "Weight of the KL penalty in this update."),
    metric(
        "train/grad_norm",
        "1",
        "any",
        "Mean norm of all gradients together, before it is limited to max_grad_norm.",
    ),
    metric(
        "train/ratio_min",
        "1",
        "inside",
        "Smallest ratio new/old probability of the update.",
        low=0.1,
        high=1.0,
    ),
    metric(
        "train/ratio_max",
        "1",
        "inside",
        "Largest ratio new/old probability of the update.",
        low=1.0,
        high=10.0,
    ),
    metric(
        "train/log_ratio_first",
        "nats",
        "down",
        "Largest |log ratio| before the first gradient step of the update: 0 up to rounding: what is sampled "
        "is trained. Range of the control story; language: up to 0.0001 in float32, 1 in bfloat16, more in "
        "deep and wide models (rlhf.md).",
        low=0.0,
        high=1e-5,
    ),
    metric(
        "train/micro_batch_size",
        "rows",
        "any",
        "Rows per forward pass after memory ran out in this update; the gradient is the same.",
    ),
    metric(
        "train/memory_halvings",
        "halvings",
        "down",
        "How often memory ran out in this update and the micro-batches were halved; absent: never.",
        high=0.0,
    ),
    metric(
        "train/rollbacks",
        "rollbacks",
        "down",
        "How often the run went back to a checkpoint after a NaN or an infinity; absent: never.",
        high=0.0,
    ),
    metric("train/minibatches", "steps", "any", "Optimiser steps of this update; fewer after a KL stop."),
    metric("eval/mean_reward", "reward", "up", "Mean return of the evaluation episodes.", negative=True),
    metric("eval/std_reward", "reward", "any", "Standard deviation of the evaluation episodes' returns."),
    metric("eval/mean_length", "steps", "any", "Mean length of the evaluation episodes."),
    metric("eval/episodes", "episodes", "any", "Number of evaluation episodes."),
    metric(
        "eval/cut_episodes",
        "episodes",
        "down",
        "Evaluation episodes that had not ended after evaluation_max_steps; they count with their return and "
        "length so far. Absent: none.",
        high=0.0,
    ),
    metric(
        "eval/success_rate",
        "fraction",
        "up",
        'Share of successes among the evaluation episodes with info["is_success"] in their last step, and of '
        "those that were cut, which are failures; absent: none had it.",
        low=0.0,
        high=1.0,
    ),
)

METRICS: dict[str, Metric] = {m.name: m for m in (*_TABLE, *LANGUAGE_TABLE)}

# Names that only the user knows: a prefix and a word of theirs.
FAMILIES: dict[str, Metric] = {
    family.name: family
    for family in (
        metric(
            "scores/",
            "score",
            "any",
            "Mean score of the reward function of this name, over the responses that it applies to.",
            negative=True,
        ),
        metric(
            "rewards/",
            "responses",
            "down",
            "Responses that the reward function of this name failed to score, as NAME/errors (it raised, or "
            "gave something that is no score) and NAME/timeouts; they are masked. Absent: none.",
            high=0.0,
        ),
        metric(
            "logged/",
            "1",
            "any",
            "What a reward function passed to log_metric under this name, mean over its calls.",
            negative=True,
        ),
    )
}


def of_story(story: Literal["control", "language"]) -> list[Metric]:
    """The metrics that runs of this story may record, in the table's order; families are not among them."""
    language = {m.name for m in LANGUAGE_TABLE}
    shared = [m for name, m in METRICS.items() if name not in language]
    if story == "control":
        return shared
    clock = ("time/fps", "time/seconds", "time/update_seconds")
    both = [m for m in shared if m.name.startswith(("train/", "time/checkpoint_")) or m.name in clock]
    return [*both, *LANGUAGE_TABLE]


def check_names(names: Iterable[str]) -> None:
    """Raise ValueError for the first name that is neither in the table nor begins with the prefix of a
    family. The message suggests the nearest declared name.
    """
    for name in names:
        if name not in METRICS and not any(str(name).startswith(p) and name != p for p in FAMILIES):
            near = difflib.get_close_matches(str(name), METRICS, n=1, cutoff=0.5)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            raise ValueError(
                f"{name!r} is not a declared metric.{hint} Metrics are declared in tightrope.metrics.table."
            )
