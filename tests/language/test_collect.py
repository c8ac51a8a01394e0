"""From responses to a batch: values of the right state, scores at the right token, correct metrics."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from language.test_roles import PROMPTS, fresh, settings, shake
from language.tiny import saved, tiny_llama

from tightrope.language.alignment.experience import batch_of, gather, has_baseline, rewards_of
from tightrope.language.alignment.figures import rollout_metrics
from tightrope.language.alignment.iteration import PolicyModel
from tightrope.language.reward.functions import Scores

EVERY = torch.ones(6, dtype=torch.bool)


STOPS = tuple(range(3, 20))  # many, so that responses end soon and at different lengths


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    model = tiny_llama()
    model.generation_config.eos_token_id = list(STOPS)
    return saved(tmp_path_factory.mktemp("model"), model)


def experienced(present, **micro):
    """Slightly trained roles, and their samples."""
    present = dataclasses.replace(present, update=dataclasses.replace(present.update, **micro))
    roles = fresh(present)
    shake(roles)
    return roles, gather(roles, PROMPTS, 1, 0, 2)


def scores_of(*values):
    total = np.array(values, float)
    return Scores(total, np.isfinite(total), {}, {}, {})


SCORES = scores_of(*np.linspace(-1, 2, 6))


@pytest.mark.parametrize("critic", ["head", "adapter", "separate"])
@pytest.mark.parametrize("layers", [None, 1])
def test_a_value_is_the_critics_of_the_text_before_the_token(folder, critic, layers):
    """Each response alone and unpadded; temperature is the policy's and changes no value."""
    roles, experience = experienced(settings(folder, critic=critic, lora_layers=layers, temperature=0.5))
    rewards = rewards_of(experience, SCORES, roles.settings, 0.05).rewards
    batch = batch_of(experience, rewards, EVERY, roles.settings)
    with torch.no_grad():
        trained = PolicyModel(roles)(batch).values
    for row in range(6):
        text = experience.tokens[row][experience.real[row]][None]
        length, all_real = int(experience.responses.mask[row].sum()), torch.ones_like(text, dtype=torch.bool)
        with torch.no_grad():
            hidden = (roles.critic or roles.policy).hidden(text, all_real)[0]
            every = roles.critic_head(hidden)[:, 0]  # of every prefix: attention is causal
        wanted = every[-length - 1 : -1]
        torch.testing.assert_close(experience.values[row, :length], wanted, rtol=1e-3, atol=1e-4)
        torch.testing.assert_close(trained[row, :length], wanted, rtol=1e-3, atol=1e-4)
        torch.testing.assert_close(experience.final_values[row], every[-1], rtol=1e-3, atol=1e-4)
    assert experience.values.std() > 0.1


def test_responses_of_different_lengths_have_their_score_at_their_own_end(folder):
    """Rewards by hand, advantages as brute-force sums, with a non-trivial critic."""
    roles, experience = experienced(settings(folder, temperature=0.7))
    rewards = rewards_of(experience, SCORES, roles.settings, 0.05).rewards
    batch = batch_of(experience, rewards, EVERY, roles.settings)
    lengths = experience.responses.mask.sum(1).tolist()
    assert len(set(lengths)) > 2 and max(lengths) == 10
    for row, length in enumerate(lengths):
        wanted = -0.05 * (experience.responses.logp[row] - experience.ref_logp[row])[:length]
        wanted[-1] += SCORES.total[row]
        torch.testing.assert_close(rewards[row, :length], wanted)
        assert not rewards[row, length:].any() and int(batch.mask[row].sum()) == length
        values = [*experience.values[row, :length].tolist(), 0.0]
        deltas = [float(wanted[t]) + values[t + 1] - values[t] for t in range(length)]
        for t in range(length):
            by_hand = sum(0.95 ** (k - t) * deltas[k] for k in range(t, length))
            assert float(batch.advantages[row, t]) == pytest.approx(by_hand, abs=1e-4)


