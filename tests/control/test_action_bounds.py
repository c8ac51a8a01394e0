"""One function turns the policy's numbers into the task's action, wherever one is given or named."""

from __future__ import annotations

import json

import gymnasium as gym
import numpy as np
import pytest
from chain import ChainVector
from gymnasium import spaces

import tightrope
from tightrope.control.environments.faults import EnvironmentFault
from tightrope.control.environments.make import make_environments
from tightrope.control.resolve import resolve
from tightrope.control.rollout.collector import BadNumbers
from tightrope.control.rollout.evaluation import evaluate_agent, evaluation_environments
from tightrope.control.settings import TrainSettings
from tightrope.control.spaces.structure import Reading

SEEN: list[float] = []


class Wide(gym.Env):
    """Actions of 100..200 in float64; the fourth step raises, or returns NaN."""

    def __init__(self, how: str = "", high: float = 200.0) -> None:
        self.how, self.time = how, 0
        self.observation_space = spaces.Box(-1, 1, (1,), np.float64)
        self.action_space = spaces.Box(100.0, high, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return np.zeros(1), {}

    def step(self, action):
        assert self.action_space.contains(action)
        SEEN.append(float(action[0]))
        self.time += 1
        if self.how == "raise" and self.time == 4:
            raise RuntimeError("broken")
        seen = np.full(1, np.nan if self.how == "nan" and self.time == 4 else 0.0)
        return seen, -abs(action[0] - 175) / 100, self.time == 10, False, {}


class WideVector(gym.vector.VectorEnv):
    """Copies of Wide."""

    metadata = ChainVector(1).metadata

    def __init__(self) -> None:
        self.num_envs, self.env = 2, Wide("raise")
        self.single_observation_space, self.single_action_space = (
            self.env.observation_space,
            self.env.action_space,
        )

    def reset(self, *, seed=None, options=None):
        return np.zeros((2, 1)), {}

    def step(self, actions):
        self.env.time = 3 if actions[0, 0] == 150 else 0
        self.env.step(actions[0])
        return np.zeros((2, 1)), np.zeros(2), np.zeros(2, bool), np.zeros(2, bool), {}


@pytest.mark.parametrize("backend", ["serial", "workers", "vector"])
def test_an_environment_gets_its_own_units_and_a_fault_names_them(backend):
    if backend == "vector":
        environments = make_environments(WideVector())
    else:
        environments = make_environments(lambda: Wide("raise"), 2, backend=backend, num_workers=2)
    with environments:
        environments.reset(0)
        with pytest.raises(EnvironmentFault, match=r"last action \[+(array\(\[)?150") as caught:
            for action in (-1.0, 0.5, 1.0, 0.0):
                environments.step(np.full((2, 1), action, np.float32))
        assert "raised RuntimeError" in str(caught.value)


def test_bad_numbers_name_the_environments_action():
    agent = tightrope.PPO(lambda: Wide("nan"), seed=0, num_envs=2, num_steps=16, engine="torch")
    with pytest.raises(BadNumbers, match=r"last action \[1[0-9][0-9]\."):
        agent.learn(64)


@pytest.mark.parametrize("bounds", ["map", "clip", "squash"])
def test_training_evaluation_and_predict_agree(bounds):
    agent = tightrope.PPO(lambda: Wide(), seed=0, num_envs=2, num_steps=16, action_bounds=bounds).learn(96)
    given, _ = agent.predict(np.zeros((3, 1)))
    one, _ = agent.predict(np.zeros(1))
    assert given.dtype == one.dtype == np.float64 and np.allclose(given, one) and 100 <= one[0] <= 200
    SEEN.clear()
    with evaluation_environments(agent.env, agent.settings, 2) as environments:
        evaluate_agent(agent, environments, 2)
    assert pytest.approx([one[0]] * 20) == SEEN
    assert one[0] == 100 if bounds == "clip" else 120 < one[0] < 180


@pytest.mark.parametrize(
    ("low", "high"), [(100.0, 200.0), (-1000.0, 1000.0), (-0.01, 0.01), (0.0, 512.0), (-1.0, 1.0)], ids=str
)
def test_the_best_action_of_any_range_is_found(low, high):
    """Three quarters up the range; one-step episodes."""

    class Target(gym.Env):
        def __init__(self):
            self.observation_space = spaces.Box(-1, 1, (1,))
            self.action_space = spaces.Box(np.float32(low), np.float32(high), (1,))

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return np.zeros(1, np.float32), {}

        def step(self, action):
            share = (float(action[0]) - low) / (high - low)
            return np.zeros(1, np.float32), -abs(share - 0.75), True, False, {}

    fast = dict(num_envs=8, num_steps=32, learning_rate=3e-3, hidden=(16,))
    agent = tightrope.PPO(lambda: Target(), seed=0, **fast).learn(8_000)
    assert (agent.predict(np.zeros(1, np.float32))[0][0] - low) / (high - low) == pytest.approx(
        0.75, abs=0.05
    )


def test_copies_with_other_bounds_are_refused():
    highs = iter((200.0, 300.0))
    with pytest.raises(ValueError, match="must have the same spaces"):
        make_environments(lambda: Wide(high=next(highs)), 2)


def test_what_cannot_be_mapped_is_told_once():
    class Unbounded(Wide):
        def __init__(self):
            super().__init__()
            self.action_space = spaces.Box(-np.inf, np.inf, (1,))

    told: list[str] = []
    small = dict(num_envs=2, num_steps=16, engine="torch", notify=told.append)
    agent = tightrope.PPO(Unbounded, seed=0, **small).learn(96).learn(32)
    assert [line for line in told if "1 of 1 Box action dimensions have no two finite bounds" in line] == told
    assert len(told) == 1
    agent.close()
    tightrope.PPO(Unbounded, seed=0, action_bounds="clip", **small).learn(96)
    assert len(told) == 1


def test_old_settings_say_what_their_runs_did(tmp_path):
    old = {
        name: value
        for name, value in TrainSettings().to_json().items()
        if name not in ("action_bounds", "encoder")
    }
    for squash, bounds in ((True, "squash"), (False, "clip"), (None, "clip")):
        data = old if squash is None else {**old, "squash": squash}
        settings = TrainSettings.from_json(json.loads(json.dumps(data)))
        assert (settings.action_bounds, settings.encoder) == (bounds, "old")
        assert Reading.of(settings) == Reading("old", bounds)
    again = TrainSettings.values_from_json({**old, "squash": True})  # train --settings OLD/settings.json
    assert (again["action_bounds"], again["encoder"]) == ("squash", "old")
    by_hand = TrainSettings.values_from_json({"env": "Pendulum-v1", "num_envs": 4})
    assert "action_bounds" not in by_hand and "encoder" not in by_hand
    assert TrainSettings.from_json(TrainSettings().to_json()) == TrainSettings()
    with pytest.raises(ValueError, match="squash"):
        TrainSettings.from_json({**old, "squash": "yes"})


def test_the_old_name_leads_to_the_new_one():
    with pytest.raises(ValueError, match="no setting named 'squash'. Did you mean 'action_bounds squash'"):
        resolve("Pendulum-v1", "ppo", {"squash": True})
