"""Densities are valid, and samples follow the stated density."""

import math

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

import tightrope
from tightrope.control.policy.distributions import Distribution, bounded
from tightrope.control.policy.policy import Policy
from tightrope.control.settings import TrainSettings
from tightrope.control.spaces.actions import action_layout
from tightrope.control.spaces.observations import observation_layout
from tightrope.maths import divergence


def box(low, high):
    return action_layout(spaces.Box(np.float32(low), np.float32(high), (1,), np.float32), "squash")


@pytest.mark.parametrize(("low", "high"), [(-1.0, 1.0), (-3.0, 5.0)])
@pytest.mark.parametrize("mean", [-0.7, 0.0, 1.2])
def test_a_squashed_density_integrates_to_one_in_the_environments_own_units(low, high, mean):
    layout, half = box(low, high), torch.tensor([(high - low) / 2])
    u = torch.linspace(-9, 9, 20001)[:, None]
    distribution = Distribution(
        layout.components, torch.full((len(u), 1), mean), torch.tensor([-0.3]), None, half
    )
    density = distribution.logp(u).double().exp()
    action = torch.from_numpy(layout.to_env(u.numpy()))[:, 0].double()
    assert float(torch.trapezoid(density, action)) == pytest.approx(1.0, abs=1e-3)
    entropy = -torch.trapezoid(torch.xlogy(density, density), action)
    assert float(distribution.entropy()[0]) == pytest.approx(float(entropy), abs=5e-3)


def test_a_gaussian_density_is_the_textbooks():
    distribution = Distribution(box(-9, 9).components, torch.tensor([[0.5]]), torch.tensor([math.log(2.0)]))
    expected = -0.5 * ((1.5 - 0.5) / 2) ** 2 - math.log(2) - 0.5 * math.log(2 * math.pi)
    assert float(distribution.logp(torch.tensor([[1.5]]))) == pytest.approx(expected, abs=1e-6)
    assert float(distribution.entropy()) == pytest.approx(0.5 * math.log(2 * math.pi * math.e * 4), abs=1e-6)


def make_policy(**values):
    layouts = observation_layout(spaces.Box(-1, 1, (3,), np.float32)), box(-9, 9)
    return Policy(*layouts, TrainSettings(hidden=(8,), **values))


@torch.no_grad()
def test_gsde_noise_has_the_deviation_that_its_density_claims():
    """Over many exploration matrices the actions of one state spread by exp(log_std) of its distribution."""
    policy, rng = make_policy(std="gsde", log_std_init=-0.4), np.random.default_rng(0)
    rows = 20_000
    inputs = {"flat": torch.tensor([[0.3, -0.8, 0.5]]).expand(rows, 3).contiguous()}
    policy.hold_exploration(rows, rng)
    actions, logp = policy.act({"flat": inputs["flat"].numpy()}, np.zeros((rows, 1), np.float32))
    distribution, _ = policy.evaluate(inputs)
    claimed = float(distribution.log_std[0].exp())
    assert float(actions.std()) == pytest.approx(claimed, rel=0.02)
    assert float(actions.mean()) == pytest.approx(float(distribution.parameters[0]), abs=0.02)
    latent = policy.actor[:-1](inputs["flat"][:1])
    by_hand = (latent.square() * (2 * policy.log_std).exp().T).sum().sqrt()
    assert claimed == pytest.approx(float(by_hand), rel=1e-4)
    z = (actions[:, 0] - distribution.parameters[:, 0]) / claimed
    expected = -0.5 * z.square() - math.log(claimed) - 0.5 * math.log(2 * math.pi)
    torch.testing.assert_close(logp, expected.detach(), rtol=1e-3, atol=1e-3)


def test_gsde_holds_its_noise_and_predict_does_not_change_it():
    policy, rng = make_policy(std="gsde"), np.random.default_rng(0)
    inputs = {"flat": np.random.default_rng(1).random((4, 3), np.float32)}
    policy.hold_exploration(4, rng)
    first, _ = policy.act(inputs, np.zeros((4, 1), np.float32))
    policy.sample(
        {"flat": np.ones((2, 3), np.float32)}, np.zeros((2, 1), np.float32), np.random.default_rng(5)
    )
    again, _ = policy.act(inputs, np.ones((4, 1), np.float32))
    assert torch.equal(first, again)
    policy.hold_exploration(4, rng)
    assert not torch.equal(first, policy.act(inputs, np.zeros((4, 1), np.float32))[0])


