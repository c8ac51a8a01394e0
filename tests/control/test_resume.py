"""A run that is killed at any moment and resumed ends bit for bit like an uninterrupted run."""

from __future__ import annotations

import json
import pkgutil
import random
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import tightrope
from tightrope.control import train
from tightrope.control.agent import Agent
from tightrope.control.environments import state as states
from tightrope.control.environments.episode import EVALUATION, TRAINING, episode_seed
from tightrope.control.environments.faults import EnvironmentFault
from tightrope.control.environments.make import make_environments
from tightrope.control.environments.tasks import make_vector_by_id, resets_rows_with_seeds
from tightrope.control.resolve import resolve
from tightrope.control.rollout.evaluation import evaluate_agent
from tightrope.runs import checkpoint
from tightrope.runs.run import Run
from tightrope.training.learner import crosses

SMALL = {
    "total_steps": 600, "num_envs": 4, "num_steps": 25, "seed": 3, "minibatch_size": 50, "num_epochs": 2,
    "hidden": (8,), "normalise_observations": True, "normalise_rewards": True, "checkpoint_every": 0.3,
    "evaluate_every": 0.34, "evaluation_episodes": 2, "threads": 1,
}  # fmt: skip


class Killed(BaseException):
    """Ends a run at once; no code of the library may catch it and recover."""


