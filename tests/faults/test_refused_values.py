"""Values that a library refuses, or takes for something else, are named with the remedy."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

import tightrope
from tightrope.cli.main import main
from tightrope.control.environments.faults import EnvironmentFault
from tightrope.control.evaluate import evaluate_run
from tightrope.control.resolve import resolve
from tightrope.control.rollout.collector import BadNumbers
from tightrope.control.train import resume, train
from tightrope.language.alignment.align import resume_align
from tightrope.language.compare import sample_run
from tightrope.language.settings import AlignSettings, RewardSettings, SFTSettings
from tightrope.language.supervised.sft import resume_sft
from tightrope.runs import checkpoint
from tightrope.runs.durable import CannotWrite
from tightrope.runs.run import Run
from tightrope.training.events import Updated

SMALL: dict[str, Any] = {
    "num_envs": 2,
    "num_steps": 16,
    "minibatch_size": 16,
    "num_epochs": 1,
    "engine": "torch",
}


@pytest.fixture(scope="module")
def agent() -> tightrope.PPO:
    return tightrope.PPO("CartPole-v1", **SMALL)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (
            {"seed": 99999999999999999999},
            "seed is 99999999999999999999; expected at most 9223372036854775807",
        ),
        ({"seed": 10**309}, "seed is a number of more than 30 digits"),
        ({"gamma": 10**309}, "gamma is a number of more than 30 digits"),
        ({"hidden": (2**63,)}, "hidden is 9223372036854775808"),
        ({"hidden": (10**18,)}, r"hidden is \(1000000000000000000,\); expected 1 <= x <= 1e\+06"),
        ({"num_envs": 10**18}, r"num_envs is 1000000000000000000; expected 1 <= x <= 1e\+06"),
        ({"threads": 1_000_000}, "threads is 1000000; expected 1 <= x <= 1024"),
        ({"device": "meta"}, "device is 'meta', which holds no numbers. Choose cpu"),
        ({"clip": 1e308}, r"clip is 1e\+308; expected a size between 1.2e-38 and 3.4e\+38 .float32"),
        ({"max_grad_norm": 5e-324}, r"max_grad_norm is 5e-324; expected a size between"),
        ({"evaluate_every": 5e-324}, r"evaluate_every is 5e-324; expected a size between"),
        (
            {"num_steps": 10**9},
            r"num_envs 8 \* num_steps 1,000,000,000 steps takes .* Choose a smaller num_envs or num_steps",
        ),
        ({"num_envs": 10**6, "num_steps": 10**6}, "Choose a smaller num_envs or num_steps"),
        ({"hidden": (10**6, 10**6)}, "the networks of hidden 1000000 1000000 .* Choose a smaller hidden"),
    ],
)
def test_settings_beyond_what_can_be_are_named(values: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        tightrope.PPO("CartPole-v1", **values)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"kl_adapt": 0.01}, "kl_adapt 0.01 has no effect: kl_beta is none, and it needs a value"),
        ({"action_bounds": "squash"}, "action_bounds has no effect: the task has no Box action"),
        ({"std": "gsde"}, "std has no effect: the task has no Box action"),
        ({"log_std_init": -1.0}, "log_std_init has no effect: the task has no Box action"),
        ({"gsde_steps": 4}, "gsde_steps 4 has no effect: std is independent, and it needs gsde"),
        (
            {"num_workers": 2, "vector_backend": "serial"},
            "num_workers 2 has no effect: vector_backend is serial, and it needs auto or mixed or workers",
        ),
        ({"max_env_restarts": 3}, "max_env_restarts 3 has no effect: on_env_fault is raise"),
        (
            {"clip_high": 0.3, "kl_beta": 0.1},
            "clip_high 0.3 has no effect: kl_beta is 0.1, and it needs none",
        ),
    ],
)
def test_settings_without_an_effect_are_told(values: dict[str, Any], words: str, tmp_path: Path) -> None:
    said: list[str] = []
    agent = tightrope.PPO("CartPole-v1", **{**SMALL, **values}, notify=said.append)
    assert [text for text in said if words in text]
    agent.close()
    settings = resolve("CartPole-v1", "ppo", {**SMALL, **values, "total_steps": 64})
    warned: list[Any] = []
    train(settings, run_dir=tmp_path / "run", listeners=[warned.append])
    assert [e for e in warned if words in getattr(e, "text", "") and e.level == "warning"]


def test_settings_with_an_effect_are_not_told() -> None:
    said: list[str] = []
    tightrope.PPO("CartPole-v1", **SMALL, kl_beta=0.1, kl_adapt=0.01, notify=said.append).close()
    tightrope.PPO("Pendulum-v1", **SMALL, std="gsde", gsde_steps=4, notify=said.append).close()
    assert said == []
    assert AlignSettings().without_effect() == RewardSettings().without_effect() == []
    assert AlignSettings(kl_horizon=5.0).without_effect() == [
        "kl_horizon 5.0 has no effect: kl_goal is none, and it needs a value."
    ]
    assert SFTSettings(tune="full", lora_rank=4).without_effect()


def test_settings_of_a_critic_that_is_not_there_are_told() -> None:
    values = {
        "critic_lambda": 0.9,
        "value_weight": 1.0,
        "critic_learning_rate": 1e-3,
        "normalise_values": False,
    }
    small = {"num_steps": 64, "engine": "torch"}
    for baseline, expected in ((False, list(values)), (True, [])):
        said: list[str] = []
        more = {**small, "baseline": baseline}
        tightrope.Reinforce("CartPole-v1", **more, **values, notify=said.append).close()
        told = [text for text in said if "has no effect: baseline is off, and it needs on." in text]
        assert sorted(text.split()[0] for text in told) == sorted(expected)
        said.clear()
        tightrope.Reinforce("CartPole-v1", **more, notify=said.append).close()
        assert not [text for text in said if "no effect" in text]


def test_settings_of_the_built_in_networks_beside_a_module_of_ones_own_are_told(tmp_path: Path) -> None:
    def module(observations: Any, actions: Any) -> Any:
        class Two(torch.nn.Module):
            def __init__(self) -> None:
                super().__init__()
                self.layer = torch.nn.Linear(math.prod(observations.shape), 3)

            def forward(self, seen: Any) -> Any:
                out = self.layer(seen.flatten(1))
                return out[:, : 1 if actions.shape else 2], out[:, 2]

        return Two()

    values: dict[str, Any] = {"hidden": (8,), "activation": "relu", "shared": True}
    said: list[str] = []
    tightrope.PPO("CartPole-v1", **SMALL, **values, policy=module, notify=said.append).close()
    expected = [f"{name} has no effect: the policy is a module of your own." for name in values]
    assert [text for text in said if "no effect" in text] == expected
    warned: list[Any] = []
    settings = resolve("CartPole-v1", "ppo", {**SMALL, **values, "total_steps": 64})
    train(settings, run_dir=tmp_path / "run", policy=module, listeners=[warned.append])
    assert [e.text for e in warned if "no effect" in getattr(e, "text", "")] == expected
    said.clear()  # what a preset chose is nobody's mistake
    tightrope.PPO("Pendulum-v1", **SMALL, policy=module, notify=said.append).close()
    tightrope.PPO("CartPole-v1", **SMALL, **values, notify=said.append).close()
    assert not [text for text in said if "no effect" in text]


@pytest.mark.parametrize("tiny", [{"value_clip": 1e-8}, {"clip": 1e-9}, {"target_kl": 1e-20}])
def test_ties_at_a_tiny_clip_are_no_difference_of_the_engines(tiny: dict[str, float]) -> None:
    agent = tightrope.PPO("CartPole-v1", **{**SMALL, "engine": "fused"}, **tiny, notify=lambda text: None)
    agent.learn(128)
    agent.close()


@pytest.mark.parametrize("steps", [1, 0, -5])
def test_a_budget_of_less_than_a_step_in_each_environment(agent: tightrope.PPO, steps: int) -> None:
    with pytest.raises(
        ValueError, match=f"{steps} steps are too few: there are 2 .*at least 4|total_steps is {steps}"
    ):
        agent.learn(steps)
    assert agent.steps == 0


@pytest.mark.parametrize(
    ("steps", "words"),
    [
        (np.nan, "total_steps is nan"), ("x", "total_steps is 'x'"), (2.5, "total_steps is 2.5"),
        (True, "total_steps is True"), (10**400, "a number of more than 30 digits"),
    ],
)  # fmt: skip
def test_a_budget_that_is_no_whole_number(agent: tightrope.PPO, steps: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        agent.learn(steps)
    assert agent.steps == 0


def test_a_budget_may_be_written_as_a_float() -> None:
    assert 64 < tightrope.PPO("CartPole-v1", **SMALL).learn(1e2).steps <= 100


def test_a_budget_that_is_too_small_leaves_no_run_folder(tmp_path: Path) -> None:
    agent = tightrope.PPO("CartPole-v1", total_steps=3, **SMALL)
    with pytest.raises(ValueError, match="3 steps are too few"):
        train(agent.settings, run_dir=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_an_empty_batch_has_no_actions(agent: tightrope.PPO) -> None:
    assert agent.predict(np.zeros((0, 4), np.float32))[0].shape == (0,)
    assert agent.value(np.zeros((0, 4), np.float32)).shape == (0,)


@pytest.mark.parametrize("name", ["7.foo", "x.foo", "0", "-1.foo", "0.a b"])
def test_what_is_carried_is_an_attribute_of_a_layer(name: str) -> None:
    for backend, words in (("serial", "there are 3 here"), ("vector", "vector environments have none")):
        given = {**SMALL, "vector_backend": backend, "carried": name}
        with pytest.raises(ValueError, match=f"carried has .*; expected LAYER.ATTRIBUTE.*{words}"):
            tightrope.PPO("CartPole-v1", **given)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_an_observation_that_is_not_finite_gives_no_action_and_no_value(
    agent: tightrope.PPO, bad: float
) -> None:
    single = [0.0, 0.0, bad, 0.0]
    for given, row in ((single, 0), ([[0.0] * 4, single], 1)):
        for ask in (agent.predict, agent.value):
            with pytest.raises(
                ValueError, match=f"observation {row} holds {bad} at index 2; expected finite"
            ):
                ask(np.asarray(given, np.float32))


@pytest.mark.parametrize("given", [None, [], "x", {}, [[0.0] * 4, [0.0]], [None] * 4, [0.0] * 3])
def test_what_is_no_observation_is_named(agent: tightrope.PPO, given: Any) -> None:
    for ask in (agent.predict, agent.value):
        with pytest.raises(ValueError, match=r"bservation.* (is|has shape) .*Box"):
            ask(given)


def test_what_is_no_dict_of_observations_is_named() -> None:
    agent = tightrope.PPO(lambda: Named("speed", "angle"), **SMALL)
    for given in (None, [1.0], {"speed": [0.0]}, 3.0):
        with pytest.raises(ValueError, match=r"bservation.*(Dict|angle)"):
            agent.predict(given)


@pytest.mark.parametrize("mask", [[-np.inf, 0.0], [0, 2], [0.5, 1.0], [np.nan, 1.0]])
def test_a_mask_of_other_numbers_than_0_and_1(agent: tightrope.PPO, mask: list[float]) -> None:
    """bool(-inf) is True: an additive mask would allow what it means to forbid."""
    with pytest.raises(
        ValueError, match="the action mask holds .*; expected True .1. where a choice is allowed"
    ):
        agent.predict(np.zeros(4, np.float32), action_masks=np.array(mask))


@pytest.mark.parametrize("mask", [[True, False], [1, 0], [1.0, 0.0], np.array([1, 0], np.int8)])
def test_a_mask_of_0_and_1_in_any_type(agent: tightrope.PPO, mask: Any) -> None:
    assert agent.predict(np.zeros(4, np.float32), action_masks=mask)[0] == 0


class Odd(gym.Env):
    """Two numbers to see, one step long; what a step returns is given."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(
        self, observation: Any = (0.0, 0.0), reward: Any = 0.0, ended: Any = True, mask: Any = None
    ) -> None:
        self.given = np.asarray(observation), reward, ended
        self.mask, self.t = mask, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {} if self.mask is None else {"action_mask": np.ones(2, bool)}

    def step(self, action: Any) -> Any:
        self.t += 1
        info = {} if self.mask is None else {"action_mask": np.asarray(self.mask)}
        observation, reward, ended = self.given if self.t > 3 else (np.zeros(2, np.float32), 0.0, False)
        return observation, reward, ended, False, info


