"""Copies in this process and in workers: the same transitions, clear faults, no leftover process."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import chain
import gymnasium as gym
import numpy as np
import pytest

from tightrope.control.environments import processes as workers
from tightrope.control.environments.faults import EnvironmentFault, FaultPolicy
from tightrope.control.environments.make import make_environments

COUNT = 40


@pytest.mark.parametrize("num_workers", [1, 2, 3, 5])
def test_any_number_of_workers_delivers_the_scripted_transitions(num_workers):
    with make_environments(chain.Chain, 5, backend="workers", num_workers=num_workers) as environments:
        assert (environments.backend, environments.num_workers) == ("workers", num_workers)
        assert environments._group is None  # no copy lives in this process
        found = chain.transitions(environments, COUNT)
        assert found == chain.expected_transitions(5, COUNT)
        assert chain.transitions(environments, COUNT) == found  # a second reset starts over


def test_workers_step_random_environments_to_the_same_bits():
    traces = []
    for num_workers in (1, 2, 3):
        with make_environments("Acrobot-v1", 3, backend="workers", num_workers=num_workers) as environments:
            inputs, _ = environments.reset(7)
            trace = [inputs["flat"]]
            for t in range(520):  # past the time limit: the unseeded resets must agree too
                actions = np.full((3, 1), t // 7 % 3, np.float32)
                trace.append(environments.step(actions).inputs["flat"])
            traces.append(np.stack(trace))
    np.testing.assert_array_equal(traces[0], traces[1])
    np.testing.assert_array_equal(traces[0], traces[2])
    assert not np.array_equal(traces[0][:, 0], traces[0][:, 1])  # each copy has its own seed


def test_copy_i_is_seeded_with_seed_plus_i():
    with make_environments("Acrobot-v1", 3, backend="serial") as environments:
        inputs, _ = environments.reset(11)
    for i in range(3):
        observation, _ = gym.make("Acrobot-v1").reset(seed=11 + i)
        np.testing.assert_array_equal(inputs["flat"][i], observation)


@pytest.mark.parametrize("mask", ["info", "method", "observation"])
@pytest.mark.parametrize("num_workers", [1, 2])
def test_action_masks_belong_to_the_observation_that_comes_with_them(mask, num_workers):
    with make_environments(
        lambda: chain.Chain(mask), 3, backend="workers", num_workers=num_workers
    ) as environments:
        inputs, masks = environments.reset(chain.BASE_SEED)
        for _ in range(30):
            forbidden = inputs["flat"][:, 1:].sum(axis=1) % 3
            np.testing.assert_array_equal(masks, np.arange(3) != forbidden[:, None])
            step = environments.step(chain.action_for(inputs["flat"]))
            inputs, masks = step.inputs, step.action_mask
        assert chain.transitions(environments, COUNT) == chain.expected_transitions(3, COUNT)


def test_what_a_step_returned_is_not_overwritten_by_the_next():
    for num_workers in (1, 2):
        with make_environments(chain.Chain, 2, backend="workers", num_workers=num_workers) as environments:
            inputs, _ = environments.reset(chain.BASE_SEED)
            first = environments.step(chain.action_for(inputs["flat"]))
            kept = [first.inputs["flat"].copy(), first.rewards.copy(), first.terminated.copy()]
            step = first
            for _ in range(3):
                step = environments.step(chain.action_for(step.inputs["flat"]))
            assert not np.array_equal(step.rewards, first.rewards)
            pairs = zip((first.inputs["flat"], first.rewards, first.terminated), kept, strict=True)
            for now, before in pairs:
                np.testing.assert_array_equal(now, before)


class Broken(chain.Chain):
    """Breaks in one way after ``after`` steps of the copy with row 1."""

    def __init__(self, how: str, after: int = 0) -> None:
        super().__init__()
        self.how, self.after, self.count = how, after, 0

    def reset(self, **keywords):
        observation, info = super().reset(**keywords)
        if self.how == "reset returns the observation alone":
            return observation
        if self.how == "reset gives another shape":
            return observation[:2], info
        return observation, {"action_mask": np.zeros(3)} if self.how == "blocked mask" else info

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        self.count += 1
        if self.row != 1 or self.count <= self.after:
            return observation, reward, terminated, truncated, info
        if self.how == "raises":
            raise KeyError("the user's own mistake")
        if self.how == "dies":
            os._exit(7)
        if self.how == "hangs":
            time.sleep(60)
        return {
            "four values": (observation, reward, terminated, info),
            "reward is an array": (observation, np.ones(2), terminated, truncated, info),
            "reward is None": (observation, None, terminated, truncated, info),
            "flag is text": (observation, reward, "no", truncated, info),
            "shape changes": (np.zeros(4, np.float32), reward, terminated, truncated, info),
            "shape would broadcast": (np.zeros(1, np.float32), reward, terminated, truncated, info),
            "info is None": (observation, reward, terminated, truncated, None),
            "late mask": (observation, reward, terminated, truncated, {"action_mask": np.ones(3)}),
        }[self.how]


def run_broken(how: str, after: int = 0, num_workers: int = 1, timeout: float = 60.0) -> None:
    def factory():
        return Broken(how, after)

    with make_environments(
        factory, 2, backend="workers", num_workers=num_workers, policy=FaultPolicy(timeout=timeout)
    ) as environments:
        inputs, _ = environments.reset(chain.BASE_SEED)
        for _ in range(after + 2):
            inputs = environments.step(chain.action_for(inputs["flat"])).inputs


@pytest.mark.parametrize("num_workers", [1, 2])
@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("reset returns the observation alone", r"reset returned an array.*expected the pair.*old gym"),
        ("reset gives another shape", r"shape \(2,\), the space says \(3,\)"),
        ("four values", r"a tuple of 4 values, expected five"),
        ("reward is an array", "expected one number.*several rewards"),
        ("reward is None", "reward is None"),
        ("flag is text", "terminated is 'no'"),
        ("shape changes", r"shape \(4,\), the space says \(3,\)"),
        ("shape would broadcast", r"shape \(1,\), the space says \(3,\)"),
        ("info is None", "expected a dict"),
        ("blocked mask", "forbids every choice"),
        ("late mask", r"reset did not"),
    ],
)
def test_a_break_of_the_api_names_environment_step_and_what_came(how, message, num_workers):
    with pytest.raises(EnvironmentFault, match=rf"environment \d \(factory\) at step \d.*{message}"):
        run_broken(how, num_workers=num_workers)


def test_later_breaks_are_seen_too():
    for how, message in (("shape changes", r"\(4,\)"), ("reward is an array", "API"), ("four values", "API")):
        with pytest.raises(EnvironmentFault, match=message) as caught:
            run_broken(how, after=5)
        assert (caught.value.index, caught.value.step) == (1, 6)


@pytest.mark.parametrize("num_workers", [1, 2])
def test_an_environments_own_error_comes_with_its_traceback(num_workers):
    with pytest.raises(EnvironmentFault, match=r"raised KeyError: .the user's own mistake") as caught:
        run_broken("raises", after=3, num_workers=num_workers)
    assert (caught.value.index, caught.value.step) == (1, 4)
    assert "test_vector.py" in str(caught.value) and 'raise KeyError("the user' in str(caught.value)


def test_a_dead_worker_is_reported_with_its_exit_code():
    with pytest.raises(EnvironmentFault, match=r"environments from 1 on\) has died \(exit code 7\)"):
        run_broken("dies", after=2, num_workers=2)


def test_a_hanging_worker_is_reported_and_killed():
    begin = time.perf_counter()
    with pytest.raises(EnvironmentFault, match="has not answered for 1 s"):
        run_broken("hangs", after=2, num_workers=2, timeout=1.0)
    assert time.perf_counter() - begin < 10


def test_copies_that_fail_to_build_in_a_worker_close_the_others():
    built = []

    def factory():
        if built:
            raise OSError("only one licence")
        built.append(chain.Chain())
        return built[0]

    with pytest.raises(EnvironmentFault, match="Making environment 1 raised OSError: only one licence"):
        make_environments(factory, 2, backend="mixed", num_workers=2)
    assert built[0].closed


def alive(pid: int) -> bool:
    """Whether a process still runs (a zombie does not)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


