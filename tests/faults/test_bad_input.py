"""Errors for bad input state the value, the expectation and the remedy; exit code 2; weights unchanged."""

import json

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

import tightrope
from tightrope.cli.main import main
from tightrope.control.environments.faults import EnvironmentFault
from tightrope.control.rollout.collector import BadNumbers

SMALL = dict(num_envs=2, num_steps=16, minibatch_size=16, num_epochs=1, seed=0)


class Faulty(gym.Env):
    """CartPole-like shapes; fails at a given step."""

    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self, fault, at=5, last=False):
        self.fault, self.at, self.last, self.t = fault, at, last, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(3, np.float32), {}

    def step(self, action):
        self.t += 1
        observation, reward = np.zeros(3, np.float32), 1.0
        if self.t == self.at:
            if self.fault in ("nan", "inf"):
                observation[1] = float(self.fault)
            if self.fault == "nan reward":
                reward = float("nan")
            if self.fault == "raise":
                raise RuntimeError("the simulator broke")
            if self.fault == "shape":
                observation = np.zeros(4, np.float32)
            if self.fault == "four":
                return observation, reward, False, {}
        return observation, reward, False, self.last and self.t == self.at, {}


def parameters(agent):
    return torch.cat([p.detach().flatten().clone() for p in agent.policy.parameters()])


@pytest.mark.parametrize("engine", ["torch", "fused"])
@pytest.mark.parametrize("normalise", [False, True])
@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("nan", r"Environment 0 .* observation = nan at step 5, index 1"),
        ("inf", r"Environment 0 .* observation = inf at step 5, index 1"),
        ("nan reward", r"Environment 0 .* reward = nan at step 5"),
    ],
)
def test_nan_from_an_environment_is_named_and_not_learned_from(engine, normalise, fault, words):
    agent = tightrope.PPO(
        lambda: Faulty(fault),
        engine=engine,
        normalise_observations=normalise,
        vector_backend="serial",
        **SMALL,
    )
    before = parameters(agent)
    with pytest.raises(BadNumbers, match=words):
        agent.learn(200)
    assert torch.equal(parameters(agent), before)


def test_nan_in_the_true_final_observation_is_caught():
    agent = tightrope.PPO(lambda: Faulty("nan", last=True), vector_backend="serial", **SMALL)
    with pytest.raises(BadNumbers, match="final observation = nan"):
        agent.learn(200)


@pytest.mark.parametrize("backend", ["serial", "workers"])
@pytest.mark.parametrize(
    ("fault", "words"), [("raise", "the simulator broke"), ("shape", "shape"), ("four", "five|5")]
)
def test_an_environment_that_breaks_is_named(backend, fault, words):
    agent = tightrope.PPO(lambda: Faulty(fault), vector_backend=backend, num_workers=2, **SMALL)
    with pytest.raises((EnvironmentFault, ValueError), match=words):
        agent.learn(200)
    agent.close()


def test_the_error_for_an_instance_that_cannot_be_copied_names_the_alternative():
    env = Faulty("none")
    env.lock = __import__("threading").Lock()
    with pytest.raises(ValueError, match=r"num_envs=1|factory"):
        tightrope.PPO(env, **SMALL)


@pytest.mark.parametrize("space", [spaces.Text(5), spaces.Sequence(spaces.Discrete(2))])
def test_unsupported_spaces_are_named(space):
    class Odd(Faulty):
        observation_space = space

    with pytest.raises(ValueError, match="supported"):
        tightrope.PPO(lambda: Odd("none"), **SMALL)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["CartPol-v1"], ["CartPole-v1"]),
        (["CartPole-v1", "--n-steps", "5"], ["--num-steps"]),
        (["CartPole-v1", "--clip-range", "0.1"], ["--clip"]),
        (["CartPole-v1", "--ent_coef", "0.1"], ["--entropy-weight"]),
        (["CartPole-v1", "--learning-rat", "0.1"], ["--learning-rate"]),
        (["CartPole-v1", "--minibatch-size", "5000", "--num-envs", "2", "--num-steps", "8"], ["5000", "16"]),
        (["CartPole-v1", "--gamma", "1.5"], ["1.5", "<= 1"]),
        (["CartPole-v1", "--algorithm", "a2c", "--clip", "0.2"], ["clip", "a2c"]),
        (["CartPole-v1", "--engine", "fused", "--dual-clip", "3"], ["dual_clip"]),
        (
            ["CartPole-v1", "--learning-rate", "1e38", "--num-steps", "16", "--minibatch-size", "16"],
            ["as before"],
        ),
    ],
)
def test_a_users_mistake_exits_with_2_and_advice(arguments, words, capsys, tmp_path):
    try:
        code = main(["train", *arguments, "--run-dir", str(tmp_path / "run"), "--total-steps", "100"])
    except SystemExit as error:
        code = error.code
    text = capsys.readouterr().err
    assert code == 2
    assert all(word in text for word in words), text
    assert "Traceback" not in text


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--clip", "0.5"], "above 0.3"),
        (["--num-epochs", "16"], "above 15"),
        (["--no-normalise-advantages"], "not normalised"),
        (["--max-grad-norm", "none"], "not clipped"),
    ],
)
def test_risky_settings_are_trained_as_asked_with_a_warning(flags, words, capsys, tmp_path):
    common = ["--total-steps", "300", "--num-steps", "16", "--evaluate-every", "none", "--json"]
    code = main(["train", "CartPole-v1", *flags, *common, "--run-dir", str(tmp_path / "run")])
    out, err = capsys.readouterr()
    assert code == 0
    assert words in err
    assert json.loads(out.strip().splitlines()[-1])["steps"] > 0