@pytest.mark.parametrize(
    ("odd", "words"),
    [
        (
            {"observation": [1 + 2j, 0], "ended": False},
            "the observation is array.*expected an array of real numbers",
        ),
        (
            {"observation": ["0.5", "1"], "ended": False},
            "the observation is array.*expected an array of real numbers",
        ),
        ({"mask": [-np.inf, 0.0], "ended": False}, "the action mask holds -inf"),
    ],
)
def test_what_numpy_would_store_as_another_number(odd: dict[str, Any], words: str) -> None:
    """It comes late, when the first step has passed its checks."""
    agent = tightrope.PPO(lambda: Odd(**odd), **SMALL)
    with pytest.raises(EnvironmentFault, match=words):
        agent.learn(64)


@pytest.mark.parametrize("late", [0, 20])
@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (1, "1", "the reward is '1', expected one number"), (1, None, "the reward is None"),
        (1, np.array([1.0]), r"the reward is array\(\[1"), (1, 1 + 2j, r"the reward is \(1\+2j\)"),
        (2, 2, "terminated is 2, expected True or False"), (2, "False", "terminated is 'False'"),
        (2, np.nan, "terminated is nan"), (2, np.array([False]), "terminated is array"),
        (3, None, "truncated is None"), (4, None, "info is a NoneType, expected a dict"),
    ],
)  # fmt: skip
def test_what_a_step_returns_is_checked_at_every_step(late: int, place: int, value: Any, words: str) -> None:
    class Late(Odd):
        def step(self, action: Any) -> Any:
            self.t += 1
            found: list[Any] = [np.zeros(2, np.float32), 0.0, False, False, {}]
            if self.t > late:
                found[place] = value
            return tuple(found)

    with pytest.raises(EnvironmentFault, match=f"at step {late + 1} does not follow.*{words}"):
        tightrope.PPO(Late, **SMALL).learn(64)