@torch.no_grad()
def test_state_dependent_deviation_depends_on_the_state():
    policy = make_policy(std="state")
    with torch.no_grad():
        policy.actor[-1].weight.mul_(100)
    distribution, _ = policy.evaluate({"flat": torch.tensor([[1.0, 0, 0], [-1.0, 0, 0]])})
    assert distribution.log_std.shape == (2, 1)
    assert abs(float((distribution.log_std[0] - distribution.log_std[1]).detach())) > 0.01


def test_masked_categories_are_never_sampled_and_weigh_nothing():
    layout = action_layout(spaces.MultiDiscrete([3, 2]))
    mask = torch.tensor([[True, False, True, False, True]]).expand(5000, 5)
    distribution = Distribution(layout.components, torch.zeros(5000, 5), None, mask)
    noise = torch.rand(5000, 2)
    noise[0] = 1.0 - 1e-8  # rounding at the edge of the distribution
    actions, _ = distribution.sample(noise)
    assert set(actions[:, 0].tolist()) == {0.0, 2.0}
    assert set(actions[:, 1].tolist()) == {1.0}
    assert float(distribution.entropy()[0]) == pytest.approx(math.log(2), abs=1e-6)
    assert float(distribution.logp(actions)[0]) == pytest.approx(math.log(0.5), abs=1e-6)


def test_frequencies_follow_the_probabilities():
    layout = action_layout(spaces.Tuple((spaces.Discrete(3), spaces.MultiBinary(1))))
    logits = torch.log(torch.tensor([[0.2, 0.5, 0.3, 0.0]]))
    logits[0, 3] = math.log(0.7 / 0.3)
    distribution = Distribution(layout.components, logits.expand(40_000, 4))
    actions, _ = distribution.sample(torch.rand(40_000, 2, generator=torch.Generator().manual_seed(0)))
    shares = [float((actions[:, 0] == k).float().mean()) for k in range(3)]
    assert shares == pytest.approx([0.2, 0.5, 0.3], abs=0.01)
    assert float(actions[:, 1].mean()) == pytest.approx(0.7, abs=0.01)


def test_entropies_are_those_of_the_maths_to_the_bit():
    """Every kind of component, with masked choices, and a shared or a per-row deviation."""
    space = spaces.Tuple((spaces.Discrete(5), spaces.MultiBinary(3), spaces.Box(-1, 1, (4,), np.float32)))
    layout, generator = action_layout(space), torch.Generator().manual_seed(0)
    parameters = torch.randn(6, 12, generator=generator)
    mask = torch.ones(6, 8, dtype=torch.bool)
    mask[:3, 1] = mask[2:, 6] = False
    logits = torch.where(mask, parameters[:, :8], -torch.inf)
    for log_std in (torch.randn(4, generator=generator), torch.randn(6, 4, generator=generator)):
        wanted = divergence.categorical_entropy(logits[:, :5]) + divergence.bernoulli_entropy(logits[:, 5:])
        wanted = wanted + divergence.gaussian_entropy(log_std.expand(6, 4))
        assert torch.equal(Distribution(layout.components, parameters, log_std, mask).entropy(), wanted)


@pytest.mark.parametrize("engine", ["torch", "auto"])
@pytest.mark.parametrize("std", ["independent", "state", "gsde"])
@pytest.mark.parametrize("start", [2.5, 3.0])
def test_a_deviation_above_its_range_comes_back(engine, std, start):
    """Every step away from 0 costs, so that a smaller deviation pays."""

    class Still(gym.Env):
        observation_space = spaces.Box(-1, 1, (1,), np.float32)
        action_space = spaces.Box(-100, 100, (1,), np.float32)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return np.ones(1, np.float32), {}

        def step(self, action):
            return np.ones(1, np.float32), -float(abs(action[0])), True, False, {}

    agent = tightrope.PPO(
        lambda: Still(), std=std, log_std_init=start, engine=engine, seed=0, num_envs=8, num_steps=32,
        learning_rate=3e-2, learning_rate_schedule="constant", notify=lambda text: None, action_bounds="clip",
        normalise_observations=False,  # a constant would become 0, and gSDE has no noise there
    ).learn(8_192)  # fmt: skip
    distribution, _ = agent.policy.evaluate({"flat": torch.ones(1, 1)})
    assert float(distribution.log_std.detach().mean()) < 1.5


def test_within_its_range_a_deviation_is_the_plain_clamp_and_outside_only_the_way_out_is_cut():
    x = torch.tensor([-25.0, -25.0, -20.0, 0.3, 2.0, 2.5, 2.5], requires_grad=True)
    y = bounded(x)
    assert torch.equal(y, x.clamp(-20, 2))
    y.backward(torch.tensor([1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0]))
    assert x.grad.tolist() == [0, -1, 1, 1, -1, 1, 0]
