"""What a run tells about its episodes and evaluations: means, successes, cuts, the row of the last one."""

from __future__ import annotations

import contextlib
import json
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import tightrope
from tightrope.algorithms.descent import SamplingMismatch
from tightrope.cli.main import main
from tightrope.control.environments.make import make_environments
from tightrope.control.evaluate import evaluate_run
from tightrope.control.resolve import resolve
from tightrope.control.rollout.evaluation import evaluate_agent, step_limit
from tightrope.control.train import resume, train
from tightrope.runs.run import Run
from tightrope.training.events import Message, Stop, Updated

SMALL: dict[str, Any] = {
    "num_envs": 2, "num_steps": 16, "minibatch_size": 16, "num_epochs": 1, "engine": "torch",
    "seed": 0, "checkpoint_every": None,
}  # fmt: skip


class Goal(gym.Env):
    """Episodes of ``length`` steps; every second one reaches its goal. With length 0 one never ends."""

    def __init__(self, length: int = 5, tells: bool = True, truncates: bool = False) -> None:
        self.observation_space, self.action_space = gym.spaces.Box(-1, 1, (1,)), gym.spaces.Discrete(2)
        self.length, self.tells, self.truncates, self.count = length, tells, truncates, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t, self.count = 0, self.count + 1
        return np.zeros(1, np.float32), {"is_success": True}  # of a reset, which is no end

    def step(self, action: Any) -> Any:
        self.t += 1
        end = self.t == self.length
        info = {"is_success": bool(self.count % 2)} if self.tells else {}
        return np.zeros(1, np.float32), 1.0, end and not self.truncates, end and self.truncates, info


# --------------------------------------------------------------------------------------------- the episodes


def test_means_are_of_the_last_100_episodes_and_never_missing_once_one_ended() -> None:
    agent = tightrope.PPO("CartPole-v1", **{**SMALL, "num_steps": 8}, learning_rate=1e-9)
    returns: list[float] = []
    seen = 0
    for update in agent.iterate(5_000):
        metrics, new = update.metrics, [episode[0] for episode in update.episodes]
        returns += new
        if not returns:
            assert "rollout/ep_rew_mean" not in metrics
            continue
        assert metrics["rollout/ep_rew_mean"] == pytest.approx(np.mean(returns[-100:]))
        assert ("rollout/new_ep_rew_mean" in metrics) == bool(new)
        if new:
            assert metrics["rollout/new_ep_rew_mean"] == pytest.approx(np.mean(new))
        seen += not new
    assert len(returns) > 110
    assert seen > 10


class Killed(BaseException):
    """Ends a run between two checkpoints without a save, as a kill does; Ctrl-C would save."""


def test_means_of_the_last_episodes_are_resumed_exactly(tmp_path: Path) -> None:
    """The killed run has another history of rollouts after its checkpoint, and the same rows at the end."""
    settings = resolve("CartPole-v1", "ppo", {**SMALL, "total_steps": 512, "checkpoint_every": 0.25})
    train(settings, run_dir=tmp_path / "whole")

    def stop(event: Any) -> None:
        if isinstance(event, Updated) and event.step >= 320:
            raise Killed

    with pytest.raises(Killed):
        train(settings, run_dir=tmp_path / "killed", listeners=[stop])
    resume(tmp_path / "killed")
    wanted, found = (Run.open(tmp_path / name).read_metrics() for name in ("whole", "killed"))
    names = [
        "step",
        "rollout/ep_rew_mean",
        "rollout/ep_len_mean",
        "rollout/new_ep_rew_mean",
        "eval/mean_reward",
    ]
    assert [[row.get(name) for name in names] for row in found] == [
        [row.get(name) for name in names] for row in wanted
    ]


@pytest.mark.parametrize("backend", ["serial", "workers"])
@pytest.mark.parametrize("truncates", [False, True])
def test_successes_of_single_environments(backend: str, truncates: bool) -> None:
    how = {"vector_backend": backend, "num_workers": 2 if backend == "workers" else None}
    agent = tightrope.PPO(lambda: Goal(truncates=truncates), **SMALL, **how)
    try:
        updates = list(agent.iterate(320))
    finally:
        agent.close()
    assert updates[-1].metrics["rollout/success_rate"] == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("mode", list(gym.vector.AutoresetMode))
