"""Ids, instances and factories: the environments made from them, and the errors for mistakes."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings

import chain
import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from tightrope.control.environments import tasks
from tightrope.control.environments.make import make_environments

chain.register()


# --- instances


class Limited(gym.Wrapper):
    """A wrapper that Gymnasium cannot rebuild from a spec."""


def test_an_instance_is_copy_0_and_stays_open():
    env = chain.Chain()
    for num_envs in (1, 3):
        with make_environments(env, num_envs) as environments:
            assert chain.transitions(environments, 5) == chain.expected_transitions(num_envs, 5)
        assert not env.closed


def test_wrappers_of_an_instance_are_replicated():
    rescaled = gym.wrappers.TransformReward(gym.make("tightrope_tests/Chain-v0"), lambda reward: -reward)
    for env in (rescaled, Limited(rescaled)):
        environments = make_environments(env, 2)
        environments.reset(chain.BASE_SEED)
        rewards = environments.step(np.zeros((2, 1), np.float32)).rewards
        assert rewards.tolist() == [-chain.reward_of(row, 0, 0, 5) for row in range(2)]
        assert environments.spec_id == "tightrope_tests/Chain-v0"


class Unique(chain.Chain):
    """Neither a spec nor a deep copy."""

    def __deepcopy__(self, memo):
        raise TypeError("there is only one of me")


class Ghost(chain.Chain):
    def __deepcopy__(self, memo):
        return self


@pytest.mark.parametrize("kind", [Unique, Ghost])
def test_an_instance_that_cannot_be_replicated_is_named(kind):
    with pytest.raises(ValueError, match=rf"{kind.__name__}.*cannot be replicated.*factory.*num_envs=1"):
        make_environments(kind(), 2)
    with make_environments(kind(), 1) as environments:
        assert environments.backend == "serial"


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (lambda: 3, "the factory returned a int; expected a gymnasium.Env"),
        ((lambda env: lambda: env)(chain.Chain()), "returned the same object twice"),
        (5, "env is a int; expected a Gymnasium id"),
    ],
)
def test_a_factory_must_build_environments(env, message):
    with pytest.raises(ValueError, match=message):
        make_environments(env, 2)


def test_copies_with_other_spaces_are_refused():
    sizes = iter([3, 3, 2])

    class Sized(chain.Chain):
        def __init__(self):
            super().__init__()
            self.action_space = gym.spaces.Discrete(next(sizes))

    with pytest.raises(
        ValueError, match=r"copies of Sized differ: .*Discrete\(2\).* against .*Discrete\(3\)"
    ):
        make_environments(Sized, 3, backend="serial")


# --- ids


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("CartPol-v1", r"unknown environment id 'CartPol-v1'\. Did you mean CartPole-v1"),
        ("cartpole-v1", "Did you mean CartPole-v1"),
        ("CartPole-v9", "Did you mean CartPole-v1 or CartPole-v0"),
        ("LunarLander-v2", "Did you mean LunarLander-v3"),
        ("Hopper-v9", "Did you mean Hopper-v5"),
        ("ALE/Pog-v5", "Did you mean ALE/Pong-v5"),
        ("Nowhere/Thing-v1", "unknown environment id"),
        ("not an id!", "Malformed"),
        ("no_such_module:Thing-v0", "no module named 'no_such_module'"),
    ],
)
def test_unknown_ids(env_id, message):
    for backend in ("auto", "vector"):
        with pytest.raises(ValueError, match=message), warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # Gymnasium's own, that v2 is out of date
            make_environments(env_id, 2, backend=backend)


@pytest.mark.parametrize(
    ("env_id", "module", "extra"),
    [
        ("LunarLander-v3", "Box2D", "box2d"),
        ("Hopper-v5", "mujoco", "mujoco"),
        ("ALE/Pong-v5", "ale_py", "atari"),
    ],
)
def test_a_missing_package_names_the_extra(env_id, module, extra):
    code = f"""
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == {module!r}:
            raise ModuleNotFoundError("No module named " + name, name=name)
import importlib.util
real = importlib.util.find_spec
importlib.util.find_spec = lambda name, *a: None if name == {module!r} else real(name, *a)
sys.meta_path.insert(0, Blocked())
from tightrope.control.environments.make import make_environments
try:
    make_environments({env_id!r}, 2, backend="serial")
