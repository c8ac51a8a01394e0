"""PPO on a language whose best policy is known: p(y) proportional to p_ref(y) exp(score(y) / kl_beta)."""

import numpy as np
import pytest
import torch
from language.tabular import Language, Tabular, advantages_of, with_scores
from torch import Tensor

from tightrope.algorithms import ppo
from tightrope.algorithms.batch import Batch
from tightrope.algorithms.optimise import make_optimiser, set_learning_rates
from tightrope.algorithms.settings import PPOSettings
from tightrope.language.alignment.kl import kl_loss, kl_rewards, shared_scale

LANGUAGE = Language(words=4, length=2)
KL_BETA = 0.5
ROWS, ITERATIONS = 1024, 150
SETTINGS = PPOSettings(
    gamma=1.0, num_epochs=2, minibatch_size=256, learning_rate=0.05, normalise_advantages=False,
    max_grad_norm=None,
)  # fmt: skip


# The score of a first and a second word; nothing follows the EOS 0. The high scores after word 1 are far from
# the reference: collecting them costs a KL one step later.
SCORES = torch.tensor(
    [[0.0, 0.0, 0.0, 0.0], [-1.0, -1.0, -1.0, 1.5], [0.5, 0.5, 0.5, 0.5], [0.3, 0.6, 0.0, 0.9]],
    dtype=torch.float64,
)


def scores_of(tokens: Tensor) -> Tensor:
    """A number for every response, [B]."""
    return SCORES[tokens[:, 0], tokens[:, 1]]


def train(form: str, *, normalise: bool = False) -> tuple[Tabular, Tabular]:
    """PPO from the reference, with sampled responses and a learning rate that falls to 0."""
    policy, reference = Tabular(LANGUAGE, seed=0), Tabular(LANGUAGE, seed=0).requires_grad_(False)
    optimiser = make_optimiser([policy.logits, policy.values], [policy.values], SETTINGS)
    generator, rng = torch.Generator().manual_seed(2), np.random.default_rng(3)
    for iteration in range(ITERATIONS):
        settings = SETTINGS.at(iteration / ITERATIONS)
        set_learning_rates(optimiser, settings)
        tokens = policy.sample(ROWS, generator)
        mask = LANGUAGE.mask_of(tokens)
        with torch.no_grad():
            logp, ref_logp = policy.logp(tokens), reference.logp(tokens)
            exact, values = policy.exact(tokens, reference), policy.values[LANGUAGE.states(tokens)]
        rewards = kl_rewards(form, KL_BETA, logp, ref_logp, exact, mask)
        advantages, targets = advantages_of(
            with_scores(rewards, scores_of(tokens), mask), values, mask, settings.gae_lambda
        )
        advantages, scale = shared_scale(advantages, mask) if normalise else (advantages, 1.0)

        def kl(model, part: Batch, now, count: Tensor, scale=scale):
            exact = model.exact(part.actions, reference)
            loss = kl_loss(form, now.logp, reference.logp(part.actions), exact, part.mask, count)
            return (torch.zeros(()) if loss is None else scale * KL_BETA * loss), {}

        batch = Batch({}, tokens, logp, values, advantages, targets, mask)
        ppo.update(policy, optimiser, batch, settings, rng, extra_loss=kl, log_ratio_limit=1e-5)
    return policy, reference


def total_variation(p: Tensor, q: Tensor) -> float:
    """Half the sum of |p - q|: the largest difference in probability of any set of responses."""
    return float((p - q).abs().sum().detach()) / 2


def optimum(reference: Tabular) -> Tensor:
    """Probabilities [N] of the policy that maximises E[score] - KL_BETA KL, over whole responses."""
    return (reference.probabilities().log() + scores_of(LANGUAGE.tokens) / KL_BETA).softmax(0)


def blind_optimum(reference: Tabular) -> Tensor:
    """Probabilities [N] at which a state's own KL balances the scores, without the KL of later states.

    In every state p(a|s) is proportional to p_ref(a|s) exp(E[score | s, a] / KL_BETA).
    """
    second = (reference.logits[1:].log_softmax(-1) + SCORES / KL_BETA).softmax(-1)
    worth = (second * SCORES).sum(-1)  # E[score | first word]
    first = (reference.logits[0] + worth / KL_BETA).softmax(-1)
    joint = first[:, None] * second
    rows = LANGUAGE.tokens
    return torch.where(rows[:, 0] == 0, first[0], joint[rows[:, 0], rows[:, 1]])


@pytest.mark.parametrize(
    ("form", "normalise", "limit"),
    [("k1-reward", False, 0.001), ("exact-split", False, 0.02), ("exact-split", True, 0.02)],
)
def test_the_known_optimum_is_reached(form: str, normalise: bool, limit: float) -> None:
    """k1-reward comes nearest: at the optimum all responses have the same return, without noise."""
    policy, reference = train(form, normalise=normalise)
    best = optimum(reference)
    assert total_variation(reference.probabilities(), best) > 0.2, "the task would be no task"
    assert total_variation(policy.probabilities(), best) < limit


def test_a_pure_loss_form_reaches_the_optimum_of_one_who_does_not_see_later_states() -> None:
    policy, reference = train("exact-loss")
    found = policy.probabilities()
    assert total_variation(found, blind_optimum(reference)) < 0.02
    assert total_variation(found, optimum(reference)) > 0.05