@pytest.mark.parametrize("micro", [1, 4])
def test_looking_at_responses_in_parts_changes_nothing(folder, micro):
    present = settings(folder, lora_layers=1, kl="exact-split", top_k=9)
    (_, whole), (_, parts) = (experienced(present, micro_batch_size=size) for size in (None, micro))
    for name in ("tokens", "logp", "ref_logp", "entropy", "exact", "values", "final_values", "ref_hidden"):
        torch.testing.assert_close(getattr(parts, name), getattr(whole, name), rtol=1e-3, atol=1e-4)


def poisoned(experience):
    """NaN in every number after the end of a response."""
    mask = experience.responses.mask
    names = ("logp", "ref_logp", "entropy", "exact", "values")
    dirty = {name: torch.where(mask, getattr(experience, name), torch.nan) for name in names}
    responses = dataclasses.replace(
        experience.responses, logp=torch.where(mask, experience.responses.logp, torch.nan)
    )
    return dataclasses.replace(experience, responses=responses, **dirty)


@pytest.mark.parametrize("values", [{}, {"truncation": "bootstrap", "kl": "exact-split"}, {"critic": "none"}])
@pytest.mark.parametrize("whiten", [False, True])
def test_nan_behind_a_response_reaches_no_reward_advantage_or_metric(folder, values, whiten):
    roles, clean = experienced(settings(folder, whiten_rewards=whiten, **values))
    assert not clean.responses.mask.all()
    found = []
    for experience in (clean, poisoned(clean)):
        given = rewards_of(experience, SCORES, roles.settings, 0.05)
        rewards, scale, share = given.rewards, given.scale, given.kl_share
        batch = batch_of(experience, rewards, EVERY, roles.settings)
        numbers = (rewards, batch.advantages, batch.returns)
        found.append([scale, *(x[batch.mask] for x in numbers)])
        found[-1] += rollout_metrics(experience, SCORES, rewards, share, EVERY).values()
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)


def test_a_response_that_ended_is_terminal_where_cut_ones_are_bootstrapped(folder):
    """With V = 0.7 everywhere and no reward, the last advantage is -0.7, or 0 if the critic bootstraps."""
    ended = torch.tensor([True, False] * 3)
    for truncation, cut in (("terminal", -0.7), ("bootstrap", 0.0)):
        present = settings(folder, truncation=truncation)
        roles = fresh(present)
        torch.nn.init.constant_(roles.critic_head.bias, 0.7)
        experience = gather(roles, PROMPTS, 1, 0, 2)
        responses = dataclasses.replace(experience.responses, ended=ended)
        experience = dataclasses.replace(experience, responses=responses)
        batch = batch_of(experience, torch.zeros(6, 10), EVERY, present)
        last = batch.advantages[torch.arange(6), experience.responses.mask.sum(1) - 1]
        torch.testing.assert_close(last, torch.where(ended, -0.7, cut))


def test_tokens_of_which_the_policy_is_certain_count(folder):
    """Their log-probability is 0: only the mask decides which tokens count, never a number."""
    roles, experience = experienced(settings(folder, top_k=1))
    mask = experience.responses.mask
    assert (experience.responses.logp[mask] == 0).all() and (experience.logp[mask] == 0).all()
    rewards = rewards_of(experience, SCORES, roles.settings, 0.0).rewards
    assert torch.equal(batch_of(experience, rewards, EVERY, roles.settings).mask, mask)
    torch.testing.assert_close(rewards.sum(1), torch.from_numpy(SCORES.total).float())
    assert [len(ids) for ids in experience.ids] == mask.sum(1).tolist()


