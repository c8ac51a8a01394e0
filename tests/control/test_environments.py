"""Every way to name and vectorise a task: which backend, which transitions, which error."""

from __future__ import annotations

import builtins

import chain
import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from tightrope.control.environments.faults import EnvironmentFault
from tightrope.control.environments.make import Backend, choose_backend, make_environments
from tightrope.control.environments.vector import autoreset_mode
from tightrope.control.spaces.structure import Reading

chain.register()
COUNT = 40
MODES = list(AutoresetMode)


# --- the same transitions everywhere


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("copy", [True, False])
def test_sync_vector_env_in_every_mode(mode, copy):
    vector = SyncVectorEnv([chain.Chain] * 4, autoreset_mode=mode, copy=copy)
    with make_environments(vector) as environments:
        assert (environments.backend, environments.num_envs) == ("given", 4)
        assert chain.transitions(environments, COUNT) == chain.expected_transitions(4, COUNT)
    assert not vector.closed  # the caller's own


@pytest.mark.parametrize("mode", MODES)
def test_async_vector_env_in_every_mode(mode):
    vector = AsyncVectorEnv([chain.Chain] * 2, autoreset_mode=mode)
    with make_environments(vector) as environments:
        assert chain.transitions(environments, COUNT) == chain.expected_transitions(2, COUNT)
    vector.close()


@pytest.mark.parametrize("mode", [*MODES, "NextStep", "SAME_STEP", "disabled"])
def test_a_custom_vector_environment_in_every_mode(mode):
    vector = chain.ChainVector(5, mode)
    vector.mode = autoreset_mode(vector)
    assert chain.transitions(make_environments(vector, 5), COUNT) == chain.expected_transitions(5, COUNT)


@pytest.mark.parametrize(
    ("env_id", "backend", "phantoms"),
    [
        ("tightrope_tests/Chain-v0", "auto", False),
        ("tightrope_tests/Chain-v0", "serial", False),
        ("tightrope_tests/Chain-v0", "workers", False),
        ("tightrope_tests/VectorChain-v0", "vector", False),  # SAME_STEP is requested if it is offered
        ("tightrope_tests/NextStepChain-v0", "vector", True),
    ],
)
def test_an_id_through_every_backend(env_id, backend, phantoms):
    with make_environments(env_id, 3, backend=backend) as environments:
        assert chain.transitions(environments, COUNT) == chain.expected_transitions(3, COUNT)
        environments.reset(chain.BASE_SEED)
        steps = [environments.step(np.zeros((3, 1), np.float32)) for _ in range(6)]
        assert any(step.phantom is not None for step in steps) == phantoms


def test_instances_and_factories_deliver_the_same():
    for env in (chain.Chain(), gym.make("tightrope_tests/Chain-v0"), chain.Chain):
        for backend in ("serial", "workers"):
            with make_environments(env, 3, backend=backend, num_workers=2) as environments:
                assert chain.transitions(environments, COUNT) == chain.expected_transitions(3, COUNT)


def test_nested_observations_survive_same_step():
    for mode in MODES:
        vector = SyncVectorEnv([lambda: chain.Chain("observation")] * 3, autoreset_mode=mode)
        environments = make_environments(vector)
        assert chain.transitions(environments, COUNT) == chain.expected_transitions(3, COUNT)


@pytest.mark.parametrize("mask", ["info", "observation"])
@pytest.mark.parametrize("mode", MODES)
def test_masks_of_vector_environments_belong_to_their_observations(mask, mode):
    vector = SyncVectorEnv([lambda: chain.Chain(mask)] * 3, autoreset_mode=mode)
    environments = make_environments(vector)
    inputs, masks = environments.reset(chain.BASE_SEED)
    ended = np.zeros(3, bool)
    for _ in range(30):
        allowed = np.arange(3) != (inputs["flat"][:, 1:].sum(axis=1) % 3)[:, None]
        # before a phantom step everything is allowed
        np.testing.assert_array_equal(masks, allowed | ended[:, None])
        step = environments.step(chain.action_for(inputs["flat"]))
        ended = (step.terminated | step.truncated) & (mode == AutoresetMode.NEXT_STEP)
        inputs, masks = step.inputs, step.action_mask


