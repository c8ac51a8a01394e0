"""The critic learns normalised returns: values are in units of the return for any scale and offset."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

import tightrope
from tightrope.algorithms.batch import moved_scale
from tightrope.control.resolve import resolve
from tightrope.control.rollout.rollout import to_batch
from tightrope.control.settings import TrainSettings

SMALL = dict(num_envs=4, num_steps=32, minibatch_size=32, hidden=(16,), seed=1, evaluate_every=None)
QUIET = {"notify": lambda text: None}


class Chain(gym.Env):
    """``length`` steps; each pays ``step``, the last ``last``. The observation is the share that is over."""

    observation_space = spaces.Box(-1, 1, (1,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self, length=10, step=0.0, last=1.0):
        self.length, self.pay, self.last = length, step, last

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.t += 1
        end = self.t >= self.length
        return np.full(1, self.t / self.length, np.float32), self.last if end else self.pay, end, False, {}


def chain(**how):
    return lambda: Chain(**how)


def parameters(agent):
    return torch.cat([p.detach().flatten() for p in agent.policy.parameters()])


@pytest.mark.parametrize("engine", ["torch", "fused"])
@pytest.mark.parametrize("size", [2.0**-40, 2.0**40])
def test_the_size_of_rewards_changes_no_weight(engine, size):
    """A power of two changes no rounding, so that nothing may differ in one bit."""
    one, other = (
        tightrope.PPO(chain(step=0.3 * k, last=k), engine=engine, **SMALL, **QUIET).learn(1_024)
        for k in (1.0, size)
    )
    assert torch.equal(parameters(one), parameters(other))
    seen = np.linspace(0, 1, 5, dtype=np.float32)[:, None]
    assert (one.value(seen) * size == other.value(seen)).all()


@pytest.mark.parametrize("rule", [tightrope.PPO, tightrope.A2C, tightrope.Reinforce])
def test_every_update_rule_learns_in_the_scale(rule):
    size = {} if rule is tightrope.PPO else {"minibatch_size": None}
    values = {k: v for k, v in {**SMALL, **size}.items() if v is not None}
    one, other = (rule(chain(last=k), **values, **QUIET).learn(1_024) for k in (1.0, 2.0**20))
    assert torch.equal(parameters(one), parameters(other))
    assert one.normalisers.returns.deviation > 0


@pytest.mark.parametrize(
    "how",
    [dict(last=1.0), dict(step=1e-6, last=1e-6), dict(step=1e6, last=1e6), dict(step=1e4, last=1e4 + 1)],
    ids=["late", "small", "large", "shifted"],
)
def test_values_are_the_returns_of_the_task(how):
    agent = tightrope.PPO(
        chain(**how), num_steps=64, seed=0, gamma=0.99, learning_rate=1e-3, num_envs=8, evaluate_every=None,
        **QUIET,
    ).learn(30_720)  # fmt: skip
    env, expected, worth = Chain(**how), [], 0.0
    for t in reversed(range(env.length)):
        worth = (env.last if t == env.length - 1 else env.pay) + 0.99 * worth
        expected.insert(0, worth)
    seen = (np.arange(env.length, dtype=np.float32) / env.length)[:, None]
    assert agent.value(seen) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(
    ("length", "size", "steps", "off"),
    [(300, {}, 100_000, 0.004), (3_000, dict(num_envs=1, num_steps=2_048), 150_000, 0.03)],
)
def test_values_of_long_episodes_come_near_the_return_at_their_end(length, size, steps, off):
    """What docs/control.md says. 3,000 steps need one copy and long rollouts: the defaults' rollouts of 256
    steps hand the reward on a dozen times, and take far more steps.
    """
    agent = tightrope.PPO(
        chain(length=length), seed=0, gamma=0.999, evaluate_every=None, **size, **QUIET
    ).learn(steps)
    seen = np.arange(length, dtype=np.float32)[:, None] / length
    assert agent.value(seen) == pytest.approx(0.999 ** (length - 1 - np.arange(length)), rel=off)


def test_the_critic_has_a_lambda_of_its_own():
    """With 1 its targets are sums of rewards up to the end or the bootstrap; advantages stay as they are."""
    agent = tightrope.PPO(chain(length=7, step=1.0), **SMALL, **QUIET).learn(512)
    assert agent.settings.critic_lambda == 1.0
    rollout = agent.collector.collect(agent.engine, 32)
    one, own = (
        to_batch(rollout, agent.engine, agent.normalisers, agent.settings.update, value)
        for value in (None, 1.0)
    )
    scale = agent.normalisers.returns
    assert torch.equal(one.advantages, own.advantages)
    before = torch.from_numpy(np.maximum.accumulate(rollout.ended[:, ::-1], 1)[:, ::-1].copy())
    left = torch.from_numpy(np.rint(7 * (1 - rollout.raw[..., 0])))  # rewards of 1 until the end
    expected = (1 - 0.99**left) / 0.01
    assert scale.values(own.returns)[before].numpy() == pytest.approx(expected[before].numpy(), rel=1e-4)
    assert not torch.equal(one.returns, own.returns)


def test_presets_and_old_runs_have_one_lambda():
    assert resolve("CartPole-v1").critic_lambda is None
    old = TrainSettings().to_json()
    del old["critic_lambda"]
    assert TrainSettings.from_json(old).critic_lambda is None


def test_a_new_critic_counts_for_nothing_and_a_later_one_keeps_its_values():
    agent = tightrope.PPO(chain(step=5.0, last=50.0), **SMALL, **QUIET)
    seen = np.linspace(0, 1, 5, dtype=np.float32)[:, None]
    assert not agent.value(seen).any()
    agent.learn(512)
    agent.collector.reset(9)
    rollout = agent.collector.collect(agent.engine, 32)
    batch = to_batch(rollout, agent.engine, agent.normalisers, agent.settings.update)
    before, scale = agent.value(seen), agent.normalisers.returns
    batch = dataclasses.replace(batch, returns=7 * scale.values(batch.returns) + 300)
    _, agent.normalisers.returns, _ = moved_scale(
        batch, scale, agent.policy.last_critic_layer, advantages=True
    )
    assert agent.normalisers.returns.mean > scale.mean + 10
    assert agent.value(seen) == pytest.approx(before, rel=1e-5)


def test_the_batch_is_of_order_1_and_its_returns_are_those_of_the_task(monkeypatch):
    agent = tightrope.PPO(chain(step=1e6, last=-1e6), **SMALL, **QUIET)
    seen, original = [], agent.engine.update
    monkeypatch.setattr(
        agent.engine, "update", lambda batch, *a, **k: (seen.append(batch), original(batch, *a, **k))[1]
    )
    agent.learn(512)
    for batch in seen:
        assert batch.returns.dtype == torch.float32
        assert float(batch.returns.abs().max()) < 10 and float(batch.returns.std()) > 0.3
        assert float(batch.advantages.abs().max()) < 20


def test_equal_rewards_give_no_advantage_at_all():
    """While all returns are alike, the noise of a new critic is not taken for a difference."""
    agent = tightrope.PPO(chain(length=1, last=3.0), entropy_weight=0.0, **SMALL, **QUIET)
    before = [p.detach().clone() for p in agent.policy.actor.parameters()]
    agent.learn(512)
    assert all(torch.equal(a, b) for a, b in zip(before, agent.policy.actor.parameters(), strict=True))
    assert agent.value(np.zeros(1, np.float32)) == 3.0


def test_rewards_that_come_late_are_learned_in_their_own_size():
    """Nothing is paid for many rollouts, then 1e-5 once an episode."""

    class Late(Chain):
        steps = 0

        def step(self, action):
            Late.steps += 1
            self.last = 1e-5 if Late.steps > 5_000 else 0.0
            return super().step(action)

    agent = tightrope.PPO(lambda: Late(), num_envs=8, num_steps=64, seed=0, learning_rate=1e-3, **QUIET)
    first = [agent.normalisers.returns.deviation for _ in agent.iterate(30_720)]
    assert first[0] == 0 and first[-1] > 0
    assert agent.value(np.full(1, 0.9, np.float32)) == pytest.approx(1e-5, rel=0.05)


def test_a_module_of_the_users_learns_it_too():
    class Small(torch.nn.Module):
        def __init__(self):
            super().__init__()
            torch.manual_seed(0)
            self.body, self.heads = torch.nn.Linear(1, 32), torch.nn.Linear(32, 3)

        def forward(self, observations):
            found = self.heads(self.body(observations).tanh())
            return found[:, :2], found[:, 2]

    agent = tightrope.PPO(
        chain(step=1e4, last=1e4), policy=Small(), num_envs=8, num_steps=64, seed=0, learning_rate=1e-2,
        minibatch_size=256, **QUIET,
    ).learn(20_480)  # fmt: skip
    assert agent.value(np.zeros(1, np.float32)) == pytest.approx(1e4 * (1 - 0.99**10) / 0.01, rel=0.05)


def test_without_the_setting_the_critic_learns_plain_returns():
    agent = tightrope.PPO(chain(step=1.0), normalise_values=False, **SMALL, **QUIET).learn(512)
    assert agent.normalisers.returns is None
    seen = np.zeros((1, 1), np.float32)
    assert (
        agent.value(seen)
        == agent.policy.values({"flat": agent.normalisers.encode({"flat": seen})["flat"]}).numpy()
    ).all()


def test_runs_from_before_the_setting_go_on_without_it():
    old = TrainSettings().to_json()
    assert TrainSettings.from_json(old).update.normalise_values
    del old["update"]["normalise_values"]
    assert not TrainSettings.from_json(old).update.normalise_values


def test_divided_rewards_keep_their_order_and_the_divisor_is_shown():
    agent = tightrope.PPO(chain(length=30, last=40.0), normalise_rewards=True, **SMALL, **QUIET)
    shown = [update.metrics["train/reward_scale"] for update in agent.iterate(512)]
    scale = agent.normalisers.rewards.deviation
    assert (
        shown[-1] > 0
        and (agent.normalisers.rewards(np.array([1e3, 2e3])) == np.array([1e3, 2e3]) / scale).all()
    )
