"""A NaN or an infinity from any source is named before the step, and the weights stay unchanged."""

import numpy as np
import pytest
import torch

import tightrope
from tightrope.algorithms import a2c, ppo, reinforce
from tightrope.algorithms.batch import Batch, Evaluation
from tightrope.algorithms.nonfinite import NonFiniteError
from tightrope.algorithms.optimise import make_optimiser
from tightrope.algorithms.settings import A2CSettings, PPOSettings, ReinforceSettings

SMALL = {"num_envs": 2, "num_steps": 32, "minibatch_size": 64, "num_epochs": 1, "seed": 0, "hidden": (8,)}
BAD = [np.nan, np.inf, -np.inf]


def weights(module):
    return torch.cat([p.detach().flatten().clone() for p in module.parameters()]).nan_to_num()


def agent_on(engine):
    agent = tightrope.PPO("CartPole-v1", engine=engine, vector_backend="serial", **SMALL)
    agent.notify = lambda text: None
    return agent


@pytest.fixture(params=["torch", "fused"])
def agent(request):
    made = agent_on(request.param)
    yield made
    made.close()


def refused(agent, words):
    """Train, expect the error, and check that no weight and no moment moved."""
    before = weights(agent.policy)
    with pytest.raises(NonFiniteError, match=words):
        agent.learn(64)
    assert torch.equal(weights(agent.policy), before)
    state = agent.optimiser.state.values()
    assert all(float(entry["step"]) == 0 for entry in state)


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("site", ["value", "advantage", "loss"])
def test_what_is_computed_from_a_rollout(agent, site, bad, monkeypatch):
    """A value, an advantage, and a return so large that its squared error overflows."""
    from tightrope.control import agent as module

    whole = module.to_batch

    def poisoned(*arguments, **more):
        batch = whole(*arguments, **more)
        if site == "value":
            batch.old_values[1, 7] = float(bad)
        elif site == "advantage":
            batch.advantages[1, 7] = float(bad)
        else:
            batch.returns[1, 7] = 3e38
        return batch

    monkeypatch.setattr(module, "to_batch", poisoned)
    if site == "loss":  # normalised, its error is of order 1
        agent.normalisers.returns = None
    if site == "value":  # only with value_clip are old values part of the loss
        agent.settings = agent.settings.with_values(value_clip=0.2)
    words = {"value": "The old value", "advantage": "The advantage", "loss": "loss|gradient"}[site]
    refused(agent, words)


@pytest.mark.parametrize("bad", BAD)
def test_one_weight_is_named_when_it_acts(agent, bad):
    with torch.no_grad():
        agent.policy.actor[0].weight[2, 1] = bad
    refused(agent, r"weight actor.0.weight\[2, 1\] is -?(nan|inf)")


@pytest.mark.parametrize("bad", BAD)
def test_one_weight_of_the_critic_is_named(agent, bad):
    with torch.no_grad():
        agent.policy.critic[0].bias[3] = bad
    refused(agent, r"The weight critic.0.bias\[3\] is -?(nan|inf) in minibatch 1 of epoch 1")


def test_logits_that_overflow(agent):
    with torch.no_grad():
        agent.policy.actor[-1].bias.fill_(3e38)
        agent.policy.actor[-1].weight.fill_(3e38)
    refused(agent, "its logits overflow")


def test_one_gradient_is_named():
    """Only on torch can other code change the gradients."""
    agent = agent_on("torch")

    def poison(gradient):
        gradient = gradient.clone()
        gradient[1, 2] = torch.nan
        return gradient

    agent.policy.actor[0].weight.register_hook(poison)
    refused(agent, r"Data and outputs are finite, but the gradient of actor.0.weight\[1, 2\] is nan")
    agent.close()


# ------------------------------------------------------------------------------------- the three update rules

RULES = {
    "ppo": (ppo, PPOSettings(minibatch_size=6, num_epochs=1, normalise_advantages=False)),
    "a2c": (a2c, A2CSettings(normalise_advantages=False)),
    "reinforce": (reinforce, ReinforceSettings(normalise_advantages=False)),
}


class Line(torch.nn.Module):
    """logp and value of one input each, linear."""

    def __init__(self):
        super().__init__()
        self.slope = torch.nn.Parameter(torch.tensor([0.1, 0.2]))

    def forward(self, batch):
        x = batch.inputs["x"]
        return Evaluation(self.slope[0] * x, 0.0 * x, self.slope[1] * x)


def line_batch():
    x = torch.linspace(-1, 1, 12).reshape(6, 2)
    zeros, mask = torch.zeros(6, 2), torch.ones(6, 2, dtype=torch.bool)
    return Batch({"x": x}, zeros, 0.1 * x, zeros.clone(), x.sin(), x.cos(), mask)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize(
    ("site", "words"),
    [
        ("x", r"The input x \(row, step, ...\)\[3, 1\] is nan"),
        ("old_logp", r"The old_logp \(row, step, ...\)\[3, 1\] is nan"),
        ("advantages", r"The advantage \(row, step, ...\)\[3, 1\] is nan"),
        ("returns", r"The return \(row, step, ...\)\[3, 1\] is nan"),
        ("logp", r"The logits or log-probability \(row of the minibatch, step\)\[\d, \d\] is nan"),
        ("value", r"The value \(row of the minibatch, step\)\[\d, \d\] is inf"),
        ("loss", "The loss is nan, though data and outputs are finite"),
        ("weight", r"The weight slope\[1\] is inf"),
    ],
)
def test_each_site_is_named_in_each_rule(rule, site, words):
    if rule != "ppo" and site == "old_logp":
        return  # it is not part of their loss
    module, settings = RULES[rule]
    model, batch = Line(), line_batch()
    optimiser = make_optimiser(model.parameters(), [], settings)
    if site in ("x", "old_logp", "advantages", "returns"):
        (batch.inputs["x"] if site == "x" else getattr(batch, site))[3, 1] = torch.nan
    extra = None
    if site == "loss":
        extra = lambda model, part, now, count: (torch.tensor(torch.nan), {})  # noqa: E731
    if site == "weight":
        with torch.no_grad():
            model.slope[1] = torch.inf

    def asked(part):
        now = model(part)
        if site == "logp":
            now.logp[now.logp == now.logp.max()] = torch.nan
        if site == "value":
            now.values[now.values == now.values.max()] = torch.inf
        return now

    asked.named_parameters = model.named_parameters
    before = model.slope.detach().clone()
    with pytest.raises(NonFiniteError, match=words) as caught:
        module.update(asked, optimiser, batch, settings, np.random.default_rng(0), extra_loss=extra)
    assert "not taken and the weights are as before" in str(caught.value)
    assert torch.equal(before, model.slope.detach())


def test_padding_may_hold_anything():
    model, batch = Line(), line_batch()
    batch.mask[3, 1] = False
    for tensor in (batch.inputs["x"], batch.old_logp, batch.advantages, batch.returns):
        tensor[3, 1] = torch.nan
    module, settings = RULES["ppo"]
    optimiser = make_optimiser(model.parameters(), [], settings)

    def cleared(part):
        return model(part.map(lambda x: torch.nan_to_num(x) if x.is_floating_point() else x))

    metrics = module.update(cleared, optimiser, batch, settings, np.random.default_rng(0))
    assert all(np.isfinite(x) for x in metrics.values())