SCRIPT = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may start us with it ignored
sys.path.insert(0, {here!r})
import chain
from tightrope.control.environments.make import make_environments
sets = [make_environments(chain.Chain, 3, backend="workers", num_workers=3) for _ in range(2)]
for environments in sets:
    environments.reset(100)
print(*[w._process.pid for e in sets for w in e._workers], flush=True)
{after}
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("how", ["killed", "forgotten", "interrupted"])
def test_no_worker_outlives_its_parent(how):
    after = "pass" if how == "forgotten" else "import time; time.sleep(60)"
    script = SCRIPT.format(here=str(Path(__file__).parent), after=after)  # without a __main__ guard
    pipe = subprocess.PIPE
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=pipe, stderr=pipe, text=True)
    pids = [int(word) for word in parent.stdout.readline().split()]
    assert len(pids) == 6
    if how != "forgotten":
        os.kill(parent.pid, signal.SIGKILL if how == "killed" else signal.SIGINT)
    parent.communicate(timeout=20)
    deadline = time.perf_counter() + 5
    while any(map(alive, pids)) and time.perf_counter() < deadline:
        time.sleep(0.02)
    assert not any(map(alive, pids))


def test_closing_twice_and_closing_what_was_made():
    made = []

    def factory():
        made.append(chain.Chain())
        return made[-1]

    environments = make_environments(factory, 3, backend="serial")
    environments.close()
    environments.close()
    assert len(made) == 3 and all(env.closed for env in made)


def test_a_factory_that_cannot_be_sent_to_a_worker_is_named(monkeypatch):
    """Where workers are spawned it is pickled; what it holds may not be."""
    context = multiprocessing.get_context("spawn")
    monkeypatch.setattr("tightrope.control.environments.pool.start_context", lambda: context)
    held = threading.Lock()

    def make():
        with held:
            return gym.make("CartPole-v1")

    with pytest.raises(ValueError, match="cannot be sent to a worker process .*lock.*vector_backend serial"):
        make_environments(make, 2, backend="workers", num_workers=2)


def test_workers_start_by_spawn_where_there_is_no_fork(monkeypatch):
    monkeypatch.setattr(workers.sys, "platform", "darwin")
    with make_environments("Acrobot-v1", 2, backend="workers", num_workers=2) as environments:
        environments.reset(3)
        spawned = [environments.step(np.full((2, 1), t % 3, np.float32)).inputs["flat"] for t in range(20)]
    monkeypatch.undo()
    with make_environments("Acrobot-v1", 2, backend="serial") as environments:
        environments.reset(3)
        serial = [environments.step(np.full((2, 1), t % 3, np.float32)).inputs["flat"] for t in range(20)]
    np.testing.assert_array_equal(spawned, serial)


def test_worker_code_does_not_need_torch():
    code = "import sys, tightrope.control.environments.make as e; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
