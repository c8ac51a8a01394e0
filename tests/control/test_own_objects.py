"""The user's object is the user's object: nothing that was set on it is lost, and nothing else is taken for
it."""

from __future__ import annotations

import random
import types
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.wrappers import RecordEpisodeStatistics

import tightrope
from tightrope.control.environments import copies
from tightrope.control.environments.make import make_environments
from tightrope.control.evaluate import evaluate_run
from tightrope.control.rollout.evaluation import evaluate_agent, evaluation_environments
from tightrope.runs import generators

F32 = np.float32
SMALL: dict[str, Any] = {"num_steps": 64, "engine": "torch", "notify": lambda text: None, "seed": 0}


class Chosen(gym.Env):
    """Pays for the action that an attribute names; spaces of the class."""

    observation_space = gym.spaces.Box(-1, 1, (1,), F32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, good: int = 0, scale: float = 1.0) -> None:
        self.good, self.scale = good, scale
        self.options = {"deep": [1, 2], "more": types.SimpleNamespace(weight=1.0)}
        self.places = np.arange(3)
        self.rule: Callable[[int], float] = float
        self.number = random.random()  # chance, not a setting
        self.rng = np.random.default_rng()

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, F32), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return np.zeros(1, F32), self.scale * float(action == self.good), True, False, {}


gym.register("own/Chosen-v0", Chosen, max_episode_steps=10)


class Sealed(Chosen, gym.utils.EzPickle):
    """A deep copy is built again from the arguments of the constructor, as LunarLander is."""

    def __init__(self, good: int = 0) -> None:
        gym.utils.EzPickle.__init__(self, good)
        Chosen.__init__(self, good)


gym.register("own/Sealed-v0", Sealed, max_episode_steps=10)


def limit_to_7(env: gym.Env) -> None:
    while not isinstance(env, gym.wrappers.TimeLimit):
        env = env.env
    env._max_episode_steps = 7


def other_rule(action: int) -> float:
    return -float(action)


CHANGES: dict[str, tuple[Callable[[Any], None], Callable[[Any], Any]]] = {
    "number": (lambda e: setattr(e.unwrapped, "good", 1), lambda e: e.unwrapped.good),
    "in a list in a dict": (
        lambda e: e.unwrapped.options["deep"].append(3),
        lambda e: e.unwrapped.options["deep"],
    ),
    "of an object": (
        lambda e: setattr(e.unwrapped.options["more"], "weight", 2.0),
        lambda e: e.unwrapped.options["more"].weight,
    ),
    "array": (lambda e: e.unwrapped.places.__setitem__(1, 9), lambda e: e.unwrapped.places.tolist()),
    "function": (lambda e: setattr(e.unwrapped, "rule", other_rule), lambda e: e.unwrapped.rule),
    "new attribute": (
        lambda e: setattr(e.unwrapped, "extra", "x"),
        lambda e: getattr(e.unwrapped, "extra", None),
    ),
    "space": (
        lambda e: setattr(e.unwrapped, "observation_space", gym.spaces.Box(-2, 2, (1,), F32)),
        lambda e: e.unwrapped.observation_space,
    ),
    "wrapper": (limit_to_7, lambda e: e.get_wrapper_attr("_max_episode_steps")),
}  # fmt: skip


@pytest.mark.parametrize("used", [False, True], ids=["new", "used"])
@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_what_was_set_on_an_instance_is_set_on_its_copies(change: Any, used: bool) -> None:
    """Wherever it lies; also where gym.make of the spec would build the copy without it."""
    set_it, read = change
    env = gym.make("own/Chosen-v0")
    set_it(env)
    if used:
        env.reset(seed=3)
        env.step(0)
    twin = copies.replicator(env)()
    assert twin.unwrapped is not env.unwrapped
    assert read(twin) == read(env)


def test_an_instance_as_gym_makes_it_is_rebuilt_from_its_spec() -> None:
    """Chance in the constructor and the state of an episode are no settings."""
    env = gym.make("own/Sealed-v0", good=1)
    env.reset(seed=5)
    env.step(1)
    twin = copies.replicator(env)()
    assert twin.unwrapped.good == 1
    assert twin.unwrapped.number != env.unwrapped.number