def test_terminated_wins_over_truncated():
    for env in (chain.Chain, chain.ChainVector(1)):
        environments = make_environments(env, 1)
        environments.reset(chain.BASE_SEED + 5)  # the script's episode that ends both ways
        steps = [environments.step(np.zeros((1, 1), np.float32)) for _ in range(3)]
        assert steps[-1].terminated[0] and not steps[-1].truncated[0] and steps[-1].final_rows is None


def test_a_time_limit_wrapper_gives_the_true_final_observation():
    with make_environments("tightrope_tests/LimitedChain-v0", 1) as environments:
        assert environments.max_episode_steps == 2
        environments.reset(chain.BASE_SEED)  # the first episode would last three steps
        environments.step(np.zeros((1, 1), np.float32))
        step = environments.step(np.zeros((1, 1), np.float32))
        assert step.truncated[0] and step.final_rows.tolist() == [0]
        assert step.final_inputs["flat"].tolist() == [[0, 0, 2]] and step.inputs["flat"].tolist() == [
            [0, 1, 0]
        ]


# --- vector environments that misbehave


def test_a_missing_mode_means_next_step_with_a_warning():
    vector = chain.ChainVector(2)
    vector.metadata = {}
    with pytest.warns(UserWarning, match="taken as NEXT_STEP"):
        environments = make_environments(vector)
    assert chain.transitions(environments, COUNT) == chain.expected_transitions(2, COUNT)
    vector.metadata = {"autoreseet-mode": AutoresetMode.SAME_STEP}
    assert autoreset_mode(vector) == AutoresetMode.SAME_STEP
    vector.metadata = {"autoreset_mode": "sometimes"}
    with pytest.raises(ValueError, match="'sometimes'; expected one of"):
        autoreset_mode(vector)


def test_a_reset_mask_that_is_ignored_is_noticed():
    for vector in (
        chain.ChainVector(3, AutoresetMode.DISABLED, faulty_mask=True),
        gym.make_vec("CartPole-v1", 4, vectorization_mode="vector_entry_point"),
    ):
        vector.metadata = {**vector.metadata, "autoreset_mode": AutoresetMode.DISABLED}
        environments = make_environments(vector)
        environments.reset(chain.BASE_SEED)
        actions = np.zeros((vector.num_envs, 1), np.float32)
        actions[::2] = 1
        with pytest.raises(EnvironmentFault, match=r"also changed environments .*Use autoreset"):
            for t in range(200):
                actions[0] = t % 2  # balances longer than the others
                environments.step(actions)


def test_same_step_without_the_final_observation_is_refused():
    class Forgetful(chain.ChainVector):
        def step(self, actions):
            return (*super().step(actions)[:4], {})

    environments = make_environments(Forgetful(2, AutoresetMode.SAME_STEP))
    with pytest.raises(EnvironmentFault, match=r"'final_obs'.* is missing"):
        chain.transitions(environments, COUNT)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda o, r, te, tr, i: (o, r, te, i), "a tuple of 4 values, expected five"),
        (lambda o, r, te, tr, i: (o[:1], r, te, tr, i), "expected 2 rows"),
        (lambda o, r, te, tr, i: (o[:, :2], r, te, tr, i), r"shape \(2, 2\), expected \(N, 3\)"),
        (lambda o, r, te, tr, i: (o, r[:, None], te, tr, i), r"have shapes \(2, 1\)"),
        (lambda o, r, te, tr, i: (o, ["a", "b"], te, tr, i), "expected numbers and two arrays of True and"),
    ],
)
def test_a_vector_environment_that_breaks_the_api_is_named(change, message):
    class Odd(chain.ChainVector):
        def step(self, actions):
            return change(*super().step(actions))

    environments = make_environments(Odd(2))
    environments.reset(chain.BASE_SEED)
    with pytest.raises(EnvironmentFault, match=f"Odd at step 1 does not follow Gymnasium's API: .*{message}"):
        environments.step(np.zeros((2, 1), np.float32))