class Late(Faulty):
    """Fails only in the copy that was seeded with 3."""

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.mine = seed == 3
        return super().reset(seed=seed)

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        return (observation if self.mine else np.zeros(3, np.float32)), reward, terminated, truncated, info


@pytest.mark.parametrize(
    ("at", "last", "what"), [(20, True, "final observation"), (16, False, "observation")]
)
def test_the_right_environment_and_step_are_named(at, last, what):
    """Also for a true final observation, and for the observation after a rollout's last column."""
    agent = tightrope.PPO(
        lambda: Late("nan", at=at, last=last),
        vector_backend="serial",
        checkpoint_every=None,
        reseed_after=None,  # the seed of copy 3 is 3
        **{**SMALL, "num_envs": 4},
    )
    with pytest.raises(BadNumbers, match=rf"Environment 3 .* {what} = nan at step {at}, index 1"):
        agent.learn(400)


def test_an_environment_that_breaks_ends_the_command_with_2(capsys, tmp_path):
    gym.register("tightrope_tests/Four-v0", entry_point=lambda: Faulty("four"))
    try:
        code = main(
            ["train", "tightrope_tests/Four-v0", "--total-steps", "500", "--run-dir", str(tmp_path / "r")]
        )
    finally:
        del gym.registry["tightrope_tests/Four-v0"]
    assert code == 2
    assert "expected 5, got 4" in capsys.readouterr().err


def test_save_never_replaces_what_is_no_checkpoint(tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("years of work")
    agent = tightrope.PPO("CartPole-v1", **SMALL)
    with pytest.raises(ValueError, match="not replaced"):
        agent.save(tmp_path / "home")
    assert (tmp_path / "home" / "thesis.tex").read_text() == "years of work"
    agent.save(tmp_path / "pole")
    agent.save(tmp_path / "pole")
    (tmp_path / "pole" / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="not replaced"):
        agent.save(tmp_path / "pole")


class MethodMask(Faulty):
    """Forbids action 0 only by a method."""

    def __init__(self):
        super().__init__("none")

    def action_masks(self):
        return np.array([False, True])

    def step(self, action):
        assert action == 1
        return super().step(action)


@pytest.mark.parametrize("kind", [gym.vector.SyncVectorEnv, gym.vector.AsyncVectorEnv])
def test_masks_by_method_reach_through_vector_environments(kind):
    env = kind([MethodMask] * 2)
    tightrope.PPO(env, **SMALL).learn(128)
    env.close()


def test_predict_refuses_a_mask_that_forbids_everything():
    agent = tightrope.PPO("CartPole-v1", **SMALL)
    with pytest.raises(ValueError, match="allow at least one"):
        agent.predict(np.zeros(4, np.float32), action_masks=[0, 0])


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"gamma": "0.9"}, "expected float"),
        ({"hidden": 64}, "tuple"),
        ({"n_steps": 5}, "Did you mean 'num_steps'"),
    ],
)
def test_python_settings_of_the_wrong_kind_are_named(values, words):
    with pytest.raises(ValueError, match=words):
        tightrope.PPO("CartPole-v1", **values)
    assert tightrope.PPO("Pendulum-v1", log_std_init=-1, num_envs=1).settings.log_std_init == -1.0
