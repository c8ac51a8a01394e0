"""The metrics of a rollout, each beside the number that its text in the table gives by hand."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tightrope.language.alignment.figures import rollout_metrics
from tightrope.language.reward.functions import Scores
from tightrope.metrics.table import METRICS

NAN = math.nan


def rollout(stopped=None):
    """Responses of 2, 3 and 1 tokens; the last one does not count. Padding holds NaN."""
    mask = torch.tensor([[True, True, False], [True, True, True], [True, False, False]])
    logp = torch.tensor([[-1.0, -2.0, NAN], [-1.0, -1.0, -4.0], [-0.5, NAN, NAN]])
    ref_logp = torch.tensor([[-1.5, -1.0, NAN], [-2.0, -1.0, -4.0], [-2.5, NAN, NAN]])
    sampled = torch.where(mask, logp + torch.tensor([0.0, 3e-6, 0.0]), NAN)
    responses = SimpleNamespace(
        mask=mask, logp=sampled, ended=torch.tensor([True, False, True]), stopped=stopped
    )
    tokens = [[5, 6], [6, 5, 6], [7]]
    experience = SimpleNamespace(
        responses=responses, logp=logp, ref_logp=ref_logp, ids=tokens, seconds=0.5,
        exact=torch.tensor([[0.25, 0.5, NAN], [0.5, 0.0, 0.25], [1.5, NAN, NAN]]),
        entropy=torch.tensor([[1.0, 2.0, NAN], [2.0, 2.0, 2.0], [3.0, NAN, NAN]]),
    )  # fmt: skip
    valid = torch.tensor([True, True, False])
    scores = Scores(np.array([1.0, 3.0, NAN]), valid.numpy(), {}, {}, {})
    rewards = torch.tensor([[0.5, 1.0, NAN], [-0.5, 0.0, 3.0], [9.0, NAN, NAN]])
    share = torch.tensor([[-0.5, 1.0, NAN], [-0.5, 0.0, 0.0], [9.0, NAN, NAN]])
    return rollout_metrics(experience, scores, rewards, share, valid)


BY_HAND = {
    # k1 = logp - ref_logp: 0.5, -1 | 1, 0, 0 | 2;  sums -0.5, 1, 2
    "objective/kl": 2.5 / 3,
    "objective/kl_k2": (0.125 + 0.5 + 0.5 + 2.0) / 3,
    # ratio - 1 - log ratio with the ratio ref / policy: e^-k1 - 1 + k1
    "objective/kl_k3": sum(math.exp(-k) - 1 + k for k in (0.5, -1.0, 1.0, 0.0, 0.0, 2.0)) / 3,
    "objective/kl_exact": (0.75 + 0.75 + 1.5) / 3,
    "objective/kl_token_mean": 2.5 / 6,
    "objective/entropy": (3.0 + 6.0 + 0.5) / 3,
    "objective/entropy_exact": (3.0 + 6.0 + 3.0) / 3,
    "objective/entropy_token_mean": 9.5 / 6,
    "objective/scores": 2.0,
    "objective/scores_std": 1.0,
    "objective/rlhf_reward": (1.5 + 2.5) / 2,  # of the two that count
    "objective/non_score_reward": (0.5 - 0.5) / 2,
    "objective/response_length": 2.0,
    "objective/eos_fraction": 2 / 3,
    "objective/truncated_fraction": 1 / 3,
    "objective/masked_samples": 1.0,
    "objective/distinct_2": 2 / 3,  # 56 | 65 56 | none
    "objective/sampling_gap": 3e-6,
    "time/generate_seconds": 0.5,
    "time/tokens_per_second": 12.0,
}


@pytest.mark.parametrize("name", BY_HAND)
def test_a_metric_is_what_its_text_says(name):
    assert rollout()[name] == pytest.approx(BY_HAND[name], rel=0.2 if name.endswith("gap") else 1e-6)


def test_every_metric_of_a_rollout_has_a_number_by_hand():
    assert set(rollout()) == set(BY_HAND) <= set(METRICS)


def test_a_mean_over_tokens_is_the_sum_over_responses_by_their_length():
    found = rollout()
    for name in ("kl", "entropy"):
        by_length = found[f"objective/{name}"] / found["objective/response_length"]
        assert found[f"objective/{name}_token_mean"] == pytest.approx(by_length)


def test_a_stop_string_is_counted_apart_from_eos():
    found = rollout(stopped=torch.tensor([True, False, False]))
    parts = [found[f"objective/{name}_fraction"] for name in ("eos", "stop", "truncated")]
    assert parts == pytest.approx([1 / 3, 1 / 3, 1 / 3])
