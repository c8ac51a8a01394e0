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
from tightrope.control.environments.faults import EnvironmentFault
from tightrope.control.environments.make import make_environments
from tightrope.control.evaluate import evaluate_agent
from tightrope.control.resolve import resolve
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


@pytest.mark.parametrize("source", ["CartPole-v1", walk])
def test_environments_are_reset_only_on_the_grid_unless_they_save_their_state(tmp_path, source):
    """Without files, signals or clocks: learn in Python resets at the same steps as a run."""
    seen: list[int] = []
    agent = tightrope.PPO(source, notify=lambda text: None, **{**SMALL, "engine": "torch"})
    real = agent.environments.reset
    agent.environments.reset = lambda seed: seen.append(seed) or real(seed)  # type: ignore[method-assign]
    points = [report.step for report in agent.iterate() if report.on_grid]
    agent.close()
    assert points == [200, 400, 600]  # 180, 360 and 540, at the end of the current update
    assert seen[0] == SMALL["seed"]
    assert len(seen) == len(set(seen)) == (1 if source is walk else 3)  # nothing begins after the end


def test_cut_episodes_are_not_counted_and_their_rewards_are_forgotten():
    """Pendulum's episodes have 200 steps; these are cut after 150, 100 and 150."""
    agent = tightrope.PPO("Pendulum-v1", notify=lambda text: None, **{**SMALL, "total_steps": 1600,
                          "num_steps": 50, "engine": "torch"})  # fmt: skip
    at_start, real = [], agent.collector.collect

    def collect(engine: Any, columns: int, warm_up: int) -> Any:
        at_start.append(bool(agent.normalisers.rewards.running.any()))
        return real(engine, columns, warm_up)

    agent.collector.collect = collect  # type: ignore[method-assign]
    reports = list(agent.iterate())
    agent.close()
    assert not any(report.episodes for report in reports)
    anew = [True, *(report.on_grid for report in reports[:-1])]
    assert at_start == [not begins for begins in anew] and anew.count(True) == 3


def test_the_default_grid_leaves_room_for_an_episode():
    assert resolve("CartPole-v1").checkpoint_every == 0.05
    coarse = resolve("CartPole-v1", overrides={"total_steps": 20_000, "num_envs": 8})
    assert coarse.checkpoint_every == pytest.approx(0.2)
    assert resolve("CartPole-v1", overrides={"total_steps": 1000}).checkpoint_every == 1.0
    given = resolve("CartPole-v1", overrides={"total_steps": 1000, "checkpoint_every": 0.1})
    assert given.checkpoint_every == 0.1


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

    with make_environments(Odd, 2, backend="serial") as environments:
        environments.reset(0)
        with pytest.raises(
            EnvironmentFault, match=r"state of environment 0 \(Odd\) .*'inner'\]\[0\] is a obj"
        ):
            environments.get_state()


def test_a_state_of_other_shapes_is_refused(tmp_path):
    """The compiled engine would read beyond it."""
    run = tmp_path / "run"
    train.train(settings_for(walk, engine="torch", total_steps=200), run_dir=run, env=walk)
    folder, tensors, state = Run.open(run).newest()
    short, ints = np.zeros(1), np.zeros(4, np.float32)
    for name, wrong in {"_returns": short, "_lengths": ints, "_inputs": {"flat": ints[:, None]}}.items():
        episodes = {**state["episodes"], name: states.encode(wrong)}
        checkpoint.save(folder, tensors, {**state, "episodes": episodes})
        with pytest.raises(
            checkpoint.CheckpointError, match=f"{name[1:]} of the episodes have another shape"
        ):
            train.resume(run, env=walk)
    for seed in ("1", 2**70, -1):
        environments = {**state["episodes"]["environments"], "seed": seed}
        episodes = {**state["episodes"], "environments": environments}
        checkpoint.save(folder, tensors, {**state, "episodes": episodes})
        with pytest.raises(checkpoint.CheckpointError, match=f"the seed of the episodes is {seed}"):
            train.resume(run, env=walk)
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
    told = [line for line in said if "begin new episodes" in line or "-> 0.1" in line]
    assert len(told) == 2, said
    assert "numpy" in told[0] and "-> 0.1 since the checkpoint" in told[0]
    assert "4 environments begin new episodes at step 200" in told[1]


def test_evaluating_twice_gives_the_same(whole):
    agent = tightrope.load(whole)
    with make_environments("CartPole-v1", 2) as environments:
        first, second = (evaluate_agent(agent, environments, 4)["returns"] for _ in range(2))
    agent.close()
    assert first == second