class Walk(gym.Env):
    """A noisy walk that keeps its memory at a reset: only its saved state can restore a run."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self) -> None:
        self.place, self.resets, self.trail = 0.0, 0, np.zeros(3)

    def _seen(self) -> np.ndarray:
        return np.array([self.place, self.resets], np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.place, self.resets = 0.0, self.resets + 1
        return self._seen(), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.place += (2 * int(action) - 1) * 0.3 + float(self.np_random.normal()) * 0.1
        self.trail = np.roll(self.trail, 1)
        self.trail[0] = self.place
        return self._seen(), -abs(float(self.trail.mean())), abs(self.place) > 2, False, {}

    def get_state(self) -> dict:
        return {"place": self.place, "resets": self.resets, "trail": self.trail}

    def set_state(self, state: dict) -> None:
        self.place, self.resets, self.trail = state["place"], state["resets"], state["trail"]


def walk() -> gym.Env:
    return gym.wrappers.TimeLimit(Walk(), 40)


def rows_of(run: Path, name: str) -> list[dict]:
    text = (run / name).read_text() if (run / name).exists() else ""
    rows = [json.loads(line) for line in text.splitlines()]
    return [{k: v for k, v in row.items() if k != "seconds" and not k.startswith("time/")} for row in rows]


def assert_same_end(a: Path, b: Path) -> None:
    """Weights, optimiser, normalisers, generators, counters, rows and episodes; the best policy too."""
    (folder, tensors, state), (another, others, other) = (Run.open(run).newest() for run in (a, b))
    assert folder.name == another.name and tensors.keys() == others.keys()
    for group, inside in tensors.items():
        assert all(torch.equal(x, others[group][name]) for name, x in inside.items()), group
    timed = {"wall_seconds": 0, "records": None}  # metrics.jsonl holds seconds, which change its bytes
    assert {**state, **timed} == {**other, **timed}
    for name in ("metrics.jsonl", "episodes.jsonl"):
        assert rows_of(a, name) == rows_of(b, name)
    if (a / "best").exists():
        best, other = (checkpoint.load(x / "best")[0]["policy"] for x in (a, b))
        assert all(torch.equal(best[name], other[name]) for name in best)


def settings_for(env: Any, **values: Any) -> Any:
    values = {**SMALL, **values}
    algorithm = values.pop("algorithm", "ppo")
    if algorithm != "ppo":
        del values["num_epochs"], values["minibatch_size"]
    return resolve(env, algorithm, values)


def killed(settings: Any, run: Path, patch: Any, place: Any, name: str, call: int, **more: Any) -> None:
    """Train, and die at the start of the ``call``-th call of ``place.name``."""
    real, count = getattr(place, name), 0

    def dying(*arguments: Any, **keywords: Any) -> Any:
        nonlocal count
        count += 1
        if count == call:
            raise Killed
        return real(*arguments, **keywords)

    with patch.context() as inner:
        inner.setattr(place, name, dying)
        with pytest.raises(Killed):
            if (run / "settings.json").exists():
                train.resume(run, **more)
            else:
                train.train(settings, run_dir=run, **more)


KINDS = {
    "fused": ("CartPole-v1", {"engine": "fused"}),
    "torch, a vector environment": ("CartPole-v1", {"engine": "torch", "vector_backend": "vector"}),
    "continuous": ("Pendulum-v1", {"engine": "torch", "std": "gsde", "gsde_steps": 7}),
    "workers, KL penalty": (
        "Pendulum-v1",
        {"vector_backend": "workers", "num_workers": 2, "engine": "torch", "kl_beta": 0.1, "kl_adapt": 0.01},
    ),
    "a2c": ("CartPole-v1", {"algorithm": "a2c", "num_steps": 25}),
    "reinforce": ("CartPole-v1", {"algorithm": "reinforce", "baseline": False}),
}


@pytest.mark.parametrize("kind", KINDS)
def test_five_hops_end_where_none_does(tmp_path, monkeypatch, kind):
    """Killed five times in a random update, including before the first checkpoint and on the grid."""
    env, values = KINDS[kind]
    settings = settings_for(env, **values)
    train.train(settings, run_dir=tmp_path / "whole")
    draw = random.Random(kind)
    for hop in range(5):
        killed(settings, tmp_path / "hops", monkeypatch, Agent, "_one_update", draw.choice([1, 1, 2, 2, 3]))
        assert not list((tmp_path / "hops").rglob(".*")), hop
    train.resume(tmp_path / "hops")
    assert_same_end(tmp_path / "whole", tmp_path / "hops")


PHASES = {
    "evaluation": (train, "evaluate_agent", 2),
    "rollout": ("tightrope.control.environments.pool.EnvironmentPool", "receive", 55),
    "advantages": ("tightrope.control.agent", "to_batch", 4),
    "minibatch": ("tightrope.algorithms.descent", "check_first_ratios", 4),
    "statistics": ("tightrope.control.policy.normalise.Normalisers", "update", 5),
    "row": (Run, "record", 4),
    "episodes": (Run, "record_episodes", 4),
    "before a save": (Agent, "save", 2),
    "inside a save": ("tightrope.runs.checkpoint", "write_file", 4),
    "renaming": ("tightrope.runs.durable", "put", 2),
    "summary": (Run, "finish", 1),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "run"
    train.train(settings_for("CartPole-v1", engine="torch"), run_dir=folder)
    return folder


@pytest.mark.parametrize("phase", PHASES)
def test_every_phase_can_be_the_last(tmp_path, monkeypatch, whole, phase):
    place, name, call = PHASES[phase]
    if isinstance(place, str):
        place = pkgutil.resolve_name(place)
    settings = settings_for("CartPole-v1", engine="torch")
    killed(settings, tmp_path / "run", monkeypatch, place, name, call)
    train.resume(tmp_path / "run")
    assert_same_end(whole, tmp_path / "run")


def test_same_seed_same_bits_another_seed_others(tmp_path, whole):
    train.train(settings_for("CartPole-v1", engine="torch"), run_dir=tmp_path / "same")
    train.train(settings_for("CartPole-v1", engine="torch", seed=4), run_dir=tmp_path / "other")
    assert_same_end(whole, tmp_path / "same")
    assert rows_of(whole, "metrics.jsonl") != rows_of(tmp_path / "other", "metrics.jsonl")


# ---------------------------------------------------------------------------------- the grid


def test_points_of_a_grid():
    reached = [step for step in range(0, 1000, 100) if crosses(step, step + 100, 1000, 0.25)]
    assert reached == [200, 400, 700, 900]
    assert not crosses(0, 1000, 1000, None)
    assert crosses(0, 1000, 1000, 0.1), "several at once are one"
    assert all(crosses(step - 1, step, 3, 1 / 3) for step in (1, 2, 3)), "a rounding error loses no point"


class Clock(gym.Env):
    """Ends after its own 150 steps, with the reward at the end."""

    observation_space = gym.spaces.Box(0, 1, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.time = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.time += 1
        over = self.time == 150
        return np.array([self.time / 150], np.float32), float(over), over, False, {}


def make(env: Any, **values: Any) -> Agent:
    values = {**SMALL, "engine": "torch", "notify": lambda text: None, **values}
    return tightrope.PPO(env, **values)


def same_weights(a: Agent, b: Agent) -> bool:
    weights = b.policy.state_dict()
    return all(torch.equal(x, weights[name]) for name, x in a.policy.state_dict().items())


def test_nothing_is_reset_for_a_checkpoint_or_between_two_calls_of_learn():
    """600 steps are one episode of 150 in each copy, over four points of the grid and six calls."""
    a, b = make(Clock, checkpoint_every=0.2), make(Clock, checkpoint_every=0.2)
    reports = list(a.iterate(600))
    assert sum(report.on_grid for report in reports) == 5
    found = [list(report.episodes) for report in reports]
    for _ in range(6):
        b.learn(100)
    a.close()
    b.close()
    assert [episode[:3] for episode in found[-1]] == [(1.0, 150, True)] * 4 and not any(found[:-1])
    assert b.collector.boundary().running.origins.tolist() == [[1, 0, 0]] * 4


@pytest.mark.parametrize(
    ("env", "values"),
    [("CartPole-v1", {"vector_backend": "serial"}), ("CartPole-v1", {"vector_backend": "vector"}), (walk, {}),
     ("Pendulum-v1", {"vector_backend": "workers", "num_workers": 2, "std": "gsde"})],
    ids=["serial", "vector", "own state", "workers"],
)  # fmt: skip
def test_saving_changes_nothing_and_loading_goes_on(tmp_path, env, values):
    a, b = make(env, **values).learn(500), make(env, **values).learn(500)
    a.save(tmp_path / "a")
    c = tightrope.load(tmp_path / "a", env=env if env is walk else None)
    c.save(tmp_path / "again")  # before anything was learned
    d = tightrope.load(tmp_path / "again", env=env if env is walk else None)
    for agent in (a, b, c, d):
        agent.learn(500)
        assert same_weights(a, agent)
    for agent in (a, b, c, d):
        agent.close()


def test_ataris_vector_version_goes_on_where_it_was_saved(tmp_path):
    """Its episodes get seeds by masked resets, every 100 steps here, and a replay begins with them."""
    pytest.importorskip("ale_py")
    if not resets_rows_with_seeds(make_vector_by_id("ALE/Breakout-v5", 1)):
        return  # an older ale-py: told, not exact
    values = {"num_envs": 2, "num_steps": 64, "minibatch_size": 64, "num_epochs": 1, "reseed_after": 100}
    a = make("ALE/Breakout-v5", **values).learn(640)
    a.save(tmp_path / "a")
    lengths = a.collector.boundary().running.origins[:, 2]
    b = tightrope.load(tmp_path / "a")
    for agent in (a, b):
        agent.learn(256)
    assert same_weights(a, b) and len(set(lengths)) == 2
    a.close()
    b.close()


def test_a_snapshot_while_a_rollout_is_collected_is_the_last_boundary(tmp_path):
    """Ctrl-C saves it."""
    for env, backend in (("CartPole-v1", "serial"), ("CartPole-v1", "vector")):
        a = make(env, vector_backend=backend).learn(300)
        inside = make(env, vector_backend=backend).learn(300)
        found: list[Any] = []
        real, count = inside.environments.receive, 0

        def receive() -> Any:
            nonlocal count
            count += 1
            if count == 20:
                found.append(inside.save(tmp_path / backend))  # noqa: B023
            return real()  # noqa: B023

        inside.environments.receive = receive  # type: ignore[method-assign]
        inside.learn(100)
        b = tightrope.load(tmp_path / backend)
        assert b.steps == a.steps
        assert same_weights(a.learn(300), b.learn(300))
        for agent in (a, inside, b):
            agent.close()


def test_each_episode_has_a_seed_of_its_own_and_it_is_recorded():
    agent = make("CartPole-v1", vector_backend="serial")
    seeds = [seed for report in agent.iterate(600) for seed, after in report.seeds if not after]
    agent.close()
    assert len(set(seeds)) == len(seeds) > 10
    wanted = {episode_seed(SMALL["seed"], TRAINING, copy, k) for copy in range(4) for k in range(30)}
    assert set(seeds) <= wanted


def test_no_two_run_seeds_share_seeds():
    streams = {(run, stream): {episode_seed(run, stream, copy, k) for copy in range(8) for k in range(100)}
               for run in range(4) for stream in (TRAINING, EVALUATION)}  # fmt: skip
    assert all(len(found) == 800 for found in streams.values())
    assert len(set().union(*streams.values())) == 800 * len(streams)
    assert all(0 <= seed < 2**31 for found in streams.values() for seed in found)


def test_seeds_may_be_further_apart_and_nothing_else_changes_then(tmp_path, monkeypatch):
    agent = make("CartPole-v1", vector_backend="serial", reseed_after=100)
    seeds = [seed for report in agent.iterate(600) for seed in report.seeds]
    agent.close()
    assert {after for _, after in seeds} > {0, 1, 2} and len(set(seeds)) == len(seeds)
    settings = settings_for("CartPole-v1", engine="torch", vector_backend="serial", reseed_after=100)
    train.train(settings, run_dir=tmp_path / "whole")
    killed(settings, tmp_path / "hops", monkeypatch, Agent, "_one_update", 4)
    train.resume(tmp_path / "hops")
    assert_same_end(tmp_path / "whole", tmp_path / "hops")


class Forgetful(gym.Env):
    """Its episodes do not repeat: the ``what`` of step 5 comes from a counter that no reset knows."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)
    count = 0

    def __init__(self, what: str) -> None:
        self.what = what

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.time = 0
        Forgetful.count += 1
        return self._seen(float(Forgetful.count) if self.what == "reset" else 0.0)

    def _seen(self, value: float) -> tuple[np.ndarray, dict]:
        mask = np.array([1, self.what != "mask" or self.time != 5 or Forgetful.count < 500])
        return np.array([value], np.float32), {"action_mask": mask}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.time += 1
        Forgetful.count += 1
        odd = float(Forgetful.count) if self.time == 5 else 0.0
        observation, info = self._seen(odd if self.what == "observation" else 0.0)
        over = self.time == 500 or (self.what == "end" and odd > 500)
        return observation, odd if self.what == "reward" else 0.0, over, False, info


