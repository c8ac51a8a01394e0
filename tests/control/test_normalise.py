"""Normalisers: the rows they see, their updates and restarts, and normalised bootstraps."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from chain import BASE_SEED, Chain, ChainVector
from gymnasium.vector import AutoresetMode
from torch import nn

import tightrope
from tightrope.control.policy.normalise import ObservationNormaliser, RewardNormaliser
from tightrope.control.rollout.rollout import critic_values, cut_shares


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
    assert (normaliser(np.array([[5.0, 1.0]])) == [[5.0, 1.0]]).all()
    normaliser.update(np.array([[0.0, 1.0], [4.0, 0.0]]))
    assert normaliser(np.array([[6.0, 1.0]])) == pytest.approx(np.array([[2.0, 1.0]]), rel=1e-5)
    assert normaliser(np.array([[6.0, 1.0]])).dtype == np.float32


@pytest.mark.parametrize(
    "values",
    [
        [1.7e9, 1.7e9 + 10],
        [2.0**53 - 9, 2.0**53 - 1],
        [-1e-6, 1e-6],
        [1000, 5000],
        [-1e30, 1e30],
        [3e-11, 5e-11],
    ],
    ids=str,
)
def test_two_numbers_of_any_size_are_told_apart(values):
    normaliser = ObservationNormaliser(np.array([True, True]))
    flat = np.stack([values, np.ones(2)], axis=1)  # a column beside it that needs none of it
    for _ in range(20):
        normaliser.update(flat)
    assert normaliser(flat)[:, 0].tolist() == pytest.approx([-1.0, 1.0], rel=1e-3)
    assert normaliser(flat)[:, 1].tolist() == [0.0, 0.0]


@pytest.mark.parametrize(("constant", "size"), [(0.0, 1.0), (0.1, 0.1), (-4000.0, 4000.0)])
def test_a_column_that_was_constant_is_measured_by_its_size(constant, size):
    normaliser = ObservationNormaliser(np.array([True]))
    for _ in range(7):
        normaliser.update(np.full((33, 1), constant))
    found = normaliser(np.array([[constant], [constant + size], [constant - 2 * size]]))
    assert found[:, 0].tolist() == pytest.approx([0.0, 1.0, -2.0], abs=1e-6)


def test_outliers_stay_bounded_and_keep_their_order():
    """A cue of 1 or 2, shown once in 300 steps, lies 11 and 22 deviations off: no clip may join them."""
    normaliser = ObservationNormaliser(np.array([True]))
    normaliser.update(np.r_[np.zeros(600), 1.0, 2.0][:, None])
    cues = normaliser(np.array([[1.0], [2.0], [1e9], [1e30], [-2.0]]))[:, 0]
    assert (np.diff(cues[:4]) > 1).all() and cues[3] < 100 and cues[4] == pytest.approx(-cues[1], abs=0.05)
    near = np.nextafter(10.0, [0.0, 11.0])[:, None]  # no jump at the edge
    unit = ObservationNormaliser(np.array([True]))
    assert np.diff(unit(near)[:, 0]) == pytest.approx(0.0, abs=1e-5)


def test_old_runs_are_normalised_as_they_were():
    old, raw = ObservationNormaliser(np.array([True]), old=True), np.array([[1.7], [2.9], [1e9]])
    old.update(raw[:2])
    mean, scale = np.float32(raw[:2].mean()), np.float32(1 / np.sqrt(raw[:2].var() + 1e-8))
    expected = np.clip((raw.astype(np.float32) - mean) * scale, -10.0, 10.0)
    assert (old(raw) == expected).all() and old(raw).dtype == np.float32


class Thousands(gym.Env):
    """One step of 1000..5000, which tells the action that pays, in each of three columns."""

    observation_space, action_space = gym.spaces.Box(0, 1e4, (3,)), gym.spaces.Discrete(2)

    def __init__(self):
        pass

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seen = self.np_random.uniform(1000, 5000, 3).astype(np.float32)
        return self.seen, {}

    def step(self, action):
        reward = float(action == (self.seen[0] > 3000))
        return self.reset()[0], reward, True, False, {}


@pytest.mark.parametrize("engine", ["torch", "auto"])
@pytest.mark.parametrize(("total", "expected"), [(64, 4), (640, 64), (9600, 512)])
def test_statistics_exist_before_the_first_step_that_is_learned_from(engine, total, expected):
    """64 steps are 16 columns in 4 copies: one column gives the statistics, 15 are learned from."""
    agent = tightrope.PPO(
        lambda: Thousands(), seed=0, num_envs=4, num_steps=64, engine=engine, evaluate_every=None
    )
    assert agent.settings.normalise_observations
    seen, original = [], agent.engine.update

    def update(batch, *args, **more):
        seen.append(batch.inputs["flat"].clone())
        return original(batch, *args, **more)

    agent.engine.update = update
    first = next(agent.iterate(total))
    (learned,) = seen
    columns = {64: 15, 640: 48, 9600: 64}[total]
    assert learned.shape[:2] == (4, columns) and first.step == agent.steps == expected + 4 * columns
    assert sum(length for _, length, _ in first.episodes) == agent.steps  # each step is an episode
    assert float(agent.normalisers.observations.moments.count) == agent.steps
    assert float(learned.abs().max()) < 5 and 0.5 < float(learned.std()) < 2
    assert first.metrics["rollout/observation_outlier_fraction"] == 0.0


def test_steps_for_statistics_only_are_too_few():
    agent = tightrope.PPO(lambda: Thousands(), seed=0, num_envs=4, num_steps=64, engine="torch")
    with pytest.raises(ValueError, match="4 steps are too few: .* the first step of each only gives statist"):
        agent.learn(4)
    assert agent.learn(8).learn(4).steps == 12


def test_an_outlier_is_counted():
    agent = tightrope.PPO(lambda: Thousands(), seed=0, num_envs=2, num_steps=16, engine="torch")
    agent.collector.reset(0)
    agent.normalisers.observations.update(np.random.default_rng(0).standard_normal((99, 3)))
    rollout = agent.collector.collect(agent.engine, 16)
    found = cut_shares(rollout, agent.environments, agent.normalisers)
    assert found == {"rollout/observation_outlier_fraction": 1.0}


class Sum(nn.Module):
    """V = the sum of the inputs, so that bootstraps show whether they were normalised."""

    def __init__(self):
        super().__init__()
        self.unused = nn.Parameter(torch.zeros(1))

    def forward(self, observation):
        return torch.zeros(len(observation), 3), observation.sum(1)


def agent_on(env, **values):
    both = dict(normalise_observations=True, normalise_rewards=True, reseed_after=None)
    return tightrope.PPO(env, policy=Sum(), seed=BASE_SEED, num_envs=2, num_steps=30, **{**both, **values})


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_bootstraps_see_normalised_observations_and_statistics_see_no_phantom(mode):
    agent = agent_on(ChainVector(2, autoreset_mode=mode))
    agent.collector.reset(BASE_SEED)
    first = agent.collector.collect(agent.engine, 30)
    raw, mask = first.raw.copy(), first.mask.copy()
    agent.normalisers.update(first)
    moments = agent.normalisers.observations.moments
    np.testing.assert_allclose(agent.normalisers.observations.mean, raw[mask].mean(0), rtol=1e-6)
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
    for during, start, end in zip(seen[1:], before[1:-1], before[2:], strict=True):
        assert (during == start).all()
        assert (end != start).any()


def test_evaluation_leaves_everything_as_it_is():
    agent = tightrope.PPO("CartPole-v1", seed=0, num_envs=2, num_steps=32, minibatch_size=32).learn(256)
    from tightrope.control.rollout.evaluation import evaluate_agent, evaluation_environments

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
