"""Four roles on one trunk: trained and shared weights, and equality with separate models."""

import dataclasses

import numpy as np
import pytest
import torch
from language.tiny import saved

from tightrope.algorithms import ppo
from tightrope.algorithms.optimise import make_optimiser
from tightrope.language.alignment.experience import batch_of, gather, rewards_of
from tightrope.language.data import batching
from tightrope.language.data.batching import length_groups, used_columns
from tightrope.language.data.examples import Prompt
from tightrope.language.model import lora
from tightrope.language.policy.policy_model import PolicyModel
from tightrope.language.policy.roles import make_roles
from tightrope.language.reward.functions import Scores
from tightrope.language.settings import AlignSettings, RLHFSettings

PROMPTS = [Prompt((5, 6, 7), "bcd", {}), Prompt((8, 9), "ef", {}), Prompt((10, 11, 12, 13, 14), "ghijk", {})]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return saved(tmp_path_factory.mktemp("model"))


def settings(folder, **values):
    update = RLHFSettings(minibatch_size=6, num_epochs=2, normalise_advantages=False, learning_rate=1e-2)
    common = {"model": folder, "lora_rank": 4, "batch_size": 6, "samples_per_prompt": 2, "max_new_tokens": 10}
    return AlignSettings(**{**common, "update": update, **values})


def experienced(present):
    roles = make_roles(present, notify=lambda text: None)
    experience = gather(roles, PROMPTS, 1, 0, 2)
    scores = Scores(np.linspace(-1, 2, 6), np.ones(6, bool), {}, {}, {})
    rewards = rewards_of(experience, scores, present, present.kl_beta).rewards
    return roles, experience, rewards, batch_of(experience, rewards, torch.ones(6, dtype=torch.bool), present)


def one_update(roles, batch):
    optimiser = make_optimiser(roles.parameters(), roles.critic_parameters(), roles.settings.update)
    limit = 1e-4
    return ppo.update(
        PolicyModel(roles),
        optimiser,
        batch,
        roles.settings.update,
        np.random.default_rng(0),
        log_ratio_limit=limit,
    )


LAYOUTS = [
    ("lora", "head"),
    ("lora", "adapter"),
    ("lora", "separate"),
    ("full", "head"),
    ("full", "separate"),
]


@pytest.mark.parametrize("tune, critic", LAYOUTS)
@pytest.mark.parametrize("layers", [None, 1])
def test_an_update_moves_policy_and_critic_and_never_the_reference(folder, tune, critic, layers):
    present = settings(folder, tune=tune, critic=critic, lora_layers=layers)
    roles, experience, _, batch = experienced(present)
    assert roles.trunk.cut == (2 if layers == 1 and tune == "lora" else 0)
    before = [p.detach().clone() for p in roles.parameters()]
    metrics = one_update(roles, batch)
    one_update(roles, experienced_again(roles, batch))
    moved = [not torch.equal(a, b) for a, b in zip(before, roles.parameters(), strict=True)]
    assert np.mean(moved) > 0.9, moved
    assert metrics["train/log_ratio_first"] <= 1e-4
    again = gather_reference(roles, experience)
    assert torch.equal(again[experience.real], gather_reference(fresh(present), experience)[experience.real])


@pytest.mark.parametrize("tune, critic", LAYOUTS)
@pytest.mark.parametrize("kl", ["k1-reward", "exact-split"])
def test_the_pass_of_the_rollout_is_the_first_of_the_update(folder, tune, critic, kl):
    """A pass that keeps its graph, with rows in another order, equals a separate pass."""
    roles = fresh(settings(folder, tune=tune, critic=critic, kl=kl))
    parameters = list(roles.parameters())
    with torch.no_grad():
        for p in parameters:
            p += 0.02 * torch.randn(p.shape, generator=torch.Generator().manual_seed(p.numel()))
    experience = gather(roles, PROMPTS, 1, 0, 2, keep=True)
    part = batch_of(experience, experience.logp, torch.ones(6, dtype=torch.bool), roles.settings)
    part = part.select(torch.tensor([4, 0, 3]))
    found, weights = [], torch.linspace(-1, 1, part.mask.numel()).view(part.mask.shape)
    for first_pass in (experience.first_pass, None):
        model = PolicyModel(roles, first_pass=first_pass)
        now = model(part)
        total = (now.logp * weights).sum() + now.values.square().sum()
        total = total + now.kl.sum() if roles.settings.exact_in_loss else total
        gradients = torch.autograd.grad(total, parameters, allow_unused=True, materialize_grads=True)
        assert any(bool(g.any()) for g in gradients) and model.first_pass is None
        found.append([now.logp, now.values, *gradients])
    for kept, own in zip(*found, strict=True):
        torch.testing.assert_close(kept, own, rtol=1e-3, atol=2e-5)