@pytest.mark.parametrize(
    ("what", "place"),
    [("observation", "step 5 of 75: another observation"), ("reward", "step 5 of 75: another reward"),
     ("mask", "step 5 of 75: another action mask"), ("end", "another end of the episode"),
     ("reset", "its reset: another observation")],
)  # fmt: skip
def test_a_replay_names_the_first_step_that_differs(tmp_path, monkeypatch, what, place):
    Forgetful.count = 0
    env = lambda: Forgetful(what)  # noqa: E731
    settings = settings_for(env, engine="torch", evaluate_every=None, num_envs=1, minibatch_size=25,
                            total_steps=150, checkpoint_every=0.5)  # fmt: skip
    killed(settings, tmp_path / "run", monkeypatch, Agent, "_one_update", 5, env=env)
    Forgetful.count = 1000
    said: list[str] = []
    train.resume(tmp_path / "run", env=env, listeners=[lambda event: said.append(str(event))])
    told = [line for line in said if line.startswith("warning: 1 of 1 copies did not repeat")]
    assert len(told) == 1 and place in told[0] and "copy 0, episode 0" in told[0]
    assert Run.open(tmp_path / "run").newest().state["steps"] == 150


@pytest.mark.parametrize(("columns", "replayed"), [(5, 0), (6, 1), (4, 4)])
def test_a_replay_of_no_step_of_one_and_of_all_but_one(tmp_path, columns, replayed):
    env = lambda: gym.wrappers.TimeLimit(gym.make("Pendulum-v1").unwrapped, 5)  # noqa: E731
    values = {"num_steps": columns, "num_envs": 2, "minibatch_size": 2 * columns}
    a = make(env, **values).learn(2 * columns)
    a.save(tmp_path / "a")
    assert a.collector.boundary().running.origins[:, 2].tolist() == [replayed] * 2
    b = tightrope.load(tmp_path / "a", env=env)
    for agent in (a, b):
        agent.learn(8 * columns)
    assert same_weights(a, b)
    a.close()
    b.close()


