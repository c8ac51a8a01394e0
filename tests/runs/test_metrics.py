"""The table of metrics is complete and closed."""

from __future__ import annotations

import re

import pytest

from tightrope.runs.metrics import METRICS, check_names

KNOWN_TO_USERS = [
    "rollout/ep_rew_mean",
    "rollout/ep_len_mean",
    "rollout/episodes",
    "time/fps",
    "time/seconds",
    "train/approx_kl",
    "train/clip_fraction",
    "train/clip_fraction_high",
    "train/clip_fraction_low",
    "train/policy_gradient_loss",
    "train/value_loss",
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
    "train/minibatches",
    "eval/mean_reward",
    "eval/std_reward",
    "eval/mean_length",
    "eval/episodes",
    "time/env_seconds",
    "time/act_seconds",
    "time/update_seconds",
]


def test_every_promised_name_is_declared() -> None:
    assert set(KNOWN_TO_USERS) <= set(METRICS)


@pytest.mark.parametrize("name", METRICS)
def test_every_entry_is_complete(name: str) -> None:
    metric = METRICS[name]
    assert re.fullmatch(r"[a-z]+/[a-z_]+", name)
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