@pytest.mark.parametrize("truncates", [False, True])
def test_successes_of_vector_environments(mode: gym.vector.AutoresetMode, truncates: bool) -> None:
    """One of two copies tells; resets tell something else."""
    copies = [lambda: Goal(truncates=truncates), lambda: Goal(7, tells=False, truncates=truncates)]
    env = gym.vector.SyncVectorEnv(copies, autoreset_mode=mode)
    environments = make_environments(env)
    environments.reset(0)
    told: list[list[float]] = []
    for _ in range(30):
        step = environments.step(np.zeros((2, 1), np.float32))
        if step.success is not None:
            told += [step.success[np.flatnonzero(step.terminated | step.truncated)].tolist()]
    said = [x for row in told for x in row if not np.isnan(x)]
    assert said[:4] == [1.0, 0.0, 1.0, 0.0]


def test_an_environment_that_says_nothing_has_no_rate() -> None:
    agent = tightrope.PPO(lambda: Goal(tells=False), **SMALL)
    assert all("rollout/success_rate" not in update.metrics for update in agent.iterate(128))


def test_successes_of_evaluations(tmp_path: Path) -> None:
    settings = resolve(Goal, "ppo", {**SMALL, "total_steps": 128})
    summary = train(settings, run_dir=tmp_path / "run", env=Goal)
    assert summary["final"]["eval/success_rate"] == 1.0  # the first episode of each of ten copies
    rate = evaluate_run(tmp_path / "run", env=Goal, episodes=20)["success_rate"]
    assert rate == 0.5


@pytest.mark.parametrize(("lengths", "rate"), [((5, 20), 0.5), ((20, 20), 0.0)])
def test_an_evaluation_episode_that_is_cut_is_a_failure(lengths: tuple[int, int], rate: float) -> None:
    class Wins(Goal):
        def step(self, action: Any) -> Any:
            return *super().step(action)[:4], {"is_success": True}

    copies = [lambda length=length: Wins(length) for length in lengths]
    agent = tightrope.PPO(Wins, **SMALL).learn(64)
    with contextlib.closing(agent), make_environments(gym.vector.SyncVectorEnv(copies)) as environments:
        found = evaluate_agent(agent, environments, 4, max_steps=10)
    assert (found["cut_episodes"], found["success_rate"]) == (4 - 4 * rate, rate)


def test_a_success_that_is_no_number_is_named() -> None:
    class Odd(Goal):
        def step(self, action: Any) -> Any:
            return (*super().step(action)[:4], {"is_success": "yes"})

    with pytest.raises(RuntimeError, match=r"info\['is_success'\] is 'yes', expected True or False"):
        tightrope.PPO(Odd, **SMALL).learn(64)


# ------------------------------------------------------------------------------------------- the evaluation


class Endless(gym.Env):
    """Ends by action 1 after the fifth step; a greedy policy that prefers 0 never ends it."""

    def __init__(self) -> None:
        self.observation_space, self.action_space = gym.spaces.Box(-1, 1, (1,)), gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        return np.zeros(1, np.float32), 1.0, bool(action == 1 and self.t > 5), False, {}


class Zeros(torch.nn.Module):
    """Prefers action 0."""

    def __init__(self) -> None:
        super().__init__()
        self.bias = torch.nn.Parameter(torch.tensor([3.0, 0.0]))

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.bias.expand(len(x), 2), self.bias[1].expand(len(x))


def test_an_evaluation_that_would_never_end_is_cut_counted_and_told(tmp_path: Path) -> None:
    settings = resolve(Endless, "ppo", {**SMALL, "total_steps": 64, "evaluation_max_steps": 50})
    said: list[str] = []
    heard = lambda event: said.append(str(event)) if isinstance(event, Message) else None  # noqa: E731
    train(settings, run_dir=tmp_path / "run", env=Endless, policy=Zeros(), listeners=[heard])
    rows = [row for row in Run.open(tmp_path / "run").read_metrics() if "eval/episodes" in row]
    assert rows
    for row in rows:
        assert (row["eval/cut_episodes"], row["eval/mean_length"], row["eval/mean_reward"]) == (10, 50, 50)
    assert [text for text in said if "10 of 10 evaluation episodes had not ended after 50 steps" in text]
    assert len([text for text in said if "had not ended" in text]) == 1
    with pytest.warns(UserWarning, match="25 of 25 evaluation episodes had not ended after 30 steps"):
        found = evaluate_run(
            tmp_path / "run", env=Endless, policy=Zeros(), episodes=25, evaluation_max_steps=30
        )
    assert (found["cut_episodes"], found["max_steps"], found["mean_length"]) == (25, 30, 30)
    assert found["episodes"] == len(found["returns"]) == 25