def test_an_episode_beyond_the_limit_goes_on_and_begins_again_at_a_resume(tmp_path, monkeypatch):
    settings = settings_for(Clock, engine="torch", replay_limit=40, evaluate_every=None, total_steps=800)
    said: list[str] = []
    listen = [lambda event: said.append(str(event))]
    train.train(settings, run_dir=tmp_path / "whole", env=Clock, listeners=listen)
    assert len([line for line in said if "longer than replay_limit 40" in line]) == 1
    assert [row["length"] for row in rows_of(tmp_path / "whole", "episodes.jsonl")] == [150] * 4
    killed(settings, tmp_path / "hops", monkeypatch, Agent, "_one_update", 5, env=Clock)
    train.resume(tmp_path / "hops", env=Clock)
    assert not rows_of(tmp_path / "hops", "episodes.jsonl"), "new ones began at step 300"


def test_evaluation_disturbs_nothing(tmp_path, whole):
    train.train(settings_for("CartPole-v1", engine="torch", evaluate_every=None), run_dir=tmp_path / "run")
    first, second = (Run.open(x).newest().tensors for x in (whole, tmp_path / "run"))
    assert all(torch.equal(x, second["policy"][name]) for name, x in first["policy"].items())


def test_an_extension_that_was_stopped_at_once_is_remembered(tmp_path, monkeypatch):
    settings = settings_for("CartPole-v1", engine="torch")
    for name in ("a", "b"):
        train.train(settings, run_dir=tmp_path / name)
    train.resume(tmp_path / "a", total_steps=900)
    killed(settings, tmp_path / "b", monkeypatch, Agent, "_one_update", 1, total_steps=900)
    train.resume(tmp_path / "b")
    assert_same_end(tmp_path / "a", tmp_path / "b")


