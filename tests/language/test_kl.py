"""The KL to the reference: a whole language is enumerated, and expectations are sums over all responses."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from language.tabular import Language, Tabular, advantages_of, gradient_of, objective, with_scores
from torch import Tensor
from torch.distributions import Categorical, kl_divergence

from tightrope.algorithms import ppo
from tightrope.algorithms.batch import Batch
from tightrope.algorithms.settings import PPOSettings
from tightrope.language.alignment.kl import (
    adapted,
    kl_loss,
    kl_rewards,
    shared_scale,
)
from tightrope.language.settings import KL_FORMS, AlignSettings
from tightrope.maths import returns, statistics, surrogate

EXACT = dict(rtol=0, atol=1e-10)
KL_BETA = 0.3


class World:
    """A policy, a reference and scores over one small language."""

    def __init__(self, seed: int, words: int = 3, length: int = 3) -> None:
        self.language = Language(words, length)
        self.policy, self.reference = Tabular(self.language, seed), Tabular(self.language, seed + 100)
        self.reference.requires_grad_(False)
        generator = torch.Generator().manual_seed(seed + 200)
        count = len(self.language.tokens)
        self.scores = torch.randn(count, generator=generator, dtype=torch.float64)

    @property
    def right(self) -> Tensor:
        """The gradient of E[score] - KL_BETA KL by autograd."""
        return gradient_of(objective(self.policy, self.reference, self.scores, KL_BETA), self.policy)

    @property
    def of_scores(self) -> Tensor:
        """The gradient of only E[score]."""
        return gradient_of(objective(self.policy, self.reference, self.scores, 0.0), self.policy)

    def per_state(self, *, forward: bool = False, visits: Tensor | None = None) -> Tensor:
        """The gradient of the states' own KL (or of KL(reference || policy)), weighted by visits."""
        states = self.language.states(self.language.tokens)
        pair = [Categorical(logits=model.logits[states]) for model in (self.policy, self.reference)]
        kl = kl_divergence(*(pair[::-1] if forward else pair))
        often = self.policy.probabilities().detach() if visits is None else visits
        return gradient_of(torch.where(self.language.mask, often[:, None] * kl, 0.0).sum(), self.policy)

    def rewards(self, form: str, scores: Tensor) -> Tensor:
        """Rewards per token of every response: the score at the end, and the form's KL term."""
        tokens, mask = self.language.tokens, self.language.mask
        with torch.no_grad():
            parts = (self.policy.logp(tokens), self.reference.logp(tokens))
            exact = self.policy.exact(tokens, self.reference)
        return with_scores(kl_rewards(form, KL_BETA, *parts, exact, mask), scores, mask)

    def expected(self, form: str, scores: Tensor, values: Tensor, gae_lambda: float = 1.0) -> Tensor:
        """The expected gradient (uphill) of training: the library's own functions, over every response.

        Each response is its own minibatch with count 1, so that its loss is the sum over its steps.
        """
        tokens, mask, policy = self.language.tokens, self.language.mask, self.policy
        logp, ref_logp = policy.logp(tokens), self.reference.logp(tokens)
        exact = policy.exact(tokens, self.reference)
        advantages, _ = advantages_of(self.rewards(form, scores), values, mask, gae_lambda)
        log_ratio = surrogate.log_ratio(logp, logp.detach(), mask)
        steps = surrogate.clipped_surrogate(log_ratio, advantages, 0.2)
        total = torch.zeros((), dtype=torch.float64)
        for row, p in enumerate(policy.probabilities().detach()):
            here = slice(row, row + 1)
            kl = kl_loss(form, logp[here], ref_logp[here], exact[here], mask[here], 1)
            loss = statistics.masked_mean(steps[here], mask[here], 1)
            total = total + p * (loss if kl is None else loss + KL_BETA * kl)
        return -gradient_of(total, policy)

    def some_values(self) -> Tensor:
        """Values of an arbitrary critic: numbers that depend only on the state."""
        return self.policy.values.detach()[self.language.states(self.language.tokens)]

    def true_values(self, form: str) -> Tensor:
        """Values of a perfect critic: the mean return over all responses that pass a state."""
        states, mask = self.language.states(self.language.tokens), self.language.mask
        rewards = self.rewards(form, self.scores)
        to_go = returns.discounted_returns(rewards, torch.zeros_like(mask), 1.0, mask=mask)
        weights = self.policy.probabilities().detach()[:, None] * mask
        sums = torch.zeros(2, self.language.prefixes, dtype=torch.float64)
        sums[0].index_put_((states[mask],), (weights * to_go)[mask], accumulate=True)
        sums[1].index_put_((states[mask],), weights[mask], accumulate=True)
        return torch.where(mask, (sums[0] / sums[1])[states], 0.0)


