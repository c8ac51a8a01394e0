"""Each probe isolates one part: value, discount, policy, conditioning. Seconds each."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from learning.probes import (
    ConditionProbe,
    DiscountProbe,
    Forever,
    Identity,
    PolicyProbe,
    ValueByObservation,
    ValueProbe,
)

import tightrope

FAST = dict(num_envs=8, num_steps=32, minibatch_size=64, learning_rate=3e-3, hidden=(32,), entropy_weight=0.0)
PLAIN = dict(normalise_observations=False, normalise_rewards=False)
RULES = [
    (tightrope.PPO, {**FAST, **PLAIN}, 8_000),
    (tightrope.A2C, {**FAST, **PLAIN, "num_steps": 8, "learning_rate": 1e-2}, 16_000),
    (tightrope.Reinforce, {**FAST, **PLAIN, "num_steps": 8, "learning_rate": 1e-2}, 16_000),
]


def train(rule, env, **changes):
    make, values, steps = rule
    steps = changes.pop("steps", steps)
    for key in ("minibatch_size",):
        if make is not tightrope.PPO:
            values = {k: v for k, v in values.items() if k != key}
    agent = make(env, seed=3, **{**values, **changes})
    return agent.learn(steps)


@pytest.mark.parametrize("rule", RULES, ids=["ppo", "a2c", "reinforce"])
def test_value_of_a_constant(rule):
    agent = train(rule, ValueProbe)
    assert agent.value(np.zeros(1, np.float32)) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("rule", RULES, ids=["ppo", "a2c", "reinforce"])
def test_value_depends_on_the_observation(rule):
    agent = train(rule, ValueByObservation)
    values = agent.value(np.array([[-1.0], [1.0]], np.float32))
    assert values == pytest.approx([-1.0, 1.0], abs=0.15)


@pytest.mark.parametrize("rule", RULES, ids=["ppo", "a2c", "reinforce"])
def test_value_is_discounted(rule):
    agent = train(rule, DiscountProbe, gamma=0.5, steps=16_000)
    values = agent.value(np.array([[0.0], [1.0]], np.float32))
    assert values == pytest.approx([0.5, 1.0], abs=0.1)


@pytest.mark.parametrize("rule", RULES, ids=["ppo", "a2c", "reinforce"])
def test_policy_takes_what_pays(rule):
    agent = train(rule, PolicyProbe)
    assert agent.predict(np.zeros(1, np.float32))[0] == 1


@pytest.mark.parametrize("rule", RULES, ids=["ppo", "a2c", "reinforce"])
def test_policy_depends_on_the_observation(rule):
    agent = train(rule, ConditionProbe)
    actions, _ = agent.predict(np.array([[-1.0], [1.0]], np.float32))
    assert actions.tolist() == [0, 1]


def test_reinforce_without_baseline_learns_too():
    agent = train(RULES[2], ConditionProbe, baseline=False)
    actions, _ = agent.predict(np.array([[-1.0], [1.0]], np.float32))
    assert actions.tolist() == [0, 1]


@pytest.mark.parametrize("backend", ["serial", "workers"])
@pytest.mark.parametrize("engine", ["torch", "auto"])
def test_a_time_limit_is_not_death(backend, engine):
    """Reward 1 for ever under a limit of 8 steps: V = 1 / (1 - 0.95) = 20 within 2 %.

    If truncation were treated as termination, V could not exceed 8.
    """
    values = {**FAST, **PLAIN, "learning_rate": 1e-2, "num_epochs": 10, "gamma": 0.95, "seed": 1}
    values |= {"vector_backend": backend, "num_workers": 2, "engine": engine}
    agent = tightrope.PPO(lambda: TimeLimit(Forever(), 8), **values)
    agent.learn(60_000)
    agent.close()
    assert agent.value(np.zeros(1, np.float32)) == pytest.approx(20.0, rel=0.02)


SPACES = {
    "discrete": spaces.Discrete(4),
    "discrete-start": spaces.Discrete(3, start=-1),
    "multi-discrete": spaces.MultiDiscrete([3, 2]),
    "multi-binary": spaces.MultiBinary(3),
    "box": spaces.Box(-1.0, 1.0, (2,), np.float32),
    "tuple": spaces.Tuple((spaces.Discrete(3), spaces.Box(-1.0, 1.0, (1,), np.float32))),
    "dict": spaces.Dict(a=spaces.Discrete(2), b=spaces.Tuple((spaces.MultiBinary(2), spaces.Discrete(2)))),
}


@pytest.mark.parametrize("name", SPACES)
def test_identity_in_every_space(name):
    """Answer with the observation: at least 85 % of the reward after 24,000 steps."""
    agent = tightrope.PPO(
        lambda: Identity(SPACES[name]), seed=2, gamma=0.5, **{**FAST, **PLAIN}, log_std_init=-0.5
    )
    agent.learn(24_000)
    env = Identity(SPACES[name], length=300)
    observation, _ = env.reset(seed=11)
    total, truncated = 0.0, False
    while not truncated:
        action, _ = agent.predict(observation)
        assert env.action_space.contains(action) or isinstance(env.action_space, spaces.Box)
        observation, reward, _, truncated, _ = env.step(action)
        total += reward
    assert total / 300 >= 0.85


@pytest.mark.parametrize(
    "changes",
    [
        {"action_bounds": "squash"},
        {"std": "state"},
        {"std": "gsde"},
        {"std": "gsde", "action_bounds": "squash"},
    ],
    ids=str,
)
def test_identity_with_every_kind_of_gaussian(changes):
    values = {**FAST, **PLAIN, "hidden": (32, 32), "log_std_init": -0.5, "gamma": 0.5, **changes}
    agent = tightrope.PPO(lambda: Identity(SPACES["box"]), seed=2, **values).learn(32_000)
    env = Identity(SPACES["box"], length=300)
    observation, _ = env.reset(seed=11)
    total = 0.0
    for _ in range(300):
        action, _ = agent.predict(observation)
        observation, reward, *_ = env.step(action)
        total += reward
    assert total / 300 >= 0.8


class MaskedBandit(gym.Env):
    """Five arms; a changing set is forbidden, and pulling a forbidden arm is an error. The best allowed arm
    pays 1.
    """

    observation_space = spaces.Box(0.0, 1.0, (5,), np.float32)
    action_space = spaces.Discrete(5)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self._next()

    def _next(self):
        self.allowed = self.np_random.random(5) < 0.5
        self.allowed[self.np_random.integers(5)] = True
        return self.allowed.astype(np.float32), {"action_mask": self.allowed.astype(np.int8)}

    def step(self, action):
        assert self.allowed[action], f"arm {action} is forbidden"
        reward = float(action == np.flatnonzero(self.allowed)[-1])
        self.t += 1
        observation, info = self._next()
        return observation, reward, False, self.t >= 16, info


@pytest.mark.parametrize("engine", ["torch", "auto"])
def test_masks_hold_in_sampling_and_training(engine):
    agent = tightrope.PPO(MaskedBandit, seed=0, engine=engine, gamma=0.5, **{**FAST, **PLAIN}).learn(24_000)
    env = MaskedBandit()
    observation, info = env.reset(seed=5)
    total = 0.0
    for _ in range(200):
        action, _ = agent.predict(observation, action_masks=info["action_mask"])
        observation, reward, _, _, info = env.step(action)
        total += reward
    assert total >= 170
