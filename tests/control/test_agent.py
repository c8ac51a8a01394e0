"""The Python interface: learn, iterate, predict, value, save, load, warm start."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import nn

import tightrope
from tightrope.algorithms import ppo
from tightrope.control.engine.compiled_engine import CHECK_LIMIT

SMALL = dict(num_envs=4, num_steps=32, minibatch_size=32, num_epochs=2)


def parameters(agent):
    return torch.cat([p.detach().flatten() for p in agent.policy.parameters()])


def make(env="CartPole-v1", **values):
    return tightrope.PPO(env, **{**SMALL, "seed": 1, **values})


@pytest.mark.parametrize("backend", ["serial", "vector"])
@pytest.mark.parametrize("budget", [8, 127, 500, 1000])
def test_total_steps_are_never_exceeded_and_nearly_used(backend, budget):
    agent = make(vector_backend=backend).learn(budget)
    assert agent.steps <= budget
    assert agent.steps > budget - 4 * 32


def test_steps_are_agent_steps_not_phantom_rows():
    agent = make(vector_backend="vector", checkpoint_every=None)  # whose points cut episodes
    totals = [sum(length for _, length, _ in report.episodes) for report in agent.iterate(2000)]
    running = int(agent.collector._lengths.sum())
    assert sum(totals) + running == agent.steps


def test_iterate_reports_every_update():
    agent = make()
    reports = list(agent.iterate(1024))
    assert [r.step for r in reports] == sorted({r.step for r in reports})
    for report in reports:
        assert report.metrics["train/log_ratio_first"] < 1e-5
        assert report.metrics["train/minibatches"] > 0
    assert any(report.episodes for report in reports)


def test_learn_continues_and_schedules_run_over_the_new_budget():
    agent = make().learn(512)
    rates = [r.metrics["train/learning_rate"] for r in agent.iterate(512)]
    assert rates[0] == pytest.approx(agent.settings.update.learning_rate)
    assert agent.steps > 900


def test_same_seed_same_bits_and_another_seed_others():
    a, b, c = make().learn(600), make().learn(600), make(seed=2).learn(600)
    assert torch.equal(parameters(a), parameters(b))
    assert not torch.equal(parameters(a), parameters(c))


def test_both_engines_learn_the_same():
    """Same permutations, same noise: the weights agree after several rollouts."""
    a, b = make(engine="fused", num_steps=64).learn(600), make(engine="torch", num_steps=64).learn(600)
    assert a.engine.name == "fused" and b.engine.name == "torch"
    torch.testing.assert_close(parameters(a), parameters(b), rtol=1e-3, atol=1e-4)


def test_control_updates_go_through_the_one_update_rule(monkeypatch):
    calls = []
    original = ppo.update
    monkeypatch.setattr(ppo, "update", lambda *args, **more: calls.append(1) or original(*args, **more))
    make(engine="torch").learn(256)
    assert len(calls) == 2


@pytest.mark.parametrize("deterministic", [True, False])
def test_predict_takes_one_observation_or_many(deterministic):
    agent = make()
    one, state = agent.predict(np.zeros(4, np.float32), deterministic)
    many, _ = agent.predict(np.zeros((5, 4), np.float32), deterministic)
    assert state is None
    assert agent.environments.action_layout.space.contains(one)
    assert np.shape(one) == () and many.shape == (5,)


def test_value_takes_one_observation_or_many():
    agent = make(normalise_rewards=True).learn(512)
    one = agent.value(np.zeros(4, np.float32))
    assert isinstance(one, float)
    assert agent.value(np.zeros((3, 4), np.float32)) == pytest.approx([one] * 3, rel=1e-5)


@pytest.mark.parametrize("kind", [tightrope.PPO, tightrope.A2C, tightrope.Reinforce])
def test_save_load_keeps_actions_values_and_learning(kind, tmp_path):
    values = dict(num_envs=4, num_steps=32, seed=1, normalise_observations=True, normalise_rewards=True)
    agent = kind("CartPole-v1", **values).learn(512)
    agent.save(tmp_path / "pole")
    twin = tightrope.load(tmp_path / "pole")
    assert type(twin) is kind
    observations = np.random.default_rng(0).standard_normal((64, 4)).astype(np.float32)
    assert (agent.predict(observations)[0] == twin.predict(observations)[0]).all()
    assert (agent.value(observations) == twin.value(observations)).all()
    assert torch.equal(parameters(agent), parameters(twin))
    state = [p.optimiser.state_dict()["state"] for p in (agent, twin)]
    for key, entry in state[0].items():
        for name, x in entry.items():
            assert torch.equal(x, state[1][key][name])
    twin.learn(256)
    assert not torch.equal(parameters(agent), parameters(twin))


def test_a_saved_agent_of_one_engine_continues_with_the_other(tmp_path):
    make(engine="fused").learn(256).save(tmp_path / "a")
    agent = tightrope.load(tmp_path / "a")
    assert agent.engine.name == "fused"
    agent.learn(128)


class Renamed(gym.ObservationWrapper):
    """CartPole under another name with other parameters, for a warm start."""

    def observation(self, observation):
        return observation * 1.0


def test_warm_start_on_another_environment(tmp_path):
    agent = make().learn(256)
    before = parameters(agent).clone()
    agent.set_env(lambda: Renamed(gym.make("CartPole-v1", max_episode_steps=100)))
    assert torch.equal(parameters(agent), before)
    agent.learn(256)
    assert not torch.equal(parameters(agent), before)
    agent.save(tmp_path / "x")
    with pytest.raises(ValueError, match=r"name it again in Python:\nload\(.*env=\.\.\.\)"):
        tightrope.load(tmp_path / "x")
    assert tightrope.load(tmp_path / "x", env="CartPole-v1").settings.env == "CartPole-v1"


def test_warm_start_refuses_other_spaces():
    with pytest.raises(ValueError, match="this policy was made for"):
        make().set_env("Acrobot-v1")


class Reach(gym.Env):
    """A Box to see and one to act in, with these bounds."""

    def __init__(self, seen, acted):
        self.observation_space = gym.spaces.Box(-seen, seen, (2,), np.float32)
        self.action_space = gym.spaces.Box(-acted, acted, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        return np.zeros(2, np.float32), 0.0, True, False, {}


def test_other_bounds_of_actions_are_other_actions(tmp_path):
    """They are mapped; no network sees those of observations."""
    agent = make(lambda: Reach(1, 1))
    agent.save(tmp_path / "x")
    for seen, acted, fits in ((500, 1, True), (1, 200, False)):
        env = lambda seen=seen, acted=acted: Reach(seen, acted)  # noqa: E731
        if fits:
            agent.set_env(env)
            tightrope.load(tmp_path / "x", env=env)
            continue
        with pytest.raises(ValueError, match="this policy was made for"):
            agent.set_env(env)
        with pytest.raises(ValueError, match="trained on action bounds"):
            tightrope.load(tmp_path / "x", env=env)


class Own(nn.Module):
    def __init__(self, observation_space, action_space):
        super().__init__()
        self.body = nn.Linear(observation_space.shape[0], 16)
        self.pi, self.v = nn.Linear(16, int(action_space.n)), nn.Linear(16, 1)

    def forward(self, observation):
        x = torch.tanh(self.body(observation))
        return self.pi(x), self.v(x)[:, 0]


def test_own_module_trains_on_torch_saves_and_loads(tmp_path):
    agent = make(policy=Own).learn(512)
    assert agent.engine.name == "torch" and "own modules" in agent.engine_line
    agent.save(tmp_path / "own")
    with pytest.raises(ValueError, match="module of your own"):
        tightrope.load(tmp_path / "own")
    twin = tightrope.load(tmp_path / "own", policy=Own)
    assert torch.equal(parameters(agent), parameters(twin))


def test_the_error_for_wrong_module_outputs_names_the_right_ones():
    class Wrong(Own):
        def forward(self, observation):
            return self.pi(torch.tanh(self.body(observation)))

    with pytest.raises(ValueError, match=r"expected a pair .* values of shape"):
        make(policy=Wrong).learn(128)


def test_forced_engine_names_what_it_does_not_cover():
    with pytest.raises(ValueError, match="dual_clip"):
        make(engine="fused", dual_clip=3.0)
    assert make(dual_clip=3.0).engine.name == "torch"


class Images(gym.Env):
    """Bright or dark images; the brightness is the right answer."""

    observation_space = spaces.Box(0, 255, (16, 16, 1), np.uint8)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self._draw(), {}

    def _draw(self):
        self.bright = int(self.np_random.integers(2))
        return np.full((16, 16, 1), 40 + 150 * self.bright, np.uint8)

    def step(self, action):
        reward = float(action == self.bright)
        self.t += 1
        return self._draw(), reward, False, self.t >= 8, {}


def test_images_through_the_cnn():
    values = dict(
        num_envs=4, num_steps=32, minibatch_size=64, num_epochs=4, seed=0, learning_rate=1e-3, hidden=()
    )
    agent = tightrope.PPO(Images, **values, gamma=0.5, threads=1).learn(3072)
    assert agent.engine.name == "torch"
    env = Images()
    observation, _ = env.reset(seed=3)
    score = 0
    for _ in range(50):
        action, _ = agent.predict(observation)
        observation, reward, *_ = env.step(action)
        score += reward
    assert score >= 45


class Nested(gym.Env):
    """Every kind of observation at once; the Discrete leaf is the answer."""

    observation_space = spaces.Dict(
        {
            "a": spaces.Tuple((spaces.Discrete(3, start=1), spaces.MultiBinary(2))),
            "b": spaces.Dict({"c": spaces.Box(-1, 1, (2, 2), np.float32), "d": spaces.MultiDiscrete([2, 3])}),
            "e": spaces.Box(0, 255, (8, 8), np.uint8),
        }
    )
    action_space = spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.t = 0
        self.state = self.observation_space.sample()
        return self.state, {}

    def step(self, action):
        reward = float(action == self.state["a"][0] - 1)
        self.t += 1
        self.state = self.observation_space.sample()
        return self.state, reward, False, self.t >= 16, {}


def test_nested_observations():
    values = dict(
        num_envs=4, num_steps=32, minibatch_size=64, num_epochs=4, learning_rate=1e-3, hidden=(), gamma=0.5
    )
    agent = tightrope.PPO(Nested, seed=0, threads=1, **values).learn(6_144)
    env = Nested()
    observation, _ = env.reset(seed=3)
    score = 0
    for _ in range(60):
        action, _ = agent.predict(observation)
        observation, reward, *_ = env.step(action)
        score += reward
    assert score >= 40  # chance is 20


def test_first_ratios_are_checked(monkeypatch):
    """A policy whose training path differs from its sampling path is stopped before the first step."""
    agent = make(engine="torch")
    original = agent.policy.forward

    def shifted(batch):
        now = original(batch)
        return type(now)(now.logp + 0.01, now.entropy, now.values)

    monkeypatch.setattr(agent.policy, "forward", shifted)
    before = parameters(agent).clone()
    from tightrope.algorithms.descent import SamplingMismatch

    with pytest.raises(SamplingMismatch, match="dropout"):
        agent.learn(256)
    assert torch.equal(parameters(agent), before)


def test_the_compiled_engine_is_checked_against_ppo(monkeypatch):
    said = []
    make(engine="fused", notify=said.append).learn(256)
    assert any("largest difference" in line for line in said)
    broken = make(engine="fused")
    monkeypatch.setattr(broken.engine, "check_first_minibatch", lambda batch, settings: 0.01)
    with pytest.raises(RuntimeError, match="--engine torch"):
        broken.learn(256)
    assert CHECK_LIMIT <= 1e-4


def test_kl_penalty_adapts_and_is_saved(tmp_path):
    agent = make(kl_beta=1.0, kl_adapt=1e-9).learn(512)
    assert agent.kl_beta > 1.0
    agent.save(tmp_path / "k")
    assert tightrope.load(tmp_path / "k").kl_beta == agent.kl_beta


def test_reinforce_masks_unfinished_episodes_without_a_baseline():
    from tightrope.control.rollout.rollout import finished

    ended = np.array([[0, 1, 0, 0, 1, 0], [0, 0, 0, 0, 0, 0]], bool)
    whole = np.ones_like(ended)
    assert finished(ended, whole).tolist() == [[True] * 5 + [False], [False] * 6]
    whole[0, 4] = False  # the second episode ended in a fault
    assert finished(ended, whole).tolist() == [[True] * 2 + [False] * 4, [False] * 6]
    agent = tightrope.Reinforce("CartPole-v1", num_envs=2, num_steps=4, baseline=False, seed=0)
    before = parameters(agent).clone()
    reports = list(agent.iterate(8))
    assert torch.equal(parameters(agent), before)  # no episode ended: nothing to learn from
    assert "train/minibatches" not in reports[0].metrics