@pytest.mark.parametrize("kind", [bool, np.bool_, int, float, np.int8])
def test_flags_may_be_any_kind_of_0_and_1(kind: Any) -> None:
    class Short(Odd):
        def step(self, action: Any) -> Any:
            self.t += 1
            return np.zeros(2, np.float32), np.float32(1), kind(self.t % 4 == 0), kind(0), {}

    agent = tightrope.PPO(Short, **SMALL)
    assert sum(len(update.episodes) for update in agent.iterate(64)) == 16


@pytest.mark.parametrize(
    ("place", "value"), [(1, ["1", "2"]), (2, [2, 0]), (2, ["False", "x"]), (3, [None, None]), (1, [1j, 0])]
)
def test_what_a_vector_step_returns_is_checked_at_every_step(place: int, value: Any) -> None:
    class Late(gym.vector.SyncVectorEnv):
        count = 0

        def step(self, actions: Any) -> Any:
            self.count += 1
            found = list(super().step(actions))
            if self.count > 5:
                found[place] = np.array(value)
            return tuple(found)

    vector = Late([lambda: Odd(ended=False)] * 2)
    with pytest.raises(EnvironmentFault, match="expected numbers and two arrays of True and False"):
        tightrope.PPO(vector, **SMALL).learn(64)


def test_a_reward_beyond_float32() -> None:
    with pytest.raises(BadNumbers, match=r"reward = 1e\+300 at step 4 .*at most 3.4e\+38"):
        tightrope.PPO(lambda: Odd(reward=1e300), **SMALL).learn(64)