def off_by(found: Tensor, right: Tensor) -> float:
    """The error of a gradient, relative to its size."""
    return float((found - right).norm() / right.norm())


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("form", ["k1-reward", "exact-split"])
def test_expected_gradient_is_that_of_the_objective(form: str, seed: int) -> None:
    """With any critic, as long as lambda is 1."""
    world = World(seed)
    torch.testing.assert_close(world.expected(form, world.scores, world.some_values()), world.right, **EXACT)


@pytest.mark.parametrize("form", ["k1-reward", "exact-split"])
def test_a_perfect_critic_makes_it_exact_at_any_lambda(form: str) -> None:
    """Rewards match the critic: V(s) is the mean of the rewards after s."""
    world = World(0)
    found = world.expected(form, world.scores, world.true_values(form), gae_lambda=0.3)
    torch.testing.assert_close(found, world.right, **EXACT)
    assert off_by(world.expected(form, world.scores, world.some_values(), gae_lambda=0.3), world.right) > 0.05


@pytest.mark.parametrize("form", ["k2-loss", "exact-loss"])
def test_loss_forms_have_the_gradient_of_the_states_own_kl(form: str) -> None:
    world = World(1)
    found = world.expected(form, world.scores, world.some_values())
    torch.testing.assert_close(found, world.of_scores - KL_BETA * world.per_state(), **EXACT)
    assert off_by(found, world.right) > 0.05, "later states are not seen, so it cannot be the whole gradient"


def test_a_single_state() -> None:
    """Responses of one token: all forms agree with autograd."""
    world = World(3, words=5, length=1)
    for form in KL_FORMS:
        found = world.expected(form, world.scores, world.some_values())
        torch.testing.assert_close(found, world.right, **EXACT)


@pytest.mark.parametrize("form", ["k2-loss", "exact-loss"])
def test_weights_make_up_for_actions_of_an_older_policy(form: str) -> None:
    """Responses are the old policy's; over the states it reached, the gradient is the present policy's."""
    world, old = World(5), Tabular(Language(3, 3), seed=50)
    tokens, mask = world.language.tokens, world.language.mask
    visits = old.probabilities().detach()
    logp, ref_logp = world.policy.logp(tokens), world.reference.logp(tokens)
    exact = world.policy.exact(tokens, world.reference)
    log_ratio = logp - old.logp(tokens)

    def gradient(weights: Tensor | None) -> Tensor:
        total = torch.zeros((), dtype=torch.float64)
        for row, often in enumerate(visits):  # a response as a minibatch of its own, with the count 1
            here = slice(row, row + 1)
            ratio = None if weights is None else weights[here]
            loss = kl_loss(form, logp[here], ref_logp[here], exact[here], mask[here], 1, ratio)
            assert loss is not None
            total = total + often * loss
        (found,) = torch.autograd.grad(total, world.policy.logits, retain_graph=True)
        return found

    right = world.per_state(visits=visits)
    torch.testing.assert_close(gradient(log_ratio), right, **EXACT)
    assert torch.equal(gradient(None), gradient(log_ratio)) == (form == "exact-loss")


