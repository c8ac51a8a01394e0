"""The file of an episode that failed: the documented lines repeat it; the message has the same seed."""

import json

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from tightrope.control.environments import state
from tightrope.control.environments.episode import TRAINING, episode_seed
from tightrope.control.environments.faults import EnvironmentFault
from tightrope.control.rollout.collector import BadNumbers
from tightrope.control.train import resolve, train

ID = "tightrope_tests/Falls-v0"
PARTS = {
    "box": spaces.Box(100, 200, (2, 1), np.float32),
    "doubles": spaces.Box(-np.inf, np.inf, (2,), np.float64),
    "whole": spaces.Box(0, 255, (3,), np.uint8),
    "number": spaces.Box(-1, 1, (), np.float32),
    "choice": spaces.Discrete(3, start=5),
    "choices": spaces.MultiDiscrete([2, 3], start=[1, 7]),
    "bits": spaces.MultiBinary((2, 2)),
}
SPACES = {**PARTS, "dict": spaces.Dict(PARTS)}
SPACES["tuple"] = spaces.Tuple(
    (PARTS["choice"], spaces.Dict(a=PARTS["box"], b=spaces.Tuple((PARTS["bits"],))))
)


def _flat(space, action):
    return [float(x) for x in np.ravel(spaces.flatten(space, action))]


class Falls(gym.Env):
    """Fails at a step that depends on the seed, the actions and what it keeps; the message holds them all."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)

    def __init__(self, of="choice", how="raise", fatal=14, length=6, at=4):
        self.action_space, self.how, self.fatal, self.length, self.at = SPACES[of], how, fatal, length, at
        self.begun = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.begun = self.begun + 1
        self.seen, self.drawn = [], self.np_random.random()
        bad = self.how == "nan at reset" and self.begun == self.fatal
        return np.full(1, np.nan if bad else self.drawn, np.float32), {}

    def step(self, action):
        self.seen.append(_flat(self.action_space, action))
        bad = self.begun == self.fatal and len(self.seen) == self.at
        if bad and self.how == "raise":
            raise RuntimeError(f"fell {self.drawn} {self.begun} {self.seen}")
        observation = np.full(1, np.nan if bad and self.how == "nan" else self.drawn, np.float32)
        return observation, 0.0, len(self.seen) == self.length, False, {}


@pytest.fixture
def falls(tmp_path):
    """Train until it fails; the message and the file."""
    gym.register(ID, Falls)

    def run(keywords, **values):
        values = {"num_envs": 1, "num_steps": 32, "minibatch_size": 32, "engine": "torch", **values}
        values |= {"total_steps": 4096, "vector_backend": values.get("vector_backend", "serial")}
        values |= {"evaluate_every": None, "env_kwargs": keywords, "seed": 3}
        with pytest.raises((EnvironmentFault, BadNumbers)) as error:
            train(resolve(ID, "ppo", values), run_dir=tmp_path / "run")
        file = tmp_path / "run/fault-0001.json"
        return str(error.value), json.loads(file.read_text()) if file.exists() else None

    yield run
    del gym.registry[ID]


def _repeated(fault):
    """The lines of docs/faults.md; what they raise, or the last observation."""
    env = gym.make(fault["id"], disable_env_checker=True, **fault["kwargs"])
    if fault["carried"]:
        state.give(env, fault["carried"], fault["seed"])
    found, _ = env.reset(seed=fault["seed"])
    try:
        for action in env.action_space.from_jsonable(fault["actions"]):
            found = env.step(action)[0]
    except RuntimeError as error:
        return str(error)
    return found


@pytest.mark.parametrize("of", SPACES)
def test_the_lines_repeat_it_for_actions_of_every_space(falls, of):
    message, fault = falls({"of": of})
    assert fault["steps"] == 4 and fault["carried"] and not fault["carried_lost"]
    assert (said := _repeated(fault)).startswith("fell ") and said in message
    assert f"seed {fault['seed']}, last action" in message


@pytest.mark.parametrize("num_steps", [6, 32, 400])
def test_what_the_task_kept_is_there_wherever_the_episode_began(falls, num_steps):
    message, fault = falls({}, num_steps=num_steps, minibatch_size=6)
    assert _repeated(fault) in message and not fault["carried_lost"]


@pytest.mark.parametrize(("how", "at"), [("nan", 4), ("nan at reset", 0)])
@pytest.mark.parametrize("backend", ["serial", "workers"])
def test_the_seed_of_a_nan_is_that_of_its_episode(falls, how, at, backend):
    message, fault = falls({"how": how}, num_steps=400, vector_backend=backend, minibatch_size=6)
    # many more episodes began before the NaN was looked for
    assert f"seed {fault['seed']}, " in message and fault["steps"] == at
    assert ("no action yet" in message) == (how == "nan at reset")
    assert fault["carried_lost"] and "what the task kept from earlier episodes is not known" in message
    assert fault["seed"] == episode_seed(3, TRAINING, 0, 13)


@pytest.mark.parametrize("backend", ["serial", "workers"])
def test_a_nan_of_an_episode_that_still_runs_has_what_the_task_kept(falls, backend):
    keywords = {"how": "nan", "length": 400, "fatal": 2}
    _, fault = falls(keywords, num_steps=410, minibatch_size=10, vector_backend=backend)
    assert not fault["carried_lost"] and np.isnan(_repeated(fault)).all()


def test_a_fault_in_a_worker_says_that_what_the_task_kept_is_not_known(falls):
    message, fault = falls({}, num_steps=400, vector_backend="workers", minibatch_size=6)
    assert fault["carried_lost"] and fault["carried"] is None and "is not known" in message


def test_an_episode_beyond_the_replay_limit_has_its_seed_in_the_message_and_no_file(falls):
    message, fault = falls({"fatal": 1, "length": 2000, "at": 900}, num_steps=32, replay_limit=64)
    assert fault is None and f"seed {episode_seed(3, TRAINING, 0, 0)}, last action" in message
    assert "Its episode was longer than replay_limit 64: no file holds its actions." in message
