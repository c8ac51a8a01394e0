"""Normalisers: the rows they see, their updates and restarts, and normalised bootstraps."""

import numpy as np
import pytest
import torch
from chain import BASE_SEED, Chain, ChainVector
from gymnasium.vector import AutoresetMode
from torch import nn

import tightrope
from tightrope.control.policy.normalise import ObservationNormaliser, RewardNormaliser
from tightrope.control.rollout.rollout import critic_values


def test_reward_scale_by_hand_and_restarts_at_both_kinds_of_end():
    normaliser = RewardNormaliser(1, gamma=0.5)
    rewards = np.array([[1.0, 2.0, 4.0, 8.0]])
    ended = np.array([[False, True, False, False]])
    normaliser.update(rewards, ended, np.ones((1, 4), bool))
    series = [1.0, 2.5, 4.0, 10.0]  # 0.5 * 1 + 2; restart; 0.5 * 4 + 8
    assert normaliser.deviation == pytest.approx(np.std(series), rel=1e-6)
    assert normaliser.running.tolist() == [10.0]
    assert normaliser(np.array([5.0])) == pytest.approx([5.0 / np.std(series)], rel=1e-6)


def test_masked_rows_are_not_there():
    a, b = RewardNormaliser(1, 0.9), RewardNormaliser(1, 0.9)
    a.update(np.array([[1.0, 2.0, 3.0]]), np.array([[False, True, False]]), np.ones((1, 3), bool))
    mask = np.array([[True, True, False, True]])
    b.update(np.array([[1.0, 2.0, 99.0, 3.0]]), np.array([[False, True, False, False]]), mask)
    assert a.deviation == b.deviation
    assert a.running.tolist() == b.running.tolist()


def test_observations_by_hand_and_discrete_columns_stay():
    normaliser = ObservationNormaliser(np.array([True, False]))
    assert (normaliser(np.array([[5.0, 1.0]], np.float32)) == [[5.0, 1.0]]).all()
    normaliser.update(np.array([[0.0, 1.0], [4.0, 0.0]], np.float32))
    assert normaliser(np.array([[6.0, 1.0]], np.float32)) == pytest.approx(np.array([[2.0, 1.0]]), rel=1e-5)
    assert normaliser(np.array([[1e9, 1.0]], np.float32))[0, 0] == 10.0


class Sum(nn.Module):
    """V = the sum of the inputs, so that bootstraps show whether they were normalised."""

    def __init__(self):
        super().__init__()
        self.unused = nn.Parameter(torch.zeros(1))

    def forward(self, observation):
        return torch.zeros(len(observation), 3), observation.sum(1)


def agent_on(env, **values):
    both = dict(normalise_observations=True, normalise_rewards=True)
    return tightrope.PPO(env, policy=Sum(), seed=BASE_SEED, num_envs=2, num_steps=30, **{**both, **values})


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_bootstraps_see_normalised_observations_and_statistics_see_no_phantom(mode):
    agent = agent_on(ChainVector(2, autoreset_mode=mode))
    agent.collector.reset(BASE_SEED)
    first = agent.collector.collect(agent.engine, 30)
    raw, mask = first.raw.copy(), first.mask.copy()
    agent.normalisers.update(first)
    moments = agent.normalisers.observations.moments
    np.testing.assert_allclose(moments.mean.numpy(), raw[mask].mean(0), rtol=1e-6)
    np.testing.assert_allclose(moments.variance.numpy(), raw[mask].var(0), rtol=1e-5)
    assert float(moments.count) == mask.sum() < 60 or mode == AutoresetMode.SAME_STEP
    second = agent.collector.collect(agent.engine, 30)
    normaliser = agent.normalisers.observations
    _, following = critic_values(second, agent.engine)
    checked = 0
    for row, t in np.argwhere(second.mask & (second.truncated | (np.arange(30) == 29)) & ~second.terminated):
        after = second.raw[row, t].copy()
        after[2] += 1  # the chain's observation is (row, episode, step)
        expected = normaliser(after).sum()
        if second.truncated[row, t] or t == 29:
            assert following[row, t] == pytest.approx(float(expected), rel=1e-5)
            checked += 1
    assert checked >= 4


def test_statistics_are_frozen_during_a_rollout_and_its_update():
    agent = tightrope.PPO("Pendulum-v1", seed=0, num_envs=2, num_steps=16, minibatch_size=16,
                          normalise_observations=True, engine="torch")  # fmt: skip
    seen = []
    original = agent.engine.update

    def update(*args, **more):
        seen.append(agent.normalisers.observations.mean.copy())
        return original(*args, **more)

    agent.engine.update = update
    before = [agent.normalisers.observations.mean.copy()]
    before += [agent.normalisers.observations.mean.copy() for _ in agent.iterate(96)]
    for during, start, end in zip(seen, before[:-1], before[1:], strict=True):
        assert (during == start).all()
        assert (end != start).any()


def test_evaluation_leaves_everything_as_it_is():
    agent = tightrope.PPO("CartPole-v1", seed=0, num_envs=2, num_steps=32, minibatch_size=32).learn(256)
    from tightrope.control.evaluate import evaluate_agent, evaluation_environments

    state = {k: x.clone() for k, x in agent.normalisers.state().items()}
    rng = agent.sampling_rng.bit_generator.state
    with evaluation_environments(agent.env, agent.settings, 4) as environments:
        evaluate_agent(agent, environments, 4, deterministic=False)
    agent.predict(np.zeros((3, 4), np.float32), deterministic=False)
    assert all(torch.equal(x, agent.normalisers.state()[k]) for k, x in state.items())
    assert agent.sampling_rng.bit_generator.state == rng


def test_single_environments_and_vector_environments_share_statistics():
    a, b = (
        agent_on(lambda: Chain(), vector_backend="serial"),
        agent_on(lambda: Chain(), vector_backend="workers"),
    )
    for agent in (a, b):
        agent.collector.reset(BASE_SEED)
        agent.normalisers.update(agent.collector.collect(agent.engine, 30))
        agent.close()
    assert torch.equal(a.normalisers.observations.moments.mean, b.normalisers.observations.moments.mean)
    assert a.normalisers.rewards.deviation == b.normalisers.rewards.deviation