def test_num_envs_and_backend_must_fit_a_given_vector_environment():
    with pytest.raises(ValueError, match="num_envs is 8, but the vector environment given has 2"):
        make_environments(chain.ChainVector(2), 8)
    with pytest.raises(ValueError, match="a vector environment was given"):
        make_environments(chain.ChainVector(2), backend="workers")


# --- which backend


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("CartPole-v1", 8, None, 2), Backend("vector", 1)),
        (("CartPole-v1", 8, None, 64), Backend("vector", 1)),
        (("CartPole-v1", 4, None, 2), Backend("serial", 1)),
        (("CartPole-v1", 8, 2, 2), Backend("workers", 2)),
        (("LunarLander-v3", 8, None, 2), Backend("mixed", 2)),
        (("LunarLander-v3", 8, None, 1), Backend("serial", 1)),
        (("LunarLander-v3", 1, None, 8), Backend("serial", 1)),
        (("LunarLander-v3", 8, 1, 8), Backend("serial", 1)),
        (("HalfCheetah-v5", 3, None, 8), Backend("mixed", 3)),
        (("HalfCheetah-v5", 8, 4, 2), Backend("workers", 4)),
        (("Pendulum-v1", 8, None, 2), Backend("serial", 1)),
        (("phys2d/CartPole-v1", 8, None, 2), Backend("serial", 1)),
        (("tightrope_tests/VectorChain-v0", 8, None, 2), Backend("serial", 1)),
        (("ALE/Pong-v5", 8, None, 2), Backend("vector", 1)),
        (("Unknown-v0", 8, None, 2), Backend("serial", 1)),
        ((None, 8, None, 2), Backend("serial", 1)),
        ((None, 8, 3, 2), Backend("workers", 3)),
    ],
)
def test_auto_is_a_function_of_its_arguments(arguments, expected):
    assert choose_backend(*arguments) == expected


def test_cartpole_uses_its_own_vector_version_without_phantoms_in_what_counts():
    with make_environments("CartPole-v1", 8) as environments:
        assert (environments.backend, environments.spec_id) == ("vector", "CartPole-v1")
        assert environments.max_episode_steps == 500
        environments.reset(0)
        ended = np.zeros(8, bool)
        for _ in range(60):
            step = environments.step(np.ones((8, 1), np.float32))
            np.testing.assert_array_equal(
                np.zeros_like(ended) if step.phantom is None else step.phantom, ended
            )
            assert (step.rewards[~ended] == 1).all() and (step.rewards[ended] == 0).all()
            assert (np.abs(step.inputs["flat"][ended]) <= 0.05).all()  # fresh after the phantom step
            ended = step.terminated | step.truncated


def test_a_forced_backend_that_the_task_lacks():
    with pytest.raises(ValueError, match="Pendulum-v1 has no vector version of its own"):
        make_environments("Pendulum-v1", 2, backend="vector")
    with pytest.raises(ValueError, match="needs a Gymnasium id"):
        make_environments(chain.Chain, 2, backend="vector")
    with pytest.raises(ValueError, match="expected one of: auto, serial"):
        make_environments("CartPole-v1", 2, backend="sync")
    with pytest.raises(ValueError, match="num_envs is 0"):
        make_environments("CartPole-v1", 0)


def test_the_error_for_missing_envpool_names_the_package(monkeypatch):
    real = builtins.__import__

    def without(name, *rest, **keywords):
        if name == "envpool":
            raise ImportError("No module named 'envpool'")
        return real(name, *rest, **keywords)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ValueError, match=r"pip install 'tightrope\[envpool\]'"):
        make_environments("CartPole-v1", 2, backend="envpool")


def test_squash_needs_bounds():
    with pytest.raises(ValueError, match="finite bounds"):
        make_environments(Unbounded, 2, reading=Reading(action_bounds="squash"))
    environments = make_environments("Pendulum-v1", 1, reading=Reading(action_bounds="squash"))
    environments.reset(0)
    environments.step(np.full((1, 1), 50.0, np.float32))
    assert environments._group.envs[0].unwrapped.last_u == pytest.approx(2.0)


class Unbounded(chain.Chain):
    action_space = gym.spaces.Box(-np.inf, np.inf, (1,))