def test_a_reward_beyond_float32_restarts_its_environment_where_that_is_asked_for() -> None:
    """The message names --on-env-fault restart, so that has to serve this fault too."""
    agent = tightrope.PPO(lambda: Odd(reward=1e300), **SMALL, on_env_fault="restart", max_env_restarts=100)
    agent.learn(64)
    assert agent.environments.restarts > 0


# ------------------------------------------------------------------------------------------------ run folders


@pytest.fixture
def pole(tmp_path: Path) -> Path:
    agent = tightrope.PPO("CartPole-v1", total_steps=64, evaluate_every=None, **SMALL)
    train(agent.settings, run_dir=tmp_path / "pole")
    return tmp_path / "pole"


def test_a_budget_below_the_steps_that_are_done(pole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (pole / "settings.json").read_bytes()
    with pytest.raises(
        ValueError, match="has done 64 steps; expected total_steps of at least as many, got 32"
    ):
        resume(pole, total_steps=32)
    assert main(["resume", str(pole), "--total-steps", "32"]) == 2
    assert "has done 64 steps" in capsys.readouterr().err
    assert (pole / "settings.json").read_bytes() == before


@pytest.mark.parametrize("every", [None, 0.5])
def test_a_run_folder_that_goes_away_ends_the_run_and_is_not_made_again(
    tmp_path: Path, every: float | None
) -> None:
    agent = tightrope.PPO(
        "CartPole-v1", total_steps=128, evaluate_every=every, checkpoint_every=None, **SMALL
    )
    path, moved = tmp_path / "pole", tmp_path / "elsewhere"

    def rename(event: Any) -> None:
        if isinstance(event, Updated) and path.exists():
            path.rename(moved)

    with pytest.raises(
        CannotWrite, match="pole cannot be written .the run folder is gone.*give it its name back"
    ):
        train(agent.settings, run_dir=path, listeners=[rename])
    assert not path.exists()
    assert (moved / "metrics.jsonl").stat().st_size > 0


@pytest.mark.parametrize(
    ("stem", "name", "change", "words"),
    [
        ("policy", "actor.0.weight", lambda x: x * np.nan, "actor.0.weight holds nan"),
        ("policy", "critic.0.bias", lambda x: x + np.inf, "critic.0.bias holds inf"),
        ("policy", "actor.0.weight", lambda x: x.double(), "is float64 .64, 4., expected float32"),
        ("policy", "actor.0.weight", lambda x: x.long(), "is int64"),
        ("optimiser", "0.exp_avg_sq", lambda x: -x - 1, "0.exp_avg_sq of the optimiser holds -"),
        ("optimiser", "0.exp_avg", lambda x: x.double(), "0.exp_avg of the optimiser is float64"),
        ("optimiser", "0.step", lambda x: x * np.nan, "0.step of the optimiser holds nan"),
        ("normalisers", "observations.mean", lambda x: x * np.nan, "observations.mean holds nan"),
        ("normalisers", "observations.variance", lambda x: -x - 1, "observations.variance holds -"),
    ],
)
def test_numbers_that_no_run_can_have_saved(
    pole: Path, stem: str, name: str, change: Any, words: str
) -> None:
    """A manifest proves no honesty: anybody can write one."""
    for folder in pole.glob("checkpoints/step-*"):
        tensors, state = checkpoint.load(folder)
        tensors[stem][name] = change(tensors[stem][name])
        checkpoint.save(folder, tensors, state)
    for read in (tightrope.load, evaluate_run, lambda path: resume(path, total_steps=96)):
        with pytest.raises(ValueError, match=words):
            read(pole)


@pytest.mark.parametrize(
    "values",
    [
        {"steps": -5}, {"steps": 2**63}, {"rollbacks": 10**310}, {"environment_restarts": -1},
        {"kl_beta": "nan"}, {"finished_episodes": {"longest": 10**310}},
        {"finished_episodes": {"newest": [["nan", 3]], "successes": [], "longest": 3}},
    ],
)  # fmt: skip
def test_counts_that_no_run_can_have(pole: Path, values: dict[str, Any]) -> None:
    for folder in pole.glob("checkpoints/step-*"):
        tensors, state = checkpoint.load(folder)
        checkpoint.save(folder, tensors, {**state, **values})
    for read in (tightrope.load, lambda path: resume(path, total_steps=96)):
        with pytest.raises(checkpoint.CheckpointError, match="does not hold what belongs there"):
            read(pole)


class Named(gym.Env):
    """A Dict observation under two names."""

    action_space = spaces.Discrete(2)

    def __init__(self, *names: str, choices: int = 2) -> None:
        self.observation_space = spaces.Dict({name: spaces.Box(-1, 1, (1,)) for name in names})
        self.action_space = spaces.Discrete(choices)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        return self.observation_space.sample(), 0.0, True, False, {}


def test_a_policy_is_not_loaded_for_other_spaces(tmp_path: Path) -> None:
    agent = tightrope.PPO(lambda: Named("speed", "angle"), **SMALL)
    agent.save(tmp_path / "saved")
    tightrope.load(tmp_path / "saved", env=lambda: Named("speed", "angle")).close()
    with pytest.raises(
        ValueError, match=r"trained on observations \[.*'angle'.*\]; this environment has \[.*'bb'"
    ):
        tightrope.load(tmp_path / "saved", env=lambda: Named("zz", "bb"))
    with pytest.raises(
        ValueError, match=r"trained on actions \['Discrete\[2\]'\]; this environment has \['Discrete\[3"
    ):
        tightrope.load(tmp_path / "saved", env=lambda: Named("speed", "angle", choices=3))


@pytest.mark.parametrize(
    ("kind", "settings"), [("sft", SFTSettings()), ("reward", RewardSettings()), ("align", AlignSettings())]
)
def test_a_run_of_another_command_is_named_with_what_reads_it(
    tmp_path: Path, pole: Path, kind: str, settings: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    """A user who reads "damaged" may delete a good run."""
    path = tmp_path / "run"
    Run.create(path, settings.to_json(), kind).close()
    words = f"is a run of tightrope {kind}, expected one of tightrope train. It is whole: use tightrope"
    for read in (evaluate_run, tightrope.load, resume):
        with pytest.raises(ValueError, match=words):
            read(path)
    assert main(["evaluate", str(path), "--json"]) == 2
    assert words in capsys.readouterr().err
    for read in (sample_run, resume_align, resume_sft):
        with pytest.raises(
            ValueError, match="is a run of tightrope train, expected one of tightrope (align|sft)"
        ):
            read(pole)
    assert json.loads((path / "settings.json").read_text())


# ------------------------------------------------------------------------------------------ the command line

TASKS = """
import os
import gymnasium as gym, numpy as np

class Task(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (2,))
    action_space = gym.spaces.Discrete(2)
    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}
    def step(self, action):
        return np.zeros(2, np.float32), 0.0, True, False, {}

class Constructor(Task):
    def __init__(self, **_):
        raise KeyError("asset")

class Close(Task):
    def close(self):
        raise OSError("it broke")

class Prints(Task):
    def step(self, action):
        print("from Python")
        os.write(1, b"from C\\n")
        return super().step(action)

for kind in (Constructor, Close, Prints):
    gym.register(f"refused/{kind.__name__}-v0", entry_point=kind, max_episode_steps=10)
"""


def command(folder: Path, task: str, *more: str) -> subprocess.CompletedProcess[str]:
    """``tightrope train`` on one of TASKS, in a process of its own."""
    (folder / "tasks.py").write_text(TASKS)
    small = ["--total-steps", "64", "--num-steps", "16", "--minibatch-size", "16", "--evaluate-every", "none"]
    words = ["train", f"refused/{task}-v0", "--env-module", "tasks.py", *small, "--engine", "torch", *more]
    return subprocess.run(
        [sys.executable, "-m", "tightrope", *words], cwd=folder, capture_output=True, text=True, timeout=300
    )


@pytest.mark.parametrize("backend", ["serial", "workers"])
@pytest.mark.parametrize(
    ("task", "words"),
    [
        ("Constructor", "Making environment 0 raised KeyError: 'asset'"),
        ("Close", "Closing environment 0 raised OSError"),
    ],
)
def test_code_of_a_task_that_raises_outside_its_episodes(
    tmp_path: Path, task: str, words: str, backend: str
) -> None:
    ended = command(tmp_path, task, "--vector-backend", backend)
    assert ended.returncode == 2
    assert f"tightrope: {words}" in ended.stderr
    assert 'File "' in ended.stderr  # where, in the task's own code


@pytest.mark.parametrize("backend", ["serial", "workers"])
def test_what_a_task_prints_does_not_reach_the_json(tmp_path: Path, backend: str) -> None:
    ended = command(tmp_path, "Prints", "--vector-backend", backend, "--json")
    assert (ended.returncode, json.loads(ended.stdout)["steps"]) == (0, 64), ended.stderr
    assert "from Python" in ended.stderr
    assert "from C" in ended.stderr


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--env-module", ""], "--env-module is empty"),
        (["--settings", ""], "--settings is empty"),
        (["--run-dir", ""], "run_dir is empty"),
        (["--num-envs", "1e308", "--dry-run"], "num_envs is a number of more than 30 digits"),
        (["--env-timeout", "1e308"], r"env_timeout is 1e+308; expected 0 < x <= 1e+09"),
        (["--adam-eps", "1e308"], "adam_eps is 1e+308; expected 0 < x <= 1"),
        (["--evaluate-every", "5e-324"], "evaluate_every is 5e-324; expected a size"),
        (["--num-epochs", "1e-400"], "'1e-400' is not a whole number"),
        (["--num-epochs", "1e999999999"], "'1e999999999' is not a whole number"),
        (["--num-steps", "1e9"], "Choose a smaller num_envs or num_steps"),
        (["--hidden", "1e6", "1e6"], "Choose a smaller hidden"),
    ],
)
def test_empty_words_and_numbers_without_a_meaning(
    flags: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["train", "CartPole-v1", "--total-steps", "64", "--engine", "torch", *flags]) == 2
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