# ---------------------------------------------------------------------------------- states


@pytest.mark.parametrize("workers", [1, 2])
def test_environments_that_give_their_state_go_on_in_the_middle(tmp_path, monkeypatch, workers):
    backend = {"vector_backend": "workers", "num_workers": 2} if workers == 2 else {}
    settings = settings_for(walk, engine="torch", checkpoint_every=0.2, **backend)
    train.train(settings, run_dir=tmp_path / "whole", env=walk)
    for call in (3, 2):
        killed(settings, tmp_path / "hops", monkeypatch, Agent, "_one_update", call, env=walk)
    train.resume(tmp_path / "hops", env=walk)
    assert_same_end(tmp_path / "whole", tmp_path / "hops")
    assert rows_of(tmp_path / "whole", "episodes.jsonl")


def test_what_a_state_may_hold():
    value = {
        "a": [1, 2.5, None, True, "x", b"\x00\xff"], "nan": float("nan"), "far": -float("inf"),
        "f": np.float32(0.1), "m": np.arange(6, dtype=np.int16).reshape(2, 3), "big": 2**100,
        "rng": np.random.default_rng(1).bit_generator.state, "mt": np.random.RandomState(1).get_state(False),
    }  # fmt: skip
    again = states.decode(json.loads(json.dumps(states.encode(value), allow_nan=False)))
    np.testing.assert_equal(again, value)
    assert again["m"].dtype == np.int16 and type(again["f"]) is np.float32
    for wrong in (object(), {1: 2}, np.array([object()]), {"deep": [lambda: 0]}):
        with pytest.raises(TypeError, match="no file can hold without pickling"):
            states.encode(wrong)
    for forged in ({"array": ["O", [1], ""]}, {"number": 3}, {"call": "os.system"}):
        with pytest.raises(ValueError, match="does not read"):
            states.decode(forged)


def test_a_wrapper_with_its_own_state_hides_the_inner_one():
    assert states.gives_state(gym.wrappers.OrderEnforcing(walk()))
    assert not states.gives_state(gym.wrappers.DelayObservation(walk(), 2))
    assert not states.gives_state(gym.make("CartPole-v1"))