def test_the_users_instance_is_what_is_learned() -> None:
    env = gym.make("own/Chosen-v0")
    env.unwrapped.good = 1
    agent = tightrope.PPO(env, **SMALL).learn(4_096)
    assert agent.predict(np.zeros(1, F32))[0] == 1
    with evaluation_environments(env, agent.settings, 2) as environments:
        assert evaluate_agent(agent, environments, 4)["mean_return"] == 1.0


def test_what_no_copy_keeps_is_refused_with_the_factory_to_write() -> None:
    env = gym.make("own/Sealed-v0", good=0)
    env.unwrapped.scale = -3.0
    words = r"unwrapped.scale = 1.0, not -3.0.*copy.deepcopy[^\n]*\n[^\n]*\n.*make\('own/Sealed-v0', good=0\)"
    with pytest.raises(ValueError, match=words + r"\n    env.unwrapped.scale = -3.0\n    return env"):
        make_environments(env, 2)


class Remembers(Sealed):
    """Its last action outlives a reset, and no deep copy."""

    last = -1

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.last = int(action)
        return super().step(action)


gym.register("own/Remembers-v0", Remembers, max_episode_steps=10)


def test_what_steps_have_left_is_no_setting() -> None:
    env = gym.make("own/Remembers-v0", good=1)
    env.reset(seed=1)
    env.step(1)
    assert copies.replicator(env)().unwrapped.good == 1
    env.unwrapped.good = 0
    with pytest.raises(ValueError, match=r"\n    env.unwrapped.good = 0\n    return env$"):
        copies.replicator(env)


def test_statistics_that_were_gathered_are_copied() -> None:
    env = gym.wrappers.NormalizeObservation(gym.make("own/Chosen-v0"))
    for seed in range(5):
        env.reset(seed=seed)
    assert copies.replicator(env)().obs_rms.count == pytest.approx(env.obs_rms.count)


def test_lunar_lander_keeps_its_gravity() -> None:
    """copy.deepcopy of it gives the gravity of the constructor, without a word."""
    pytest.importorskip("Box2D")
    env = RecordEpisodeStatistics(gym.make("LunarLander-v3"))
    env.reset(seed=1)
    env.step(0)
    assert copies.replicator(env)().unwrapped.gravity == -10.0  # used, but as it was made
    env.unwrapped.gravity = -3.0
    with pytest.raises(ValueError, match=r"env.unwrapped.gravity = -3.0"):
        copies.replicator(env)


def test_a_model_of_compiled_code_counts() -> None:
    pytest.importorskip("mujoco")
    env = gym.make("InvertedPendulum-v5")
    copies.replicator(env)
    env.unwrapped.model.opt.gravity[2] = -3.0
    with pytest.raises(ValueError, match=r"another env.unwrapped.model"):
        copies.replicator(env)


class World:
    """Stands for a simulator outside Python: a deep copy of it is the same one."""

    def __init__(self) -> None:
        self.count = 0

    def __deepcopy__(self, memo: Any) -> World:
        return self


class Shared(Chosen):
    def __init__(self) -> None:
        super().__init__()
        self.world = World()

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.world.count += 1
        return np.full(1, self.world.count % 2, F32), 0.0, False, False, {}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.world.count = 0
        return super().reset(seed=seed)


def test_a_copy_that_shares_its_simulator_is_none() -> None:
    with pytest.raises(ValueError, match="they share a simulator"):
        copies.replicator(Shared())


def test_a_class_with_spaces_is_a_factory(tmp_path: Any) -> None:
    agent = tightrope.PPO(Chosen, **SMALL).learn(2_048)
    with evaluation_environments(Chosen, agent.settings, 2) as environments:
        assert environments.num_envs == 2
    agent.save(tmp_path / "agent")
    assert evaluate_run(tmp_path / "agent", env=Chosen, episodes=3)["mean_return"] == 1.0


