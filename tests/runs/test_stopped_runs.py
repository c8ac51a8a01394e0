"""A signal saves a run as it was after its newest update; the resumed run ends like an uninterrupted one."""

from __future__ import annotations

import os
import pkgutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from control.test_resume import Walk, assert_same_end, settings_for, walk
from language.test_align_resume import GIVEN, PROMPTS, SMALL, letters
from language.test_align_resume import assert_same_end as assert_same_alignment
from language.test_supervised import FAST, STAGES, same_end
from language.test_supervised import rows_of as supervised_rows
from language.tiny import saved, tiny_llama

import tightrope
from tightrope.cli.main import main
from tightrope.control import train
from tightrope.control.environments.faults import EnvironmentFault
from tightrope.language.alignment.align import align, resume_align
from tightrope.language.reward.call import RewardError
from tightrope.runs import checkpoint, signals
from tightrope.runs.checkpoint import step_of
from tightrope.runs.run import Run
from tightrope.training import parameters
from tightrope.training.events import Message, Updated


def signal_in(patch: Any, path: str, call: int, number: int = signal.SIGINT) -> None:
    """This process gets a signal inside the ``call``-th call of a function."""
    owner, name = path.rsplit(".", 1)
    place = pkgutil.resolve_name(owner)
    real, count = getattr(place, name), 0

    def wrapped(*arguments: Any, **keywords: Any) -> Any:
        nonlocal count
        count += 1
        if count == call:
            os.kill(os.getpid(), number)
        return real(*arguments, **keywords)

    patch.setattr(place, name, wrapped)


def steps_of(run: Path) -> list[int]:
    """Of the checkpoints, without that of the first weights."""
    steps = [step_of(folder) for folder in (run / "checkpoints").iterdir()]
    return sorted(step for step in steps if step)


# ------------------------------------------------------------------------------------------------- control

POOL = "tightrope.control.environments.pool.EnvironmentPool"
# where the signal comes, in which call, and the step that is saved; an update is 100 steps
PHASES = {
    "collecting": (f"{POOL}.receive", 60, 200),
    "advantages": ("tightrope.control.agent.to_batch", 3, 300),
    "updating": ("tightrope.algorithms.descent.check_first_ratios", 3, 300),
    "statistics": ("tightrope.control.policy.normalise.Normalisers.update", 3, 300),
    "evaluating": ("tightrope.control.train.evaluate_agent", 1, 300),
    "the best policy": ("tightrope.control.agent.Agent.save", 1, 300),
    "recording": ("tightrope.runs.run.Run.record", 3, 300),
    "saving": ("tightrope.runs.checkpoint.write_file", 8, 200),
    "the last evaluation": ("tightrope.control.train.evaluate_agent", 3, 600),
}
EVERY = {"engine": "torch", "checkpoint_every": 1 / 6, "keep_checkpoints": None}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole") / "run"
    train.train(settings_for("CartPole-v1", **EVERY), run_dir=folder)
    return folder


@pytest.mark.parametrize("phase", PHASES)
def test_a_signal_in_every_phase(tmp_path, monkeypatch, whole, phase):
    path, call, step = PHASES[phase]
    run = tmp_path / "run"
    with monkeypatch.context() as patch, pytest.raises(signals.Stopped) as caught:
        signal_in(patch, path, call, signal.SIGTERM)
        train.train(settings_for("CartPole-v1", **EVERY), run_dir=run)
    assert caught.value.code == 143 and max(steps_of(run)) == step
    train.resume(run)
    assert_same_end(whole, run)


@pytest.mark.parametrize("phase", ["updating", "evaluating", "recording"])
def test_a_boundary_off_the_grid_is_saved_with_the_state_of_the_environments(tmp_path, monkeypatch, phase):
    path, call, step = PHASES[phase]
    settings = settings_for(walk, engine="torch", checkpoint_every=None)
    train.train(settings, run_dir=tmp_path / "whole", env=walk)
    run = tmp_path / "run"
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        signal_in(patch, path, call)
        train.train(settings, run_dir=run, env=walk)
    assert steps_of(run) == [step]
    train.resume(run, env=walk)
    assert_same_end(tmp_path / "whole", run)


