"""Whether a task repeats its episodes is found at the start, written into settings.json, and told if it does
not; what a task keeps from one episode to the next is carried to the copy that repeats a later one.
"""

from __future__ import annotations

import collections
import contextlib
import copy
import enum
import json
import random
from collections import Counter, defaultdict, deque
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import tightrope
from tightrope.control import train
from tightrope.control.agent import Agent
from tightrope.control.environments import state as states
from tightrope.control.environments.faults import EnvironmentFault
from tightrope.control.resolve import resolve
from tightrope.runs.run import Run
from tightrope.training.events import Listeners

wrap = gym.wrappers


class Outside(gym.Wrapper):
    """Draws from numpy's global generator."""

    def step(self, action: Any) -> Any:
        observation, reward, *rest = self.env.step(action)
        return observation, reward + np.random.normal(), *rest  # noqa: NPY002


class Counts(gym.Wrapper):
    """Its rewards depend on how many episodes there were, which no reset changes."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.episodes, self.own = 0, np.random.default_rng(5)

    def reset(self, **keywords: Any) -> Any:
        self.episodes += 1
        return self.env.reset(**keywords)

    def step(self, action: Any) -> Any:
        observation, reward, *rest = self.env.step(action)
        return observation, reward + self.episodes + self.own.normal(), *rest


class Hidden(Counts):
    """The same behind an object that cannot be looked into."""

    class Box:
        __slots__ = ("n",)

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.box = Hidden.Box()
        self.box.n = 0

    def reset(self, **keywords: Any) -> Any:
        self.box.n += 1
        return self.env.reset(**keywords)

    def step(self, action: Any) -> Any:
        observation, reward, *rest = self.env.step(action)
        return observation, reward + self.box.n, *rest


class Late(Counts):
    """Makes its counter in its first step."""

    def __init__(self, env: gym.Env) -> None:
        gym.Wrapper.__init__(self, env)

    def reset(self, **keywords: Any) -> Any:
        return self.env.reset(**keywords)

    def step(self, action: Any) -> Any:
        self.won = getattr(self, "won", 0) + 1
        observation, _, *rest = self.env.step(action)
        return observation, float(self.won), *rest


TASKS = {
    "made in a step": (lambda: Late(gym.make("CartPole-v1")), "0.won?", "yes"),
    "plain": (lambda: gym.make("CartPole-v1"), "", "yes"),
    "normalised": (
        lambda: wrap.NormalizeReward(wrap.NormalizeObservation(gym.make("CartPole-v1"))),
        "0.return_rms 0.discounted_reward 1.obs_rms",
        "yes",
    ),
    "stacked": (
        lambda: wrap.FlattenObservation(wrap.FrameStackObservation(gym.make("CartPole-v1"), 3)),
        "",
        "yes",
    ),
    "counts": (lambda: Counts(gym.make("CartPole-v1")), "0.episodes 0.own", "yes"),
    "outside": (lambda: Outside(gym.make("CartPole-v1")), "", "no"),
    "hidden": (lambda: Hidden(gym.make("CartPole-v1")), "", "no"),
}
VALUES = {
    "total_steps": 1600, "num_envs": 4, "num_steps": 50, "minibatch_size": 100, "num_epochs": 1, "seed": 3,
    "evaluate_every": 0.5, "evaluation_episodes": 2, "checkpoint_every": 0.25, "threads": 1,
    "engine": "torch",
}  # fmt: skip


class Killed(BaseException):
    """Ends a run at once."""


@pytest.mark.parametrize(
    ("name", "backend"),
    [*((name, "serial") for name in TASKS), ("normalised", "workers"), ("hidden", "workers")],
)
def test_the_answer_is_written_down_and_a_resume_is_exact(tmp_path, monkeypatch, name, backend):
    make, carried, repeats = TASKS[name]
    workers = {"vector_backend": backend, "num_workers": 2 if backend == "workers" else None}
    settings = resolve(make, "ppo", {**VALUES, **workers})
    said: list[str] = []
    train.train(settings, run_dir=tmp_path / "whole", env=make, listeners=[lambda e: said.append(str(e))])
    written = json.loads((tmp_path / "whole" / "settings.json").read_text())
    assert (written["carried"], written["repeats"]) == (carried, repeats)
    told = [line for line in said if "do not repeat from seed" in line]
    assert len(told) == (repeats == "no") and all("self.np_random" in line for line in told)
    if repeats == "no":
        return

    real, count = Agent._one_update, 0

    def dying(*arguments: Any, **keywords: Any) -> Any:
        nonlocal count
        count += 1
        if count == 6:
            raise Killed
        return real(*arguments, **keywords)

    with monkeypatch.context() as patch:
        patch.setattr(Agent, "_one_update", dying)
        with pytest.raises(Killed):
            train.train(settings, run_dir=tmp_path / "hops", env=make)
    said.clear()
    train.resume(tmp_path / "hops", env=make, listeners=[lambda e: said.append(str(e))])
    assert not [line for line in said if "did not repeat" in line]
    first, second = (Run.open(tmp_path / run).newest() for run in ("whole", "hops"))
    for group, tensors in first.tensors.items():
        assert all(torch.equal(x, second.tensors[group][key]) for key, x in tensors.items()), group


def test_bipedal_walkers_repeat_in_used_copies(tmp_path):
    pytest.importorskip("Box2D")
    values = {**VALUES, "total_steps": 4800, "num_envs": 2, "checkpoint_every": None, "evaluate_every": None}
    train.train(resolve("BipedalWalker-v3", "ppo", values), run_dir=tmp_path / "run")
    assert json.loads((tmp_path / "run" / "settings.json").read_text())["repeats"] == "yes"


def test_tests_leave_the_generators_of_the_run_alone(tmp_path):
    """A run that is tested has the weights of an agent that is not."""
    import tightrope

    values = {**VALUES, "vector_backend": "serial", "evaluate_every": None}
    np.random.seed(1)  # noqa: NPY002
    agent = tightrope.PPO("CartPole-v1", **values).learn(1600)
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    train.train(resolve("CartPole-v1", "ppo", values), run_dir=tmp_path / "run")
    assert (np.random.get_state()[1] == before).all()  # noqa: NPY002
    weights = Run.open(tmp_path / "run").newest().tensors["policy"]
    assert all(torch.equal(x, weights[name]) for name, x in agent.policy.state_dict().items())
    agent.close()


def test_what_is_carried_goes_into_other_objects_of_the_same_kind():
    a, b = (Counts(wrap.NormalizeObservation(gym.make("CartPole-v1"))) for _ in range(2))
    for seed in range(3):
        a.reset(seed=seed)
        a.step(0)
    a.reset(seed=0)
    b.reset(seed=0)
    names = states.differing(a, b)
    assert names == ["0.episodes", "0.own", "1.obs_rms"]
    own, moments = b.own, b.env.obs_rms
    states.give(b, json.loads(json.dumps(states.take(a, names))), 0)
    assert not states.differing(a, b) and b.own is own and b.env.obs_rms is moments


class Kept(gym.Env):
    """Keeps one attribute from episode to episode, which every reset changes; two steps an episode."""

    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, kept: Any, change: Any) -> None:
        self.kept, self.change = kept, change

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        self.change(self)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        return np.zeros(1, np.float32), float(action), self.t == 2, False, {}


class Level(enum.IntEnum):
    LOW = 1
    HIGH = 2


KINDS = {
    "tuples in a list": [(0, 1), (1, 0)], "lists in tuples": ([1], (2,)), "a deque": deque([1.5, (2,)], 3),
    "numbers as keys": {1: "a", (2, 3): [None]}, "a dict of tuples": {"x": (1, 2)},
    "generators in a list": [np.random.default_rng(1), np.random.Generator(np.random.MT19937(2))],
    "kinds of numbers": [np.float32(1.5), np.int8(3), 2, True, float("nan"), b"\x00", "word"],
    "arrays": [np.arange(3), np.array(2.5), np.zeros((2, 0), np.float32)], "random's": [random.Random(4)],
}  # fmt: skip


def shown(value: Any) -> Any:
    """A value with every kind in it, to compare."""
    if isinstance(value, np.random.Generator):
        return str(value.bit_generator.state)
    if isinstance(value, random.Random):
        return value.getstate()
    if isinstance(value, np.ndarray):
        return ("array", value.dtype, value.shape, value.tolist())
    if isinstance(value, dict):
        return [(shown(key), shown(item)) for key, item in value.items()]
    if isinstance(value, list | tuple | deque):
        return (type(value), getattr(value, "maxlen", None), [shown(item) for item in value])
    return type(value), repr(value)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_carried_keeps_its_kind_at_every_depth(kind):
    a, b = Kept(copy.deepcopy(KINDS[kind]), None), Kept(None, None)
    states.give(b, json.loads(json.dumps(states.take(a, ["0.kept"]))), 0)
    assert shown(b.kept) == shown(a.kept)


@pytest.mark.parametrize(
    "kept",
    [
        [Level.LOW], Counter("aab"), defaultdict(int), {1, 2}, [object()], np.ma.array([1.0]),
        collections.namedtuple("Point", "x")(1), [0.0] * 1000, np.zeros(10_000),
    ],
    ids=["enum", "Counter", "defaultdict", "set", "object", "masked", "namedtuple", "long", "large"],
)  # fmt: skip
def test_what_a_file_cannot_hold_as_it_is_or_is_too_much_is_not_carried(kept):
    used = Kept(kept, None)
    assert states.differing(used, Kept(None, None)) == []
    with pytest.raises(TypeError, match=r"0\.kept holds (a|more)"):
        states.take(used, ["0.kept"])


def test_an_attribute_that_one_copy_lacks_is_carried_both_ways():
    used, fresh = Kept(0, None), Kept(0, None)
    used.won, fresh.first = np.arange(2), True
    names = states.differing(used, fresh)
    assert names == ["0.won?", "0.first?"] and not states.not_there(fresh, names)
    begin, later = (json.loads(json.dumps(states.take(env, names))) for env in (fresh, used))
    fresh.reset = None  # what lacks nothing is not reset
    states.give(fresh, begin, 0)
    del fresh.reset
    fresh.change = lambda env: None
    states.give(fresh, later, 0)
    assert fresh.won.tolist() == [0, 1] and not hasattr(fresh, "first")
    states.give(fresh, begin, 0)
    assert fresh.first and not hasattr(fresh, "won")


def test_a_run_whose_look_failed_is_told_so_at_the_resume(tmp_path, monkeypatch):
    def fails(environments: Any) -> Any:
        raise ValueError("it fails")

    monkeypatch.setattr("tightrope.control.repetition.carried_attributes", fails)
    make = lambda: Kept(0, lambda env: None)  # noqa: E731
    settings = resolve(make, "ppo", {**VALUES, "vector_backend": "serial", "total_steps": 400})
    train.train(settings, run_dir=tmp_path / "run", env=make)
    said: list[str] = []
    train.resume(tmp_path / "run", env=make, total_steps=800, listeners=[lambda e: said.append(str(e))])
    assert len([line for line in said if "could not look what its task keeps" in line]) == 1
    written = json.loads((tmp_path / "run" / "settings.json").read_text())
    assert (written["carried"], written["repeats"]) == (None, "untested")


@pytest.mark.parametrize("grown", [[0.0] * 1000, {1, 2}], ids=["long", "set"])
def test_what_has_outgrown_a_file_is_put_back_all_the_same(grown):
    """A rollback begins in used copies."""
    used = Kept(grown, None)
    states.give(used, states.take(Kept([(1,)], None), ["0.kept"]), 0)
    assert used.kept == [(1,)]


def test_a_run_that_is_not_resumed_writes_nothing_into_its_task(tmp_path):
    objects: list[Any] = []

    def make() -> Kept:
        order = [(0, 1), (1, 0)]
        objects.append(order)
        return Kept(order, lambda env: env.kept.reverse())

    settings = resolve(make, "ppo", {**VALUES, "vector_backend": "serial", "total_steps": 800})
    agent = tightrope.PPO(make, settings=settings)
    mine = [env.kept for env in agent.environments._group.envs]
    run = Run.create(tmp_path / "run", agent.settings.to_json(), "run")
    with contextlib.closing(agent), run:
        learner = train.AgentLearner(agent, run, Listeners([]))
        train.loop.train(learner, run, Listeners([]))
        now = [env.kept for env in agent.environments._group.envs]
        learner.close()
    assert all(a is b for a, b in zip(mine, now, strict=True))
    written = json.loads((tmp_path / "run" / "settings.json").read_text())
    assert (written["carried"], written["repeats"]) == ("0.kept", "yes")


def test_what_outgrows_a_file_is_told_and_no_longer_carried(tmp_path):
    make = lambda: Kept([], lambda env: env.kept.append(float(len(env.kept))))  # noqa: E731
    settings = resolve(make, "ppo", {**VALUES, "vector_backend": "serial", "total_steps": 4000})
    said: list[str] = []
    train.train(settings, run_dir=tmp_path / "run", env=make, listeners=[lambda e: said.append(str(e))])
    told = [line for line in said if "do not repeat from seed" in line]
    assert len(told) == 1 and "0.kept holds more than a task may keep" in told[0]
    assert json.loads((tmp_path / "run" / "settings.json").read_text())["repeats"] == "no"
    said.clear()
    train.resume(tmp_path / "run", env=make, total_steps=4400, listeners=[lambda e: said.append(str(e))])


def test_a_carried_name_that_the_layer_does_not_have():
    make = lambda: Kept(0, lambda env: None)  # noqa: E731
    agent = tightrope.PPO(
        make, carried="0.level", num_envs=2, num_steps=16, minibatch_size=16, engine="torch"
    )
    with (
        contextlib.closing(agent),
        pytest.raises(EnvironmentFault, match="carried names 0.level, and that lay"),
    ):
        agent.learn(64)