# ---------------------------------------------------------------------------------------------- env_kwargs


@pytest.mark.parametrize("backend", ["serial", "mixed", "workers"])
@pytest.mark.parametrize("env", ["own/Chosen-v0", Chosen], ids=["id", "class"])
def test_env_kwargs_reach_every_copy_and_are_saved(env: Any, backend: str, tmp_path: Any) -> None:
    values = {**SMALL, "vector_backend": backend, "num_workers": None if backend == "serial" else 2}
    agent = tightrope.PPO(env, env_kwargs={"good": 1, "scale": 2.0}, num_envs=2, **values).learn(2_048)
    agent.save(tmp_path / "agent")
    agent.close()
    other = None if isinstance(env, str) else env
    assert evaluate_run(tmp_path / "agent", env=other, episodes=3)["mean_return"] == 2.0
    loaded = tightrope.load(tmp_path / "agent", env=other)
    assert loaded.settings.env_kwargs == {"good": 1, "scale": 2.0}
    loaded.close()
    with pytest.raises(ValueError, match=r"trained on observations"):  # another task: not with its arguments
        tightrope.load(tmp_path / "agent", env="CartPole-v1")


@pytest.mark.parametrize("env", ["own/Chosen-v0", Chosen], ids=["id", "class"])
def test_a_policy_is_evaluated_with_other_env_kwargs(env: Any, tmp_path: Any) -> None:
    agent = tightrope.PPO(env, env_kwargs={"good": 1, "scale": 2.0}, num_envs=2, **SMALL).learn(2_048)
    agent.save(tmp_path / "agent")
    agent.close()
    other = None if isinstance(env, str) else env
    found = evaluate_run(tmp_path / "agent", env=other, env_kwargs={"scale": 3.0}, episodes=3)
    assert found["mean_return"] == 3.0  # of the run's, good stays 1
    loaded = tightrope.load(tmp_path / "agent", env=other, env_kwargs={"good": 0})
    assert loaded.settings.env_kwargs == {"good": 0, "scale": 2.0}
    loaded.learn(64)  # in episodes of the other task: none is continued
    loaded.close()
    with pytest.raises(ValueError, match=r"does not take 'goo'. Did you mean good"):
        tightrope.load(tmp_path / "agent", env=other, env_kwargs={"goo": 0})
    with pytest.raises(ValueError, match="has been made"):
        tightrope.load(tmp_path / "agent", env=Chosen(), env_kwargs={"good": 0})