def test_the_command_says_where_it_is_saved(tmp_path, monkeypatch, capsys):
    run = tmp_path / "run"
    words = ["train", "CartPole-v1", "--total-steps", "600", "--num-envs", "4", "--num-steps", "25"]
    words += ["--minibatch-size", "50", "--engine", "torch", "--checkpoint-every", "none"]
    with monkeypatch.context() as patch:
        signal_in(patch, "tightrope.control.rollout.collector.Collector.collect", 3)
        assert main([*words, "--run-dir", str(run)]) == 130
    said = capsys.readouterr().err
    folder = run / "checkpoints" / "step-000000000200"
    end = f"Stopped by SIGINT at step 200. It is saved in {folder}; what was under way is repeated."
    end += f" Go on with:\n  tightrope resume {run}\n"
    assert said.endswith(end)
    assert main(["resume", str(run), "--quiet"]) == 0


@pytest.mark.parametrize("known", [False, True])
def test_a_long_update_is_undone(tmp_path, monkeypatch, known):
    """How long it takes is not known in the first one, and known to be too long later."""
    run, settings = tmp_path / "run", settings_for("CartPole-v1", **EVERY)
    monkeypatch.setattr(parameters, "COPY_FROM", 0.0)
    monkeypatch.setattr(signals, "PATIENCE", -1.0)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        signal_in(patch, "tightrope.algorithms.descent.CheckedSteps.take", 11 if known else 3)
        train.train(settings, run_dir=run)
    if known:
        assert steps_of(run) == [100, 200]
    else:
        assert not (run / "checkpoints").exists()


@pytest.mark.parametrize("engine", ["torch", "fused"])
def test_an_undone_update_leaves_the_agent_as_it_was(monkeypatch, engine):
    inside = {
        "torch": "algorithms.descent.CheckedSteps.take",
        "fused": "control.engine.compiled_engine._Run._call",
    }
    monkeypatch.setattr(parameters, "COPY_FROM", 0.0)
    monkeypatch.setattr(signals, "PATIENCE", -1.0)
    how = {**SHORT, "engine": engine, "num_epochs": 4}
    agent = tightrope.PPO("CartPole-v1", notify=lambda text: None, **how)
    for first in (True, False):
        tensors, state = agent.snapshot()
        before = {name: x.clone() for name, x in tensors["policy"].items()}
        moments = {name: x.clone() for name, x in tensors["optimiser"].items()}
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            signal_in(patch, f"tightrope.{inside[engine]}", 3)
            agent.learn(100)
        tensors, after = agent.snapshot()
        assert state == after
        assert all(torch.equal(x, tensors["policy"][name]) for name, x in before.items())
        if first:
            assert not any(x.any() for x in tensors["optimiser"].values())
        else:
            assert all(torch.equal(x, tensors["optimiser"][name]) for name, x in moments.items())
        agent.learn(100)
    agent.close()


def test_a_checkpoint_by_the_clock(tmp_path, monkeypatch):
    """Where the clock saves changes no bit; without a clock there is only the last one."""
    how = {"engine": "torch", "checkpoint_every": None, "keep_checkpoints": None}
    for name, minutes in (("clock", 1e-9), ("none", None)):
        settings = settings_for(walk, checkpoint_minutes=minutes, **how)
        train.train(settings, run_dir=tmp_path / name, env=walk)
    assert steps_of(tmp_path / "clock") == [100, 200, 300, 400, 500, 600]
    assert steps_of(tmp_path / "none") == [600]
    first, second = (Run.open(tmp_path / name).newest().tensors["policy"] for name in ("clock", "none"))
    assert all(torch.equal(x, second[name]) for name, x in first.items())
    assert settings.with_values(checkpoint_minutes=10).checkpoint_minutes == 10


def test_a_second_signal_saves_nothing(tmp_path, monkeypatch):
    run = tmp_path / "run"
    with pytest.raises(signals.Stopped) as caught:
        signal_in(monkeypatch, "tightrope.algorithms.descent.check_first_ratios", 3)
        signal_in(monkeypatch, "tightrope.control.policy.normalise.Normalisers.update", 3, signal.SIGTERM)
        train.train(settings_for("CartPole-v1", engine="torch", checkpoint_every=None), run_dir=run)
    assert caught.value.code == 143 and not (run / "checkpoints").exists()