class Rollout:
    """A batch with every response as often as its probability, so that a mean is an expectation.

    Probabilities are 1/2, 1/4 and 1/4 in every state: 64 rows hold all three-token responses in proportion.
    """

    def __init__(self, seed: int, scores_scale: float = 1.0) -> None:
        self.world = world = World(seed)
        generator = torch.Generator().manual_seed(seed)
        halves = torch.tensor([0.5, 0.25, 0.25], dtype=torch.float64)
        for row in world.policy.logits.data:
            row.copy_(halves[torch.randperm(3, generator=generator)].log())
        world.scores *= scores_scale
        copies = (64 * world.policy.probabilities().detach()).round().long()
        assert int(copies.sum()) == 64
        self.rows = torch.arange(len(copies)).repeat_interleave(copies)
        self.mask = world.language.mask[self.rows]
        self.count = int(self.mask.sum())

    def batch(self, form: str) -> Batch:
        """The batch of an update, with NaN where no step counts."""
        world, tokens = self.world, self.world.language.tokens[self.rows]
        values = world.some_values()[self.rows]
        advantages, targets = advantages_of(world.rewards(form, world.scores)[self.rows], values, self.mask)
        old_logp = torch.where(self.mask, world.policy.logp(tokens).detach(), torch.nan)
        return Batch({}, tokens, old_logp, values, advantages, targets, self.mask)

    def step(
        self, form: str, batch: Batch, *, normalise: bool = False, scale: float | Tensor = 1.0
    ) -> Tensor:
        """The change of the logits in one step of ppo.update, a plain gradient step of size 1."""
        policy = self.world.policy
        before = policy.logits.detach().clone()

        def kl(model, part: Batch, now, count: Tensor):
            parts = (now.logp, self.world.reference.logp(part.actions))
            exact = model.exact(part.actions, self.world.reference)
            loss = kl_loss(form, *parts, exact, part.mask, count)
            return (torch.zeros(()) if loss is None else scale * KL_BETA * loss), {}

        settings = PPOSettings(
            num_epochs=1, minibatch_size=64, micro_batch_size=7, normalise_advantages=normalise,
            value_weight=0.0, max_grad_norm=None,
        )  # fmt: skip
        optimiser = torch.optim.SGD([policy.logits], lr=1.0)
        ppo.update(policy, optimiser, batch, settings, np.random.default_rng(0), extra_loss=kl)
        change = policy.logits.detach() - before
        policy.logits.data.copy_(before)
        return change


@pytest.mark.parametrize("form", KL_FORMS)
def test_the_real_update_steps_along_the_objective(form: str) -> None:
    """Scale and micro-batches included: one factor, responses / steps, for the scores and for the KL."""
    rollout = Rollout(6)
    world = rollout.world
    right = world.of_scores - KL_BETA * world.per_state() if "loss" in form else world.right
    torch.testing.assert_close(rollout.step(form, rollout.batch(form)), right * 64 / rollout.count, **EXACT)


def test_normalised_advantages_keep_the_relation_in_the_reward_and_break_it_in_the_loss() -> None:
    rollout = Rollout(7, scores_scale=5.0)
    expected = rollout.world.right * 64 / rollout.count

    def direction_error(found: Tensor) -> float:
        return off_by(found / found.norm(), expected / expected.norm())

    assert direction_error(rollout.step("k1-reward", rollout.batch("k1-reward"), normalise=True)) < 1e-7
    split = rollout.batch("exact-split")
    assert direction_error(rollout.step("exact-split", split, normalise=True)) > 0.02
    advantages, scale = shared_scale(split.advantages, split.mask)
    assert float(scale) < 0.5
    shared = dataclasses.replace(split, advantages=advantages)
    torch.testing.assert_close(rollout.step("exact-split", shared, scale=scale), scale * expected, **EXACT)


def test_shared_scale_has_nothing_to_scale_where_all_is_equal() -> None:
    mask = torch.tensor([[True, True, False]])
    for advantages in (torch.tensor([[2.0, 2.0, 9.0]]), torch.zeros(1, 3)):
        found, scale = shared_scale(advantages, mask)
        assert float(scale) == 1 and found.tolist() == [[0, 0, 0]]
    found, scale = shared_scale(torch.tensor([[3.0, 9.0, torch.nan]]), torch.tensor([[True, False, False]]))
    assert float(scale) == 1 and found.tolist() == [[3, 0, 0]]


LOGP, REF_LOGP = torch.tensor([[-1.0, -2.0, 0.0]]), torch.tensor([[-1.5, -1.0, 0.0]])
KL, MASK = torch.tensor([[0.1, 0.2, 0.0]]), torch.tensor([[True, True, False]])


