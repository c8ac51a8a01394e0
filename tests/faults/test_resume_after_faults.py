"""A run that recovered from faults still resumes exactly: the checkpoint contains their counts."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from control.test_resume import Walk, assert_same_end, killed, settings_for
from language.tiny import saved

from tightrope.algorithms.nonfinite import NonFiniteError
from tightrope.control import train
from tightrope.control.agent import Agent
from tightrope.control.environments import faults
from tightrope.language import align
from tightrope.language.alignment.align import resume_align
from tightrope.language.alignment.iteration import Trainer
from tightrope.runs.run import Run
from tightrope.training.events import Event, Updated


class Brittle(Walk):
    """Fails about once in 40 steps, at steps that depend on the bits of the run."""

    def step(self, action: int) -> Any:
        found = super().step(action)
        if int(abs(self.place) * 1e6) % 40 == 0:
            raise RuntimeError("the simulator broke")
        return found


class Sealed(Brittle):
    """The same without a state to save."""

    get_state = set_state = None  # type: ignore[assignment]

    def reset(self, **how: Any) -> Any:
        found = super().reset(**how)
        self.resets, self.trail = 0, np.zeros(3)
        return found


@pytest.mark.parametrize(("env", "workers"), [(Brittle, 1), (Brittle, 2), (Sealed, 1)])
def test_the_count_of_restarts_and_their_seeds_continue(tmp_path, monkeypatch, env, workers):
    monkeypatch.setattr(faults, "pause", lambda *_: 0.0)
    settings = settings_for(
        env, on_env_fault="restart", max_env_restarts=500, num_workers=workers, engine="torch"
    )
    train.train(settings, run_dir=tmp_path / "whole", env=env)
    hops = tmp_path / "hops"
    killed(settings, hops, monkeypatch, Agent, "_one_update", 4, env=env)
    killed(settings, hops, monkeypatch, Agent, "_one_update", 4, env=env)
    before = Run.open(hops).newest().state["environment_restarts"]
    train.resume(hops, env=env)
    assert_same_end(tmp_path / "whole", hops)
    after = Run.open(hops).newest().state["environment_restarts"]
    assert 0 < before < after
    rows = [json.loads(line) for line in (hops / "metrics.jsonl").read_text().splitlines()]
    assert sum(row.get("rollout/environment_restarts", 0.0) for row in rows) == after


def poison_control(patch: Any) -> None:
    """A NaN in the update of step 300 of a run without a rollback, and of step 500 of one with one."""
    real = Agent._one_update

    def poisoned(self: Agent, *arguments: Any, **more: Any) -> Any:
        if (self.steps, self.rollbacks) in ((300, 0), (500, 1)):
            raise NonFiniteError("The advantage is nan.")
        return real(self, *arguments, **more)

    patch.setattr(Agent, "_one_update", poisoned)


def test_rollbacks_of_a_control_run(tmp_path, monkeypatch):
    """Killed after the first one, before any checkpoint records it, and after one that is recorded."""
    poison_control(monkeypatch)
    settings = settings_for("CartPole-v1", engine="torch", max_rollbacks=2)
    train.train(settings, run_dir=tmp_path / "whole")
    hops = tmp_path / "hops"
    killed(settings, hops, monkeypatch, Agent, "_one_update", 6)
    assert Run.open(hops).newest().state["rollbacks"] == 0
    killed(settings, hops, monkeypatch, Agent, "_one_update", 6)
    assert Run.open(hops).newest().state["rollbacks"] == 1
    train.resume(hops)
    assert Run.open(hops).newest().state["rollbacks"] == 2
    assert_same_end(tmp_path / "whole", hops)
    steps = [json.loads(line)["step"] for line in (hops / "metrics.jsonl").read_text().splitlines()]
    assert steps == [100, 200, 300, 400, 500, 600, 600]  # the final evaluation is a row
    evaluated = [json.loads(line) for line in (hops / "metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in evaluated if "eval/episodes" in row] == [300, 500, 600]


def test_a_resumed_run_has_no_more_rollbacks_than_it_would_have_had(tmp_path, monkeypatch):
    poison_control(monkeypatch)
    settings = settings_for("CartPole-v1", engine="torch", max_rollbacks=1)
    with pytest.raises(NonFiniteError):
        train.train(settings, run_dir=tmp_path / "run")
    with pytest.raises(NonFiniteError):
        train.resume(tmp_path / "run")


def test_a_language_run_keeps_its_rollbacks_and_its_micro_batch(tmp_path, monkeypatch):
    real = Trainer._one_iteration

    def poisoned(self: Trainer, *arguments: Any) -> Any:
        if self.episodes == 12 and not self.rollbacks:
            raise NonFiniteError("The advantage is nan.")
        found = real(self, *arguments)
        if self.episodes == 8:
            self.micro_batch_size = 2  # as after memory ran out
        return found

    monkeypatch.setattr(Trainer, "_one_iteration", poisoned)
    given: dict[str, Any] = {"prompts": ["ab", "cd"], "reward": "length"}
    how = {
        "model": saved(tmp_path / "model"), "total_episodes": 24, "batch_size": 4, "minibatch_size": 4,
        "max_new_tokens": 4, "lora_rank": 2, "checkpoint_every": 0.3, "max_rollbacks": 1, "threads": 1,
    }  # fmt: skip
    align(**given, **how, run_dir=tmp_path / "whole")

    def die(event: Event) -> None:
        if isinstance(event, Updated) and event.step == 20:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        align(**given, **how, run_dir=tmp_path / "hops", listeners=[die])
    resume_align(tmp_path / "hops", **given)
    ends = [Run.open(tmp_path / name).newest() for name in ("whole", "hops")]
    for name in ("rollbacks", "micro_batch_size", "rng", "newest", "episodes"):
        first, second = (end.state[name] for end in ends)
        if name == "newest":
            first, second = ({k: v for k, v in x.items() if k[:5] != "time/"} for x in (first, second))
        assert first == second, name
    assert ends[0].state["rollbacks"] == 1 and ends[0].state["micro_batch_size"] == 2
    trained = [end.tensors["trained"] for end in ends]
    assert all((trained[0][name] == trained[1][name]).all() for name in trained[0])