def test_the_limit_comes_from_what_training_saw_and_is_the_same_after_loading(tmp_path: Path) -> None:
    agent = tightrope.PPO(lambda: Goal(700), **{**SMALL, "num_steps": 256})
    limit = lambda agent: step_limit(agent.settings, agent.environments, agent.episodes.longest)  # noqa: E731
    assert limit(agent) == 1000
    agent.learn(1_600)
    assert limit(agent) == 1400
    agent.save(tmp_path / "agent")
    loaded = tightrope.load(tmp_path / "agent", env=Goal)
    assert limit(loaded) == 1400
    timed = tightrope.PPO("MountainCar-v0", **SMALL)  # 200 steps
    assert limit(timed) == 1000
    timed.environments.max_episode_steps = 5_000
    assert limit(timed) == 5_000


def test_the_time_limit_of_a_wrapper_is_the_limit() -> None:
    make = lambda: gym.wrappers.TimeLimit(gym.wrappers.TimeLimit(Goal(0), 2_500), 3_000)  # noqa: E731
    agent = tightrope.PPO(make, **SMALL)
    with contextlib.closing(agent):
        assert step_limit(agent.settings, agent.environments, 0) == 2_500
    assert resolve(make, "reinforce", {}).num_steps == 7_500
    short = gym.wrappers.TimeLimit(gym.make("CartPole-v1"), 40)  # the spec says 500
    with make_environments(short) as environments:
        assert environments.max_episode_steps == 40


def test_a_best_that_was_cut_is_replaced_under_a_larger_limit(tmp_path: Path, monkeypatch: Any) -> None:
    """Each step costs 1, and an episode has 30 steps: the first limit makes it seem cheap."""

    class Costs(Goal):
        def step(self, action: Any) -> Any:
            observation, _, *rest = super().step(action)
            return observation, -1.0, *rest

    make = lambda: Costs(30)  # noqa: E731
    bests = []
    for limit, steps in ((10, 64), (10, 128), (20, 192), (40, 256), (50, 320)):
        monkeypatch.setattr("tightrope.control.train.step_limit", lambda *_, limit=limit: limit)
        values = {**SMALL, "total_steps": steps, "evaluate_every": 1.0}
        if steps == 64:
            train(resolve(make, "ppo", values), run_dir=tmp_path / "run", env=make)
        else:
            resume(tmp_path / "run", env=make, total_steps=steps)
        bests.append(load_steps(tmp_path / "run" / "best"))
    assert bests == [64, 64, 192, 256, 256]


def load_steps(folder: Path) -> int:
    with contextlib.closing(tightrope.load(folder, env=Goal)) as agent:
        return agent.steps


def test_where_nothing_is_cut_the_limit_changes_nothing() -> None:
    agent = tightrope.PPO("CartPole-v1", **SMALL)
    with make_environments("CartPole-v1", 3) as environments:
        free = evaluate_agent(agent, environments, 8)
        bound = evaluate_agent(agent, environments, 8, max_steps=500)
    assert free == bound
    assert free["cut_episodes"] == 0


def test_copies_whose_episodes_are_cut_go_on_with_new_ones() -> None:
    """Some end in time and some do not: each copy still plays its share."""
    agent = tightrope.PPO("CartPole-v1", **SMALL)
    with make_environments("CartPole-v1", 3) as environments:
        free = evaluate_agent(agent, environments, 12)
        middle = float(np.median([*free["returns"]]))
        cut = evaluate_agent(agent, environments, 12, max_steps=middle)
    assert cut["episodes"] == 12
    assert 0 < cut["cut_episodes"] < 12
    assert max(cut["returns"]) <= middle