@pytest.mark.parametrize(
    ("env", "keywords", "words"),
    [
        ("own/Chosen-v0", {"goo": 1}, r"not take 'goo'. Did you mean good\? It takes good=0, scale=1.0, max"),
        (Chosen, {"weight": 1}, r"Chosen does not take 'weight'.*It takes good=0, scale=1.0"),
        (lambda: Chosen(), {"good": 1}, "does not take 'good'.*It takes no arguments"),
        (Chosen(), {"good": 1}, "has been made"),
        ("CartPole-v1", {"gravity": 1}, "vector version of CartPole-v1 does not take 'gravity'.*sutton_"),
        ("own/Chosen-v0", {"good": object()}, "JSON can hold"),
    ],
)  # fmt: skip
def test_wrong_env_kwargs_are_answered_with_what_there_is(env: Any, keywords: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        tightrope.PPO(env, env_kwargs=keywords, **SMALL)


def test_a_time_limit_is_an_argument_too() -> None:
    agent = tightrope.PPO("own/Chosen-v0", env_kwargs={"max_episode_steps": 3}, **SMALL)
    assert agent.environments.max_episode_steps == 3


# ---------------------------------------------------------------------------------------- observation_keys


class Mission(gym.Env):
    observation_space = gym.spaces.Dict(
        image=gym.spaces.Box(0, 1, (2,), F32), mission=gym.spaces.Text(9), direction=gym.spaces.Discrete(4)
    )
    action_space = gym.spaces.Discrete(2)

    def _see(self) -> dict[str, Any]:
        return {"image": np.zeros(2, F32), "mission": "go", "direction": 3}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self._see(), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self._see(), float(action), True, False, {}


@pytest.mark.parametrize("backend", ["serial", "workers", "given"])
def test_a_part_of_the_observations_is_enough(backend: str, tmp_path: Any) -> None:
    given = backend == "given"
    env: Any = gym.vector.SyncVectorEnv([Mission] * 2) if given else Mission
    values = {**SMALL, "vector_backend": "auto" if given else backend, "num_envs": 2}
    agent = tightrope.PPO(env, observation_keys=["image", "direction"], **values).learn(512)
    assert agent.environments.observation_layout.size == 6
    agent.predict(Mission().reset()[0])
    agent.save(tmp_path / "agent")
    agent.close()
    assert tightrope.load(tmp_path / "agent", env=Mission).settings.observation_keys == ("image", "direction")


def test_texts_are_refused_with_the_flag_that_leaves_them_out() -> None:
    with pytest.raises(ValueError, match=r"\['mission'\] is Text.*--observation-keys image direction"):
        tightrope.PPO(Mission, **SMALL)
    with pytest.raises(ValueError, match=r"'img', expected some of: image, mission, direction"):
        tightrope.PPO(Mission, observation_keys=["img"], **SMALL)
    with pytest.raises(ValueError, match=r"observation_keys.*Box"):
        tightrope.PPO(Chosen, observation_keys=["img"], **SMALL)


# --------------------------------------------------------------------------------------- global generators


class Careless(Chosen):
    """Draws from the global generators."""

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        noise = random.random() + np.random.random() + float(torch.rand(()))  # noqa: NPY002
        return np.zeros(1, F32), noise, self.np_random.random() < 0.2, False, {}


def returns(**values: Any) -> list[float]:
    agent = tightrope.PPO(Careless, **SMALL, **values)
    found = [total for update in agent.iterate(512) for total, *_ in update.episodes]
    agent.close()
    return found


@pytest.mark.parametrize("backend", ["serial", "mixed", "workers"])
def test_the_seed_decides_what_the_global_generators_draw(backend: str) -> None:
    values = {"vector_backend": backend, "num_workers": None if backend == "serial" else 2, "num_envs": 4}
    first = returns(**values)
    random.seed(1), np.random.seed(1), torch.manual_seed(1)  # noqa: NPY002 - another process
    assert returns(**values) == first


def drawn() -> list[float]:
    return [random.random(), float(np.random.random()), float(torch.rand(()))]  # noqa: NPY002


def test_evaluation_leaves_the_global_generators_as_they_were() -> None:
    agent = tightrope.PPO(Careless, **SMALL)
    generators.seed(1)
    expected = drawn()
    generators.seed(1)
    with evaluation_environments(Careless, agent.settings, 2) as environments:
        first = evaluate_agent(agent, environments, 4)["returns"]
        assert drawn() == expected
        assert evaluate_agent(agent, environments, 4)["returns"] == first


def test_where_a_process_holds_one_copy_its_episodes_are_a_function_of_their_seed() -> None:
    found = []
    for before in (0, 3):  # so many draws before the episode
        with make_environments(Careless, 1) as environments:
            generators.seed(7)
            for _ in range(before):
                drawn()
            environments.reset(11)
            found.append([environments.step(np.zeros((1, 1), F32)).rewards[0] for _ in range(3)])
    assert found[0] == found[1]


def test_the_seed_decides_a_module_that_a_function_builds() -> None:
    class Net(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.actor, self.critic = torch.nn.Linear(1, 2), torch.nn.Linear(1, 1)

        def forward(self, observations: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            return self.actor(observations), self.critic(observations)[:, 0]

    weights = []
    for seed in (1, 1, 2):
        torch.manual_seed(torch.seed() % 2**31)
        agent = tightrope.PPO(Chosen, policy=lambda *spaces: Net(), **{**SMALL, "seed": seed})
        weights.append(agent.policy.own.actor.weight.detach().clone())
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])
