"""The table of metrics is complete and closed."""

from __future__ import annotations

import re

import pytest

from tightrope.metrics.language import LANGUAGE_TABLE
from tightrope.metrics.table import _TABLE, FAMILIES, METRICS, check_names, of_story

KNOWN_TO_USERS = [
    "rollout/ep_rew_mean",
    "rollout/ep_len_mean",
    "rollout/episodes",
    "rollout/new_ep_rew_mean",
    "rollout/new_ep_len_mean",
    "rollout/success_rate",
    "rollout/action_clip_fraction",
    "rollout/observation_outlier_fraction",
    "rollout/environment_restarts",
    "time/fps",
    "time/seconds",
    "train/approx_kl",
    "train/kl_after",
    "train/clip_fraction",
    "train/clip_fraction_high",
    "train/clip_fraction_low",
    "train/policy_gradient_loss",
    "train/value_loss",
    "train/return_mean",
    "train/return_deviation",
    "train/reward_scale",
    "train/entropy",
    "train/explained_variance",
    "train/learning_rate",
    "train/critic_learning_rate",
    "train/clip",
    "train/entropy_weight",
    "train/kl_beta",
    "train/grad_norm",
    "train/ratio_min",
    "train/ratio_max",
    "train/log_ratio_first",
    "train/micro_batch_size",
    "train/memory_halvings",
    "train/rollbacks",
    "train/minibatches",
    "eval/mean_reward",
    "eval/std_reward",
    "eval/mean_length",
    "eval/episodes",
    "eval/cut_episodes",
    "eval/success_rate",
    "time/env_seconds",
    "time/act_seconds",
    "time/update_seconds",
    "time/checkpoint_seconds",
    "time/checkpoint_megabytes",
]

LANGUAGE = [
    "objective/kl",
    "objective/kl_k2",
    "objective/kl_k3",
    "objective/kl_exact",
    "objective/kl_token_mean",
    "objective/kl_beta",
    "objective/scores",
    "objective/scores_std",
    "objective/rlhf_reward",
    "objective/non_score_reward",
    "objective/entropy",
    "objective/entropy_exact",
    "objective/entropy_token_mean",
    "objective/response_length",
    "objective/eos_fraction",
    "objective/truncated_fraction",
    "objective/masked_samples",
    "objective/distinct_2",
    "objective/gold_predicted_peak_kl",
    "objective/sampling_gap",
    "train/kl_loss",
    "train/ptx_loss",
    "time/generate_seconds",
    "time/score_seconds",
    "time/tokens_per_second",
    "sft/loss",
    "sft/held_out_loss",
    "sft/learning_rate",
    "sft/grad_norm",
    "sft/tokens",
    "reward/loss",
    "reward/accuracy",
    "reward/held_out_accuracy",
    "reward/calibration_error",
    "reward/margin",
    "eval/gold",
    "eval/gold_masked",
]


def test_a_metric_that_is_never_logged_is_not_declared() -> None:
    """Gold scores belong to held-out prompts, eval/gold."""
    assert "objective/gold" not in METRICS


def test_the_tolerance_of_language_is_documented_with_the_ratios() -> None:
    from tightrope.language.generation.sample import LOG_RATIO_LIMIT

    assert f"language: up to {LOG_RATIO_LIMIT:g}" in METRICS["train/log_ratio_first"].doc


def test_every_promised_name_is_declared() -> None:
    assert set(KNOWN_TO_USERS) | set(LANGUAGE) <= set(METRICS)


@pytest.mark.parametrize("name", METRICS)
def test_every_entry_is_complete(name: str) -> None:
    metric = METRICS[name]
    assert re.fullmatch(r"[a-z]+/[a-z_0-9]+", name)
    assert metric.name == name
    assert metric.unit
    assert metric.doc.endswith(".")
    assert metric.good in ("up", "down", "inside", "any")
    if metric.good == "inside":
        assert metric.low is not None
        assert metric.high is not None
        assert metric.healthy == f"{metric.low:g} to {metric.high:g}"
    if metric.low is not None and metric.high is not None:
        assert metric.low < metric.high


def test_a_name_outside_the_table_is_refused_with_the_near_one() -> None:
    with pytest.raises(ValueError, match=r"train/aprox_kl.*Did you mean 'train/approx_kl'"):
        check_names(["train/entropy", "train/aprox_kl"])
    with pytest.raises(ValueError, match="not a declared metric"):
        check_names(["loss"])
    check_names(METRICS)


def test_each_story_has_its_own_table() -> None:
    control = [metric.name for metric in of_story("control")]
    language = [metric.name for metric in of_story("language")]
    assert set(control) == set(KNOWN_TO_USERS)
    assert set(LANGUAGE) <= set(language)
    assert not set(LANGUAGE) & set(control)
    assert set(control) | set(language) == set(METRICS)
    assert {"train/approx_kl", "train/value_loss", "time/seconds"} <= set(language)
    assert not [name for name in language if name.startswith("rollout/")]


def test_no_metric_is_declared_twice() -> None:
    assert len(METRICS) == len(_TABLE) + len(LANGUAGE_TABLE)


@pytest.mark.parametrize("prefix", FAMILIES)
def test_a_family_takes_the_users_words_and_not_none(prefix: str) -> None:
    assert prefix.endswith("/") and FAMILIES[prefix].doc.endswith(".")
    check_names([f"{prefix}my reward", f"{prefix}x"])
    with pytest.raises(ValueError, match="not a declared metric"):
        check_names([prefix])
    with pytest.raises(ValueError, match="not a declared metric"):
        check_names([f"un{prefix}x"])