def test_a_state_that_cannot_be_kept_names_the_environment():
    class Odd(Walk):
        def get_state(self) -> dict:
            return {"inner": [object()]}

    with (
        make_environments(Odd, 2, backend="serial", reseed_after=0) as environments,
        pytest.raises(EnvironmentFault, match=r"environment 0 \(Odd\) .*'inner'\]\[0\] is a obj"),
    ):
        environments.reset(0)


def test_a_state_of_other_shapes_is_refused(tmp_path):
    """The compiled engine would read beyond it."""
    run = tmp_path / "run"
    train.train(settings_for(walk, engine="torch", total_steps=200), run_dir=run, env=walk)
    folder, _, state = Run.open(run).newest()
    tensors = checkpoint.load(folder)[0]
    episodes = state["episodes"]
    for name, wrong, why in (
        ("returns", states.encode(np.zeros(1)), "returns of the episodes have another shape"),
        ("lengths", states.encode(np.zeros(4, np.float32)), "lengths of the episodes have another shape"),
        ("origins", [[0, 0, 3]], "cannot reshape"),
        ("origins", [[0, 0, 3]] * 4, "the log of copy 0 does not fit"),
        ("first", [1], "first of the episodes have another shape"),
    ):
        checkpoint.save(folder, tensors, {**state, "episodes": {**episodes, name: wrong}})
        with pytest.raises(checkpoint.CheckpointError, match=why):
            train.resume(run, env=walk)
    for wrong in ({"0.0": 10**6}, {"0.0": "x"}):
        checkpoint.save(folder, tensors, {**state, "growing": wrong})
        said: list[str] = []
        with Run.open(run, own=True) as opened:
            assert opened.resume_point(said.append, said.append).state["steps"] < state["steps"]
        assert "does not hold what belongs there" in said[-1]
    checkpoint.save(folder, tensors, state)
    Run.open(run).update_settings({**Run.open(run).settings, "total_steps": "many"})
    with pytest.raises(checkpoint.CheckpointError, match="run does not hold what belongs there"):
        train.resume(run, env=walk)


def test_resume_prints_what_it_cannot_promise(tmp_path, monkeypatch):
    settings = settings_for("CartPole-v1", engine="torch")
    killed(settings, tmp_path / "run", monkeypatch, Agent, "_one_update", 4)
    said: list[str] = []
    monkeypatch.setattr(np, "__version__", "0.1")
    train.resume(tmp_path / "run", listeners=[lambda event: said.append(str(event))])
    told = [line for line in said if "-> 0.1" in line]
    assert len(told) == 1 and "numpy" in told[0] and "-> 0.1 since the checkpoint" in told[0]


def test_environments_that_cannot_be_continued_are_told_once(tmp_path):
    vector = gym.vector.SyncVectorEnv([walk] * 4)
    said: list[str] = []
    settings = settings_for(vector, engine="torch")
    listen = [lambda event: said.append(str(event))]
    train.train(settings, run_dir=tmp_path / "run", env=vector, listeners=listen)
    assert len([line for line in said if "they begin new episodes" in line]) == 1
    assert "neither be repeated" in str(said)
    train.resume(tmp_path / "run", env=vector, total_steps=700)
    vector.close()


@pytest.mark.parametrize("backend", ["serial", "workers"])
def test_without_seeds_the_setting_is_named_and_not_the_environments(tmp_path, backend):
    said: list[str] = []
    settings = settings_for("Acrobot-v1", engine="torch", vector_backend=backend, reseed_after=None)
    train.train(settings, run_dir=tmp_path / "run", listeners=[lambda event: said.append(str(event))])
    told = [line for line in said if "they begin new episodes" in line]
    assert len(told) == 1 and "With reseed_after none only first episodes have seeds" in told[0]
    assert "neither" not in told[0]


def test_evaluating_twice_gives_the_same(whole):
    agent = tightrope.load(whole)
    with make_environments("CartPole-v1", 2) as environments:
        first, second = (evaluate_agent(agent, environments, 4)["returns"] for _ in range(2))
    agent.close()
    assert first == second