@pytest.mark.parametrize(
    ("form", "first", "second"),
    [
        ("k1-reward", 0.5, -1.0),
        ("exact-split", 0.2, 0.0),  # step 0 leads to the state of step 1; step 1 to the end
        ("k2-loss", 0.0, 0.0),
        ("exact-loss", 0.0, 0.0),
    ],
)
def test_rewards_by_hand(form: str, first: float, second: float) -> None:
    found = kl_rewards(form, 0.5, LOGP, REF_LOGP, KL, MASK)
    torch.testing.assert_close(found, torch.tensor([[-0.5 * first, -0.5 * second, 0.0]]))


def test_a_discount_acts_on_the_state_that_follows() -> None:
    assert kl_rewards("exact-split", 0.5, LOGP, REF_LOGP, KL, MASK, 0.5)[0, 0] == pytest.approx(-0.05)
    undiscounted = kl_rewards("k1-reward", 0.5, LOGP, REF_LOGP, KL, MASK)
    assert torch.equal(kl_rewards("k1-reward", 0.5, LOGP, REF_LOGP, KL, MASK, 0.5), undiscounted)


@pytest.mark.parametrize(
    ("form", "first", "second"),
    [
        ("k2-loss", 0.125, 0.5),
        ("exact-loss", 0.1, 0.2),
        ("exact-split", 0.1, 0.2),
    ],
)
def test_losses_by_hand(form: str, first: float, second: float) -> None:
    """The sum over the steps at hand over the count of all."""
    assert float(kl_loss(form, LOGP, REF_LOGP, KL, MASK, 8)) == pytest.approx((first + second) / 8)
    for step, wanted in enumerate((first, second)):
        one = MASK & (torch.arange(3) == step)
        assert float(kl_loss(form, LOGP, REF_LOGP, KL, one, 1)) == pytest.approx(wanted)


def test_a_kl_in_the_reward_has_no_loss() -> None:
    assert kl_loss("k1-reward", LOGP, REF_LOGP, KL, MASK, 2) is None


