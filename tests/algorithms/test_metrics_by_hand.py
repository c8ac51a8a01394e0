"""Every metric of an update, computed by hand: two rows of two steps, one of them masked."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from tightrope.algorithms import a2c, ppo, reinforce
from tightrope.algorithms.batch import Batch, Evaluation
from tightrope.algorithms.settings import A2CSettings, PPOSettings, ReinforceSettings

MASK = torch.tensor([[True, True], [True, False]])
RATIOS = [1.5, 1.1, 1.3]  # all above 1, the ratio of a masked step
ADVANTAGES = [2.0, -1.0, 0.5]
VALUES, RETURNS, ENTROPIES = [0.0, 1.0, 3.0], [1.0, 1.0, 1.0], [0.2, 0.3, 0.7]


def spread(numbers):
    return torch.full((2, 2), torch.nan).masked_scatter(MASK, torch.tensor(numbers))


def of_rule(rule, settings, **more):
    """The metrics of one update of a model whose output does not depend on its parameter."""
    weight = torch.nn.Parameter(torch.zeros(()))

    def model(part):
        now = (torch.where(part.mask, part.inputs[name], 0.0) for name in ("logp", "entropy", "values"))
        return Evaluation(*(x + weight for x in now))

    inputs = {"logp": spread(RATIOS).log(), "entropy": spread(ENTROPIES), "values": spread(VALUES)}
    zeros = torch.zeros(2, 2)
    batch = Batch(inputs, zeros, zeros, zeros, spread(ADVANTAGES), spread(RETURNS), MASK)
    optimiser = torch.optim.SGD([weight], lr=0.0)
    return rule.update(model, optimiser, batch, settings, np.random.default_rng(0), **more)


K3 = [r - 1 - math.log(r) for r in RATIOS]
ALWAYS = {
    "train/approx_kl": sum(K3) / 3,
    "train/value_loss": (0.5 + 0.0 + 2.0) / 3,
    "train/entropy": 1.2 / 3,
    "train/ratio_min": 1.1,
    "train/ratio_max": 1.5,
    "train/log_ratio_first": math.log(1.5),
    "train/minibatches": 1.0,
}
PLAIN = {
    "train/policy_gradient_loss": -sum(math.log(r) * a for r, a in zip(RATIOS, ADVANTAGES, strict=True)) / 3,
    "train/clip_fraction": 0.0,
    "train/clip_fraction_high": 0.0,
    "train/clip_fraction_low": 0.0,
    # d loss / d weight: -A, and of the critic value_weight 0.5 times V - R
    "train/grad_norm": abs(-1.5 + 0.5 * (-1.0 + 0.0 + 2.0)) / 3,
}
CLIPPED = {
    "train/policy_gradient_loss": -(1.2 * 2.0 - 1.1 + 1.2 * 0.5) / 3,
    "train/clip_fraction": 2 / 3,
    "train/clip_fraction_high": 2 / 3,
    "train/clip_fraction_low": 0.0,
    # the two that are clipped have no gradient; the third: -r A with r = 1.1
    "train/grad_norm": abs(1.1 + 0.5 * (-1.0 + 0.0 + 2.0)) / 3,
}
COMMON = {"normalise_advantages": False, "max_grad_norm": None, "entropy_weight": 0.0, "value_weight": 0.5}
RULES = [
    (ppo, PPOSettings(num_epochs=1, minibatch_size=2, clip=0.2, **COMMON), CLIPPED),
    (a2c, A2CSettings(**COMMON), PLAIN),
    (reinforce, ReinforceSettings(**COMMON), PLAIN),
]


@pytest.mark.parametrize(("rule", "settings", "own"), RULES, ids=["ppo", "a2c", "reinforce"])
@pytest.mark.parametrize("micro", [None, 1])
def test_every_metric_of_an_update_by_hand(rule, settings, own, micro):
    found = of_rule(rule, dataclasses.replace(settings, micro_batch_size=micro))
    assert found == {name: pytest.approx(x, rel=1e-5, abs=1e-6) for name, x in {**ALWAYS, **own}.items()}


@pytest.mark.parametrize(("rule", "settings", "own"), RULES, ids=["ppo", "a2c", "reinforce"])
def test_a_metric_of_an_extra_loss_may_be_a_mean_over_other_things_than_steps(rule, settings, own):
    """Two parts: sums of 10 over 1 item and 20 over 4 items give a mean of 6, independent of the steps."""
    given = iter([(torch.tensor(10.0), 1), (torch.tensor(20.0), 4)])

    def extra(model, part, evaluation, count):
        return torch.zeros(()), {"other": next(given)}

    found = of_rule(rule, dataclasses.replace(settings, micro_batch_size=1), extra_loss=extra)
    assert found["train/other"] == pytest.approx(6.0)