def test_the_pass_of_the_rollout_is_kept_only_where_one_pass_is_an_epoch(folder, monkeypatch):
    present = settings(folder)
    assert present.one_pass and not present.with_values(minibatch_size=5).one_pass
    assert not present.with_values(micro_batch_size=6).one_pass
    roles = fresh(present)
    assert gather(roles, PROMPTS, 1, 0, 2).first_pass is None
    monkeypatch.setattr(batching, "PASS", 0)  # then every length gets its own group
    assert gather(roles, PROMPTS, 1, 0, 2, keep=True).first_pass is None


def experienced_again(roles, batch):
    """The same rows with the log-probabilities of the current policy."""
    with torch.no_grad():
        now = PolicyModel(roles)(batch)
    return dataclasses.replace(batch, old_logp=now.logp)


def fresh(present):
    return make_roles(present, notify=lambda text: None)


def gather_reference(roles, experience):
    lower = roles.trunk.lower(experience.tokens, experience.real)
    return roles.reference.hidden(experience.tokens, experience.real, lower)


def test_the_lower_part_and_the_adapter_critic_change_nothing(folder):
    """One trunk in two halves with the critic on it, against a trunk in one piece: the same update."""
    found = []
    for share in (True, False):
        roles, _, _, batch = experienced(settings(folder, critic="adapter", lora_layers=2))
        assert "lower" in batch.inputs
        if not share:
            inputs = {name: x for name, x in batch.inputs.items() if name != "lower"}
            batch = dataclasses.replace(batch, inputs=inputs)
        one_update(roles, batch)
        found.append([p.detach() for p in roles.parameters()])
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("critic", ["head", "adapter"])
def test_micro_batches_add_up(folder, critic):
    gradients = []
    for micro in (None, 1, 4):
        roles, _, _, batch = experienced(settings(folder, critic=critic))
        shake(roles)
        update = dataclasses.replace(
            roles.settings.update, micro_batch_size=micro, num_epochs=1, max_grad_norm=None
        )
        optimiser = torch.optim.SGD(roles.parameters(), lr=0.0)
        ppo.update(PolicyModel(roles), optimiser, batch, update, np.random.default_rng(0))
        gradients.append([p.grad.clone() for p in roles.parameters()])
    for other in gradients[1:]:
        for a, b in zip(gradients[0], other, strict=True):
            assert (a - b).norm() <= 1e-4 * a.norm() + 1e-7  # only the order of sums differs


def shake(roles):
    generator = torch.Generator().manual_seed(1)
    for parameter in roles.parameters():
        parameter.data += 0.05 * torch.randn(parameter.shape, generator=generator)


@pytest.mark.parametrize(
    "name", ["old_logp", "old_values", "advantages", "returns", "ref_logp", "tokens", "lower"]
)
def test_poison_in_the_padding_changes_nothing(folder, name):
    """NaN, or any token, where the mask is False: the same gradient to the bit."""
    found = []
    for poisoned in (False, True):
        roles, _, _, batch = experienced(settings(folder, lora_layers=2))
        shake(roles)
        if poisoned:
            batch = poison(batch, name)
        optimiser = torch.optim.SGD(roles.parameters(), lr=0.0)
        ppo.update(PolicyModel(roles), optimiser, batch, roles.settings.update, np.random.default_rng(0))
        found.append([p.grad.clone() for p in roles.parameters()])
    for a, b in zip(*found, strict=True):
        assert torch.equal(a, b) and a.isfinite().all()


def poison(batch, name):
    if name == "tokens":
        wrong = torch.where(batch.inputs["real"], batch.inputs["tokens"], 33)
        return dataclasses.replace(batch, inputs={**batch.inputs, "tokens": wrong})
    if name == "lower":
        outside = ~batch.inputs["real"][..., None]
        wrong = torch.where(outside, 1e4, batch.inputs["lower"])  # padding's own states: any finite number
        return dataclasses.replace(batch, inputs={**batch.inputs, "lower": wrong})
    if name == "ref_logp":
        wrong = torch.where(batch.mask, batch.inputs["ref_logp"], torch.nan)
        return dataclasses.replace(batch, inputs={**batch.inputs, "ref_logp": wrong})
    return dataclasses.replace(batch, **{name: torch.where(batch.mask, getattr(batch, name), torch.nan)})


def test_trimmed_keeps_every_state_that_is_asked_for():
    real = torch.tensor([[0, 0, 1, 1, 1, 0, 0], [0, 1, 1, 1, 1, 1, 0]]).bool()
    assert used_columns(real, real[:, 4:]) == (1, 5)


def test_rows_of_different_lengths_go_in_groups_of_like_ones():
    prompts, responses = torch.tensor([3, 40, 3, 40, 3, 40, 3, 40] * 8), torch.tensor([2, 20] * 32)
    columns = torch.arange(60)
    real = (columns >= 40 - prompts[:, None]) & (columns < 40 + responses[:, None])
    groups = length_groups(real, real[:, 40:])
    assert sorted(torch.cat(groups).tolist()) == list(range(64))
    assert len(groups) == 2 and all(prompts[rows].unique().numel() == 1 for rows in groups)
    assert len(length_groups(real[:1].expand(64, -1), real[:1, 40:].expand(64, -1))) == 1