@pytest.mark.parametrize("form", KL_FORMS)
def test_nan_behind_the_mask_changes_nothing(form: str) -> None:
    def everything(*parts: Tensor) -> list[Tensor]:
        leaves = [part.clone().requires_grad_() for part in parts]
        rewards = kl_rewards(form, 0.5, *leaves, MASK)
        assert not rewards.requires_grad
        loss = kl_loss(form, *leaves, MASK, 2, leaves[0] - LOGP.mul(0.5))
        if loss is None:
            return [rewards]
        found = torch.autograd.grad(loss, leaves, allow_unused=True)
        return [rewards, loss, *(g for g in found if g is not None)]

    clean = (LOGP, REF_LOGP, KL)
    dirty = (torch.where(MASK, part, torch.nan) for part in clean)
    for a, b in zip(everything(*clean), everything(*dirty), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("form", KL_FORMS)
def test_what_is_given_stays_as_it_is(form: str) -> None:
    """The same tensors are reported as the KL: a weight multiplied in place would falsify the report."""
    given = [LOGP.clone(), REF_LOGP.clone(), KL.clone(), MASK.clone()]
    kl_rewards(form, 0.5, *given)
    kl_loss(form, *given, 2, LOGP.clone())
    for mine, theirs in zip(given, (LOGP, REF_LOGP, KL, MASK), strict=True):
        assert torch.equal(mine, theirs)


@pytest.mark.parametrize("far", [-30.0, 30.0])
def test_no_clamp_takes_the_pull_away_far_from_the_reference(far: float) -> None:
    """By hand at a log-ratio of 30: the exact KL has slope 1, k2 the log-ratio."""
    one = torch.ones(1, 1, dtype=torch.bool)
    ref_logp = torch.full((1, 1), -40.0, dtype=torch.float64)
    slopes = {"k2-loss": far, "exact-loss": 1.0}
    for form, slope in slopes.items():
        logp = (ref_logp + far).requires_grad_()
        loss = kl_loss(form, logp, ref_logp, logp - ref_logp, one, 1)
        assert torch.autograd.grad(loss, logp)[0].item() == pytest.approx(slope)
    logp = ref_logp + far
    assert kl_rewards("k1-reward", 0.5, logp, ref_logp, None, one).item() == pytest.approx(-0.5 * far)


def test_no_gradient_reaches_the_reference_or_the_weights() -> None:
    logp, ref_logp, log_ratio = (x.clone().requires_grad_() for x in (LOGP, REF_LOGP, LOGP))
    loss = kl_loss("k2-loss", logp, ref_logp, KL, MASK, 2, log_ratio)
    found = torch.autograd.grad(loss, (logp, ref_logp, log_ratio), allow_unused=True)
    assert found[0] is not None and found[1] is None and found[2] is None


def test_the_settings_offer_exactly_these_forms() -> None:
    fields = {field.name: field for field in dataclasses.fields(AlignSettings)}
    assert set(fields["kl"].metadata["choices"]) == set(KL_FORMS)
    assert fields["kl"].default in KL_FORMS
    for form in KL_FORMS:
        assert AlignSettings(kl=form).kl == form
    with pytest.raises(ValueError, match="kl is 'k3-reward'; expected one of: k1-reward"):
        AlignSettings(kl="k3-reward")


def test_settings_of_older_runs_are_read() -> None:
    """They hold allow_biased_kl, which is no setting any more."""
    assert AlignSettings.from_json({"kl": "k2-loss", "allow_biased_kl": False}).kl == "k2-loss"
    with pytest.raises(ValueError, match="no setting named 'allow_biased_kl'"):
        AlignSettings().with_values(allow_biased_kl=True)


def test_mistakes_are_named() -> None:
    with pytest.raises(ValueError, match="kl is 'k4-reward'; expected one of k1-reward, exact-split"):
        kl_rewards("k4-reward", 0.1, LOGP, REF_LOGP, KL, MASK)
    with pytest.raises(ValueError, match="kl is 'k1'"):
        kl_loss("k1", LOGP, REF_LOGP, KL, MASK, 2)
    for needs in ("exact-split", "exact-loss"):
        with pytest.raises(ValueError, match="exact is None"):
            kl_rewards(needs, 0.1, LOGP, REF_LOGP, None, MASK)
    with pytest.raises(ValueError, match=r"shapes differ: logp \(1, 3\), ref_logp \(3,\)"):
        kl_rewards("k1-reward", 0.1, LOGP, REF_LOGP[0], None, MASK)
    with pytest.raises(ValueError, match="count is 0"):
        kl_loss("k2-loss", LOGP, REF_LOGP, None, MASK, 0)
    impossible = torch.tensor([[-1.5, -torch.inf, 0.0]])
    with pytest.raises(ValueError, match="KL to the reference is inf at response 0, step 1"):
        kl_rewards("k1-reward", 0.1, LOGP, impossible, None, MASK)
    assert kl_rewards("k1-reward", 0.0, LOGP, impossible, None, MASK).tolist() == [[0, 0, 0]]


def test_kl_beta_follows_zieglers_equation() -> None:
    goal = {"target": 6.0, "horizon": 10_000}
    assert adapted(0.2, 6.0, 512, **goal) == 0.2
    assert adapted(0.2, 6.6, 500, **goal) == pytest.approx(0.2 * (1 + 0.1 * 500 / 10_000))
    assert adapted(0.2, 5.4, 500, **goal) == pytest.approx(0.2 * (1 - 0.1 * 500 / 10_000))
    for extreme, sign in ((600.0, 1), (0.0, -1), (-3.0, -1)):
        assert adapted(0.2, extreme, 500, **goal) == pytest.approx(0.2 * (1 + sign * 0.2 * 500 / 10_000))
    with pytest.raises(ValueError, match="the KL is nan"):
        adapted(0.1, math.nan, 64, **goal)


def test_with_the_mean_over_tokens_kl_beta_would_only_fall() -> None:
    """Why the sum over the response matters: 24 tokens at the target are a quarter of a nat per token."""
    right = wrong = 0.2
    for _ in range(67):
        right = adapted(right, 6.0, 512, target=6.0, horizon=10_000)
        wrong = adapted(wrong, 6.0 / 24, 512, target=6.0, horizon=10_000)
    assert right == 0.2
    assert wrong == pytest.approx(0.1, rel=0.01)