def test_the_final_evaluation_is_the_last_row(tmp_path: Path) -> None:
    settings = resolve("CartPole-v1", "ppo", {**SMALL, "total_steps": 128, "tensorboard": True})
    summary = train(settings, run_dir=tmp_path / "run")
    rows = Run.open(tmp_path / "run").read_metrics()
    assert rows[-1]["step"] == 128
    assert {name: rows[-1][name] for name in summary["final"]} == summary["final"]
    assert {"eval/mean_reward", "eval/episodes"} <= set(rows[-1])
    resume(tmp_path / "run")  # it is complete: nothing is added
    assert Run.open(tmp_path / "run").read_metrics() == rows
    resume(tmp_path / "run", total_steps=192)
    longer = Run.open(tmp_path / "run").read_metrics()
    assert longer[: len(rows)] == rows
    assert "eval/mean_reward" in longer[-1] and longer[-1]["step"] == 192


def scalars(folder: Path) -> dict[str, list[tuple[int, float]]]:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    found = EventAccumulator(str(folder / "tensorboard"))
    found.Reload()
    return {name: [(x.step, x.value) for x in found.Scalars(name)] for name in found.Tags()["scalars"]}


def test_tensorboard_goes_on_where_the_run_does(tmp_path: Path) -> None:
    """After a kill the steps behind the checkpoint are there once; the final evaluation is there too."""
    pytest.importorskip("tensorboard")
    values = {**SMALL, "total_steps": 256, "tensorboard": True, "checkpoint_every": 0.25}

    def stop(event: Any) -> None:
        if isinstance(event, Updated) and event.step >= 160:
            raise Killed

    with pytest.raises(Killed):
        train(resolve("CartPole-v1", "ppo", values), run_dir=tmp_path / "run", listeners=[stop])
    resume(tmp_path / "run")
    found, rows = scalars(tmp_path / "run"), Run.open(tmp_path / "run").read_metrics()
    for name in ("train/entropy", "eval/mean_reward"):
        wanted = [(row["step"], pytest.approx(row[name], rel=1e-5)) for row in rows if name in row]
        assert found[name] == wanted


def test_a_run_that_a_listener_stops_has_its_final_row(tmp_path: Path) -> None:
    settings = resolve("CartPole-v1", "ppo", {**SMALL, "total_steps": 512})
    train(
        settings, run_dir=tmp_path / "run", listeners=[lambda e: Stop() if isinstance(e, Updated) else None]
    )
    rows = Run.open(tmp_path / "run").read_metrics()
    assert [row["step"] for row in rows] == [64, 64]  # 48 steps of them are the warm-up
    assert "eval/mean_reward" in rows[-1]


def test_evaluate_takes_the_limit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = resolve("CartPole-v1", "ppo", {**SMALL, "total_steps": 64, "evaluate_every": None})
    train(settings, run_dir=tmp_path / "run")
    words = ["evaluate", str(tmp_path / "run"), "--episodes", "4", "--evaluation-max-steps", "3", "--json"]
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert main(words) == 0
    printed = capsys.readouterr()
    found = json.loads(printed.out)
    assert (found["cut_episodes"], found["mean_length"]) == (4, 3)
    assert "4 of 4 evaluation episodes had not ended after 3 steps" in printed.err


# ------------------------------------------------------------------------------------------ the first ratio


class Dropped(torch.nn.Module):
    """Dropout in front of a head that starts at zero: in the first update it changes no probability."""

    def __init__(self) -> None:
        super().__init__()
        self.body, self.head, self.critic = (torch.nn.Linear(4, n) for n in (32, 2, 1))
        self.body, self.head = torch.nn.Linear(4, 32), torch.nn.Linear(32, 2)
        torch.nn.init.zeros_(self.head.weight)
        torch.nn.init.zeros_(self.head.bias)

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        hidden = torch.nn.functional.dropout(torch.tanh(self.body(x)), 0.1, training=True)
        return self.head(hidden), self.critic(x)[:, 0]


def test_dropout_behind_a_head_that_starts_at_zero_is_found_in_the_second_update() -> None:
    values = {**SMALL, "num_steps": 64, "normalise_observations": False}  # inputs of the same size in both
    agent = tightrope.PPO("CartPole-v1", policy=Dropped(), **values)
    updates = agent.iterate(1_024)
    assert next(updates).metrics["train/log_ratio_first"] <= 1e-5
    with pytest.raises(SamplingMismatch, match="dropout"):
        next(updates)