def test_every_stop_of_the_generation_settings_ends_a_response_and_pays_no_penalty(folder):
    """The penalty is subtracted from the score, which still distinguishes responses."""
    roles, experience = experienced(settings(folder, missing_eos_penalty=1.5, max_new_tokens=3))
    assert roles.eos == STOPS
    responses, rows = experience.responses, torch.arange(6)
    last = responses.tokens[rows, experience.responses.mask.sum(1) - 1]
    assert torch.equal(responses.ended, torch.isin(last, torch.tensor(STOPS)))
    assert responses.ended.any() and not responses.ended.all() and (last[responses.ended] != 3).any()
    rewards = rewards_of(experience, SCORES, roles.settings, 0.0).rewards
    wanted = torch.from_numpy(SCORES.total).float() - 1.5 * ~responses.ended
    places = (rows, responses.mask.sum(1) - 1)
    torch.testing.assert_close(rewards, torch.zeros(6, 3).index_put(places, wanted))


def test_whitened_rewards_are_divided_by_the_deviation_of_what_counts_and_keep_their_mean(folder):
    _, experience = experienced(settings(folder))
    mask, scores = experience.responses.mask, scores_of(1, 2, math.nan, 4, -1, 3)
    experience.ref_logp[2] -= 50.0  # a response that does not count has no say in the scale
    usual = rewards_of(experience, scores, settings(folder), 0.5)
    whitened = rewards_of(experience, scores, settings(folder, whiten_rewards=True), 0.5)
    plain, found, scale = usual.rewards, whitened.rewards, whitened.scale
    assert torch.equal(usual.kl_share, whitened.kl_share)
    counting = mask & torch.from_numpy(scores.valid)[:, None]
    assert usual.scale == 1.0 and scale == pytest.approx(
        1 / float(plain[counting].std(correction=0)), rel=1e-4
    )
    torch.testing.assert_close(found, plain * scale)
    assert abs(float(found[counting].mean())) > 0.01


def test_every_metric_of_a_rollout_by_hand():
    """Three responses of 2, 3 and 1 tokens; sums over a response, means where named so. The second has no
    score: it counts in the metrics of the policy, but not in those of the reward.
    """
    nan = math.nan
    mask = torch.tensor([[True, True, False], [True, True, True], [True, False, False]])
    logp = torch.tensor([[-1.0, -2.0, nan], [-9.0, -9.0, -9.0], [-0.5, nan, nan]])
    ref_logp = torch.tensor([[-1.5, -1.0, nan], [-1.0, -1.0, -1.0], [-0.25, nan, nan]])
    sampled = logp + torch.tensor([[0.01, -0.03, 9.0], [0.02, 0.0, 0.0], [0.0, 9.0, 9.0]])
    responses = SimpleNamespace(
        tokens=torch.zeros(3, 3),
        mask=mask,
        logp=sampled,
        ended=torch.tensor([True, True, False]),
        stopped=None,
    )
    experience = SimpleNamespace(
        responses=responses, logp=logp, ref_logp=ref_logp, seconds=2.0,
        entropy=torch.tensor([[0.4, 0.6, nan], [7.0, 7.0, 7.0], [0.5, nan, nan]]),
        exact=torch.tensor([[0.1, 0.2, nan], [7.0, 7.0, 7.0], [0.6, nan, nan]]),
        ids=[[5, 6], [5, 6, 5], [7]],
    )  # fmt: skip
    rewards = torch.tensor([[-0.1, 1.0, 0.0], [5.0, 5.0, 5.0], [0.5, 0.0, 0.0]])
    share = torch.tensor([[-0.1, -0.2, nan], [5.0, 5.0, 5.0], [0.1, nan, nan]])
    found = rollout_metrics(
        experience, scores_of(1.0, nan, 0.5), rewards, share, torch.tensor([True, False, True])
    )
    k1 = [0.5, -1.0, -8.0, -8.0, -8.0, -0.25]  # log p - log p_ref, negative ones too
    wanted = {
        "objective/kl": sum(k1) / 3,
        "objective/kl_token_mean": sum(k1) / 6,
        "objective/kl_k2": sum(x * x / 2 for x in k1) / 3,
        "objective/kl_k3": sum(math.exp(-x) - 1 + x for x in k1) / 3,
        "objective/kl_exact": 21.9 / 3,
        "objective/scores": 0.75,
        "objective/scores_std": 0.25,
        "objective/rlhf_reward": 1.4 / 2,
        "objective/non_score_reward": -0.2 / 2,
        "objective/entropy": 30.5 / 3,
        "objective/entropy_exact": 22.5 / 3,
        "objective/entropy_token_mean": 30.5 / 6,
        "objective/response_length": 2.0,
        "objective/eos_fraction": 2 / 3,
        "objective/truncated_fraction": 1 / 3,
        "objective/masked_samples": 1.0,
        "objective/distinct_2": 2 / 3,
        "objective/sampling_gap": 0.03,
        "time/generate_seconds": 2.0,
        "time/tokens_per_second": 3.0,
    }
    assert found == {name: pytest.approx(value, rel=1e-6, abs=1e-6) for name, value in wanted.items()}