except ValueError as error:
    print(error)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert f"needs {module.replace('_', '-') if extra == 'atari' else module}" in run.stdout
    assert f"pip install 'tightrope[{extra}]'" in run.stdout


# --- the standard tasks


def test_envpool_steps_and_is_a_function_of_its_seed():
    pytest.importorskip("envpool")
    for env_id, limit in (("CartPole-v1", 500), ("Pendulum-v1", 200)):
        traces = []
        for seed in (3, 3, 4):
            with make_environments(env_id, 3, backend="envpool") as environments:
                assert environments.max_episode_steps == limit
                inputs, _ = environments.reset(seed)
                ended = np.zeros(3, bool)
                trace = [inputs["flat"]]
                for t in range(210):
                    step = environments.step(np.full((3, 1), t % 2, np.float32))
                    np.testing.assert_array_equal(
                        np.zeros_like(ended) if step.phantom is None else step.phantom, ended
                    )
                    ended = step.terminated | step.truncated
                    trace.append(step.inputs["flat"])
                traces.append(np.stack(trace))
        np.testing.assert_array_equal(traces[0], traces[1])
        assert not np.array_equal(traces[0], traces[2])
    with pytest.raises(ValueError, match="EnvPool has no task"):
        make_environments("tightrope_tests/Chain-v0", 2, backend="envpool")


def test_atari_uses_its_vector_version_with_same_step():
    ale_py = pytest.importorskip("ale_py")
    gym.register_envs(ale_py)
    with make_environments("ALE/Pong-v5", 2) as environments:
        assert environments.backend == "vector"
        assert [leaf.space.shape for leaf in environments.observation_layout.images] == [(4, 84, 84)]
        inputs, mask = environments.reset(0)
        assert inputs["image0"].shape == (2, 4, 84, 84) and mask is None
        for _ in range(
            1200
        ):  # the player never moves: the first point after about 60 steps, the game after about 1000
            step = environments.step(np.zeros((2, 1), np.float32))
            assert step.phantom is None
            if step.terminated.any():
                break
        else:
            pytest.fail("no episode ended")


def test_atari_truncations_bring_their_final_observation():
    pytest.importorskip("ale_py")
    tasks.register_atari("ALE/Pong-v5")
    vector = gym.make_vec(
        "ALE/Pong-v5",
        2,
        vectorization_mode="vector_entry_point",
        autoreset_mode=AutoresetMode.SAME_STEP,
        max_num_frames_per_episode=100,
    )
    environments = make_environments(vector)
    inputs, _ = environments.reset(0)
    for _ in range(60):
        before, step = inputs["image0"], environments.step(np.zeros((2, 1), np.float32))
        inputs = step.inputs
        if step.truncated.any():
            row = step.final_rows[0]
            final = step.final_inputs["image0"][0]
            np.testing.assert_array_equal(final[:-1], before[row][1:])  # the stack moved on by one frame
            assert not np.array_equal(final, inputs["image0"][row])
            return
    pytest.fail("no truncation within the frame limit")


@pytest.mark.parametrize(
    "env_id", ["LunarLander-v3", "HalfCheetah-v5", "CartPole-v1", "MountainCarContinuous-v0"]
)
def test_standard_tasks_print_nothing_on_stderr(env_id, tmp_path):
    if env_id != "CartPole-v1":
        pytest.importorskip({"L": "Box2D", "H": "mujoco"}.get(env_id[0], "gymnasium"))
    code = f"""
import numpy as np
from tightrope.control.environments.make import make_environments
with make_environments({env_id!r}, 8) as e:
    e.reset(0)
    for _ in range(30):
        e.step(np.zeros((8, e.action_layout.num_columns), np.float32))
"""
    path = os.pathsep.join(os.path.abspath(p) for p in sys.path if p)
    environment = {**os.environ, "PYTHONPATH": path, "PYTHONWARNINGS": "default"}
    run = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
        env=environment,
    )
    assert run.stderr == "" and run.stdout == ""
    assert not list(tmp_path.iterdir())  # MuJoCo's log file


def test_the_users_own_warnings_pass():
    def factory():
        warnings.warn("my own", stacklevel=1)
        return chain.Chain()

    with pytest.warns(UserWarning, match="my own"):
        make_environments(factory, 1)