def test_a_full_disk_is_told_and_the_run_still_ends(tmp_path, monkeypatch):
    said: list[str] = []

    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tightrope.runs.checkpoint.write_file", full)
    signal_in(monkeypatch, f"{POOL}.receive", 60)
    settings = settings_for("CartPole-v1", engine="torch", checkpoint_every=None)
    with pytest.raises(signals.Stopped):
        train.train(settings, run_dir=tmp_path / "run", listeners=[lambda event: said.append(str(event))])
    assert any(line.startswith("warning: Step 200 is not saved: ") for line in said)


# ------------------------------------------------------------------------------------ learn without a folder

SHORT = {
    "num_envs": 2, "num_steps": 50, "minibatch_size": 50, "num_epochs": 2, "hidden": (8,), "seed": 1,
    "engine": "torch", "threads": 1, "normalise_observations": False,
}  # fmt: skip


def assert_same_agents(a: tightrope.PPO, b: tightrope.PPO) -> None:
    (tensors, state), (others, other) = a.snapshot(), b.snapshot()
    assert state == other
    assert all(torch.equal(x, others[group][name]) for group in tensors for name, x in tensors[group].items())


@pytest.mark.parametrize("backend", ["serial", "workers"])
def test_ctrl_c_in_learn_leaves_the_agent_at_its_last_update(monkeypatch, backend):
    how = {**SHORT, "vector_backend": backend, "num_workers": 2 if backend == "workers" else None}
    how |= {"checkpoint_every": None, "learning_rate_schedule": "constant"}
    agent, other = (tightrope.PPO("CartPole-v1", notify=lambda text: None, **how) for _ in range(2))
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        signal_in(patch, f"{POOL}.receive", 77)
        agent.learn(1000)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    other.learn(100)
    assert_same_agents(agent, other)
    assert agent.predict(np.zeros(4, np.float32))[0] in (0, 1)
    for one in (agent, other):
        one.learn(200)
        one.close()
    assert_same_agents(agent, other)


def test_ctrl_c_in_an_update_of_learn_finishes_it(monkeypatch):
    agent = tightrope.PPO("CartPole-v1", notify=lambda text: None, **SHORT)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        signal_in(patch, "tightrope.algorithms.descent.CheckedSteps.take", 6)
        agent.learn(1000)
    agent.close()
    assert agent.steps == 200


def test_a_handler_of_the_program_stays_its_own():
    seen: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: seen.append(number))
    try:

        class Sends(Walk):
            def step(self, action: int) -> Any:
                if not seen:
                    os.kill(os.getpid(), signal.SIGINT)
                return super().step(action)

        tightrope.PPO(Sends, notify=lambda text: None, **SHORT).learn(100).close()
    finally:
        signal.signal(signal.SIGINT, before)
    assert seen == [signal.SIGINT]


# -------------------------------------------------------------------------- what an environment may do to it


class Interrupts(Walk):
    """Raises KeyboardInterrupt of its own."""

    def step(self, action: int) -> Any:
        if self.resets > 1:
            raise KeyboardInterrupt("not by a person")
        return super().step(action)


class InterruptsLater(Walk):
    """Fails, and raises KeyboardInterrupt when it is closed after that."""

    def step(self, action: int) -> Any:
        raise ValueError("fails")

    def close(self) -> None:
        raise KeyboardInterrupt("at the end")


class Takes(Walk):
    """Replaces the handlers of signals, and is then sent one."""

    def reset(self, **given: Any) -> Any:
        for number in signals.BOTH:
            signal.signal(number, signal.SIG_IGN)
        return super().reset(**given)


@pytest.mark.parametrize("backend", ["serial", "workers"])
def test_a_keyboard_interrupt_of_an_environment_is_its_fault(tmp_path, backend):
    workers = {"vector_backend": backend, "num_workers": 2 if backend == "workers" else None}
    settings = settings_for(Interrupts, engine="torch", **workers)
    with pytest.raises(EnvironmentFault, match="raised KeyboardInterrupt: not by a person"):
        train.train(settings, run_dir=tmp_path / "run", env=Interrupts)
    with pytest.raises(EnvironmentFault, match="raised KeyboardInterrupt: not by a person"):
        tightrope.PPO(Interrupts, notify=lambda text: None, **SHORT).learn(1000)