def test_without_a_signal_nothing_is_learnt_from_rounding(folder):
    """Sampling and training differ by 1e-7; normalised advantages would turn that into full steps."""
    roles = fresh(settings(folder))
    experience = gather(roles, PROMPTS, 1, 0, 2)
    assert not torch.equal(experience.responses.logp, experience.logp)
    rewards = rewards_of(experience, scores_of(*[0.0] * 6), roles.settings, 0.05).rewards
    assert not rewards.any()
    assert not batch_of(experience, rewards, EVERY, roles.settings).advantages.any()


def test_the_share_of_the_kl_has_nothing_of_the_score(folder):
    _, experience = experienced(settings(folder))
    experience.ref_logp -= 0.5
    for values in ({"reward_scale": 2.0}, {"reward_clip": 1.0}, {"missing_eos_penalty": 3.0}, {}):
        present = settings(folder, **values)
        given = rewards_of(experience, SCORES, present, 0.1)
        found = rollout_metrics(experience, SCORES, given.rewards, given.kl_share, EVERY)
        assert found["objective/non_score_reward"] == pytest.approx(-0.1 * found["objective/kl"], rel=1e-5)


def test_where_no_response_counts_the_kl_is_known_and_the_score_is_not(folder):
    """A KL of 0 there would disable every budget, and add a false point to the over-optimisation curve."""
    _, experience = experienced(settings(folder))
    experience.ref_logp -= 1.0
    nothing = torch.zeros(6, 10)
    some = rollout_metrics(experience, scores_of(*range(6)), nothing, nothing, EVERY)
    none = rollout_metrics(experience, scores_of(*[math.nan] * 6), nothing, nothing, ~EVERY)
    assert none["objective/kl"] == some["objective/kl"] > 1
    assert math.isnan(none["objective/scores"]) and math.isnan(none["objective/rlhf_reward"])


def test_in_bfloat16_the_first_ratios_are_1_though_sampling_rounds_otherwise(folder):
    """The old log-probabilities come from the training pass, not from the KV cache."""
    roles, experience = experienced(settings(folder, dtype="bfloat16"))
    batch = batch_of(experience, torch.zeros(6, 10), EVERY, roles.settings)
    with torch.no_grad():
        now = PolicyModel(roles)(batch).logp
    trained = (now - batch.old_logp)[batch.mask].abs().max()
    sampled = (now - experience.responses.logp)[batch.mask].abs().max()
    assert trained < 1e-3 < 1e-2 < sampled


def test_a_response_without_a_valid_sibling_has_no_baseline():
    valid = np.array([True, False, False, True, True, True, True, False, False])
    assert has_baseline(valid, 3).tolist() == [False] * 3 + [True] * 3 + [False] * 3
    assert has_baseline(np.array([True, True, False]), 3).tolist() == [True, True, False]