def test_groups_change_neither_statistics_nor_gradients(folder, monkeypatch):
    roles, _, _, batch = experienced(settings(folder, critic="separate"))
    found = []
    for most, overhead in ((1, 64), (4, 0)):
        monkeypatch.setattr(batching, "MOST_GROUPS", most)
        monkeypatch.setattr(batching, "PASS", overhead)
        groups = len(length_groups(batch.inputs["real"], batch.mask))
        assert (groups > 1) == (most > 1)
        now = PolicyModel(roles)(batch)
        weights = torch.linspace(-1, 1, now.logp.numel()).view_as(now.logp)
        gradients = torch.autograd.grad((weights * (now.logp + now.values)).sum(), roles.parameters())
        found.append([x.detach() for x in (now.logp, now.values, now.entropy, *gradients)])
    for one, other in zip(*found, strict=True):
        assert float((one - other).norm()) <= 1e-5 * float(one.norm()) + 1e-6


def test_the_score_lands_on_the_last_real_token_and_advantages_are_brute_force(folder):
    """Every response: reward of step t is -kl_beta k1 and the score at the end; returns are sums by hand."""
    present = settings(folder)
    _, experience, rewards, batch = experienced(present)
    mask, gamma, lam = experience.responses.mask, 1.0, 0.95
    score = np.linspace(-1, 2, 6)
    for row in range(6):
        length = int(mask[row].sum())
        k1 = experience.responses.logp[row] - experience.ref_logp[row]
        wanted = -present.kl_beta * k1[:length]
        wanted[length - 1] += score[row]
        torch.testing.assert_close(rewards[row, :length], wanted)
        assert (rewards[row, length:] == 0).all()
        values = [*experience.values[row, :length].tolist(), 0.0]
        for t in range(length):
            deltas = [float(wanted[k]) + gamma * values[k + 1] - values[k] for k in range(t, length)]
            by_hand = sum((gamma * lam) ** k * delta for k, delta in enumerate(deltas))
            assert float(batch.advantages[row, t]) == pytest.approx(by_hand, abs=1e-5)


def test_truncated_responses_are_terminal_or_bootstrapped(folder):
    """One token, cut: terminal, the advantage is r - V; bootstrapped, r + V(next) - V."""
    for truncation, share in (("terminal", 0.0), ("bootstrap", 1.0)):
        present = settings(folder, truncation=truncation, max_new_tokens=1, ignore_eos=True)
        roles = fresh(present)
        torch.nn.init.constant_(roles.critic_head.bias, 0.7)
        experience = gather(roles, PROMPTS, 1, 0, 2)
        zero = torch.zeros(6, 1)
        batch = batch_of(experience, zero, torch.ones(6, dtype=torch.bool), present)
        torch.testing.assert_close(batch.advantages, zero + 0.7 * share - 0.7)


def test_critic_none_subtracts_what_the_other_responses_got(folder):
    present = settings(folder, critic="none", kl_beta=0.0)
    _, experience, _, _ = experienced(settings(folder))
    scores = Scores(np.array([1.0, 3.0, 0.0, 5.0, 2.0, 2.0]), np.ones(6, bool), {}, {}, {})
    rewards = rewards_of(experience, scores, present, 0.0).rewards
    batch = batch_of(experience, rewards, torch.ones(6, dtype=torch.bool), present)
    assert [float(row[0]) for row in batch.advantages] == [-2.0, 2.0, -5.0, 5.0, 0.0, 0.0]
    assert (batch.returns == 0).all()


def test_a_sample_that_does_not_count_is_left_out(folder):
    present = settings(folder)
    _, experience, _, _ = experienced(present)
    valid = torch.tensor([True, False, True, True, False, True])
    scores = Scores(np.where(valid, 1.0, np.nan), valid.numpy(), {}, {}, {})
    batch = batch_of(experience, rewards_of(experience, scores, present, 0.05).rewards, valid, present)
    assert len(batch) == 4 and batch.advantages.isfinite().all()


def test_a_job_that_cannot_fit_is_refused_before_it_is_loaded(folder, monkeypatch):
    from tightrope.language import memory
    from tightrope.language.policy import roles as module

    monkeypatch.setattr(memory, "available_memory", lambda device: 1000)
    monkeypatch.setattr(module, "load_causal", lambda *_: pytest.fail("weights were loaded"))
    with pytest.raises(ValueError, match="available"):
        make_roles(settings(folder), notify=lambda text: None)


def test_the_adapters_of_policy_and_critic_are_different_ones(folder):
    roles = fresh(settings(folder, critic="adapter"))
    policy, critic = (lora.adapter_parameters(roles.model, name) for name in ("policy", "critic"))
    assert not {id(p) for p in policy} & {id(p) for p in critic}
    assert not torch.equal(policy[0], critic[0])