@pytest.mark.parametrize("backend", ["serial", "workers"])
def test_nor_does_one_in_close_hide_the_fault_before_it(tmp_path, backend):
    workers = {"vector_backend": backend, "num_workers": 2 if backend == "workers" else None}
    settings = settings_for(Walk, engine="torch", on_env_fault="restart", max_env_restarts=1, **workers)
    with pytest.raises(EnvironmentFault):
        train.train(settings, run_dir=tmp_path / "run", env=InterruptsLater)


def test_an_environment_that_turns_the_signal_into_another_error(tmp_path):
    class Turns(Walk):
        steps = 0

        def step(self, action: int) -> Any:
            Turns.steps += 1
            try:
                if Turns.steps == 130:
                    os.kill(os.getpid(), signal.SIGINT)
            except BaseException as error:
                raise RuntimeError("something else") from error
            return super().step(action)

    with pytest.raises(signals.Stopped):
        train.train(settings_for(Turns, engine="torch"), run_dir=tmp_path / "run", env=Turns)
    assert steps_of(tmp_path / "run") == [100]


def test_handlers_that_an_environment_takes_are_put_back_and_told_once(tmp_path, monkeypatch):
    said: list[str] = []

    def listen(event: Any) -> None:
        if isinstance(event, Message) and "handler" in event.text:
            said.append(event.text)
        if isinstance(event, Updated) and event.step == 300:
            os.kill(os.getpid(), signal.SIGTERM)

    run = tmp_path / "run"
    before = [signal.getsignal(number) for number in signals.BOTH]
    with pytest.raises(signals.Stopped):
        settings = settings_for(Takes, engine="torch", checkpoint_every=0.1)
        train.train(settings, run_dir=run, env=Takes, listeners=[listen])
    assert len(said) == 1 and "SIGINT and SIGTERM" in said[0]
    assert max(steps_of(run)) == 300
    assert [signal.getsignal(number) for number in signals.BOTH] == before


# ------------------------------------------------------------------------------------------------ language


@pytest.fixture(scope="module")
def values(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("model")
    texts = folder / "texts.txt"
    texts.write_text("abc.\ndef.\nghi.\n")
    model = saved(folder / "llama", tiny_llama(2))
    return {**SMALL, "model": model, "ptx_data": str(texts), "checkpoint_every": None}


ALIGN_PHASES = {
    "gold": ("tightrope.language.alignment.iteration.respond", 2, 24),
    "sampling": ("tightrope.language.alignment.iteration.gather", 4, 24),
    "scores": ("tightrope.language.alignment.iteration.rewards_of", 4, 24),
    "updating": ("tightrope.algorithms.descent.check_first_ratios", 4, 32),
    "recording": ("tightrope.runs.run.Run.record_samples", 4, 32),
}


@pytest.fixture(scope="module")
def aligned(tmp_path_factory: pytest.TempPathFactory, values: dict[str, Any]) -> Path:
    return align(run_dir=tmp_path_factory.mktemp("aligned") / "run", **GIVEN, **values).path


@pytest.mark.parametrize("phase", ALIGN_PHASES)
def test_a_signal_in_every_phase_of_an_alignment(tmp_path, monkeypatch, values, aligned, phase):
    path, call, step = ALIGN_PHASES[phase]
    with monkeypatch.context() as patch, pytest.raises(signals.Stopped):
        signal_in(patch, path, call)
        align(run_dir=tmp_path / "run", **GIVEN, **values)
    assert steps_of(tmp_path / "run") == [step]
    resume_align(tmp_path / "run", **GIVEN)
    assert_same_alignment(aligned, tmp_path / "run")


def test_a_long_update_of_adapters_is_undone(tmp_path, monkeypatch, values, aligned):
    monkeypatch.setattr(parameters, "COPY_FROM", 0.0)
    with monkeypatch.context() as patch, pytest.raises(signals.Stopped):
        patch.setattr(signals, "PATIENCE", -1.0)
        signal_in(patch, "tightrope.algorithms.descent.CheckedSteps.take", 6 * 4 + 3)
        align(run_dir=tmp_path / "run", **GIVEN, **values)
    (step,) = steps_of(tmp_path / "run")
    assert 0 < step < 56
    resume_align(tmp_path / "run", **GIVEN)
    assert_same_alignment(aligned, tmp_path / "run")


def test_with_every_weight_tuned_the_update_is_waited_for_and_it_is_told(tmp_path, monkeypatch, capsys):
    model = saved(tmp_path / "llama", tiny_llama(2))
    how = {
        "model": model, "tune": "full", "total_episodes": 24, "batch_size": 8, "minibatch_size": 4,
        "max_new_tokens": 4, "threads": 1, "learning_rate": 1e-5,
    }  # fmt: skip
    monkeypatch.setattr(signals, "PATIENCE", -1.0)
    signal_in(monkeypatch, "tightrope.algorithms.descent.check_first_ratios", 1)
    with pytest.raises(signals.Stopped):
        align(run_dir=tmp_path / "run", prompts=PROMPTS, reward=letters, **how)
    assert steps_of(tmp_path / "run") == [8]
    assert "SIGINT: the update under way is finished first. A second signal" in capsys.readouterr().err


@pytest.mark.parametrize("timeout", [60.0, None])
def test_a_keyboard_interrupt_of_a_reward_function_is_its_fault(tmp_path, values, timeout):
    def interrupts(completions: list[str], **_: Any) -> list[float]:
        raise KeyboardInterrupt("not by a person")

    given = {"prompts": PROMPTS, "reward": interrupts, "reward_timeout": timeout}
    with pytest.raises(RewardError, match="raised KeyboardInterrupt: not by a person"):
        align(run_dir=tmp_path / "run", **given, **values)


SUPERVISED_PHASES = {
    "gradient": ("tightrope.language.supervised.fit.micro_batches", 6, 5),
    "step": ("tightrope.algorithms.descent.CheckedSteps.take", 5, 5),
    "halted": ("tightrope.algorithms.descent.CheckedSteps.halted", 5, 5),
    "recording": ("tightrope.runs.run.Run.record", 6, 5),
    "evaluating": ("tightrope.language.supervised.EVALUATION", 2, 3),
}


@pytest.fixture(scope="module", params=STAGES)
def supervised(request: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Any, Path]:
    """The stage, its settings, and a whole run."""
    folder = tmp_path_factory.mktemp(request.param)
    train_stage, _, kind, data = STAGES[request.param]
    model = saved(folder / "llama")
    settings = kind(model=model, held_out=0.25, checkpoint_every=None, **FAST)
    train_stage(settings, data=data, run_dir=folder / "whole")
    return request.param, settings, folder / "whole"


@pytest.mark.parametrize("phase", SUPERVISED_PHASES)
def test_a_signal_in_every_phase_of_a_supervised_run(tmp_path, monkeypatch, supervised, phase):
    stage, settings, whole = supervised
    begin, resume, _, data = STAGES[stage]
    path, call, step = SUPERVISED_PHASES[phase]
    path = path.replace("EVALUATION", {"sft": "sft.mean_loss", "reward": "preferences.calibration"}[stage])
    run = tmp_path / "run"
    with monkeypatch.context() as patch, pytest.raises(signals.Stopped):
        signal_in(patch, path, call)
        begin(settings, data=data, run_dir=run)
    assert steps_of(run) == [step]
    resume(run, data=data)
    assert supervised_rows(run) == supervised_rows(whole)
    assert same_end(whole, run)


def test_an_update_that_does_not_belong_there_is_refused(tmp_path, monkeypatch):
    """Whoever signs a checkpoint again can write anything."""
    run = tmp_path / "run"
    with monkeypatch.context() as patch, pytest.raises(signals.Stopped):
        signal_in(patch, "tightrope.control.train.evaluate_agent", 1)
        train.train(settings_for("CartPole-v1", engine="torch"), run_dir=run)
    folder, tensors, state = Run.open(run).newest()
    good = state["pending"]
    assert good["step"] == 300
    for wrong in ({}, [], 3, {**good, "step": "x"}, {**good, "episodes": [1]}, {**good, "more": 1}):
        checkpoint.save(folder, tensors, {**state, "pending": wrong})
        with pytest.raises(checkpoint.CheckpointError, match="does not hold what belongs there"):
            train.resume(run)
