"""A fault of an environment is fully named and bounded in time, or survived by a restart."""

import contextlib
import json
import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

import tightrope
from tightrope.cli.main import main
from tightrope.control.environments.episode import TRAINING, episode_seed
from tightrope.control.environments.faults import EnvironmentFault, FaultPolicy, pause
from tightrope.control.environments.make import make_environments
from tightrope.control.environments.processes import STEP
from tightrope.control.resolve import resolve
from tightrope.control.rollout.collector import BadNumbers
from tightrope.control.train import resume, train
from tightrope.runs.checkpoint import step_of

SMALL = {"num_envs": 4, "num_steps": 16, "minibatch_size": 32, "num_epochs": 1, "seed": 5}
AT = 5


def seed_of(row, episode=0):
    return episode_seed(SMALL["seed"], TRAINING, row, episode)


class Frail(gym.Env):
    """The observation is the seed and the step; the first episode of copy ``row`` fails at step AT."""

    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self, how, row=3, always=False, length=40):
        self.how, self.row, self.always, self.length, self.mine, self.t = how, row, always, length, False, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.seed, self.mine = seed, self.always or seed in (SMALL["seed"] + self.row, seed_of(self.row))
            if self.how == "reset" and self.mine:
                raise OSError("no display")
        self.t = 0
        return np.array([seed or 0, 0, 0], np.float32), {}

    def step(self, action):
        self.t += 1
        observation, reward = np.array([0, self.t, int(action)], np.float32), 1.0
        if self.mine and self.t == AT:
            if self.how == "raise":
                raise RuntimeError("the simulator broke")
            if self.how == "leave":
                raise SystemExit(0)
            while self.how == "stubborn":
                with contextlib.suppress(Exception):  # like a simulator's client that reconnects
                    time.sleep(600)
            if self.how == "exit":
                os._exit(7)
            if self.how == "kill":
                os.kill(os.getpid(), signal.SIGKILL)
            if self.how == "hang":
                time.sleep(600)
            if self.how == "shape":
                observation = np.zeros(4, np.float32)
            if self.how == "nan":
                observation[1] = np.nan
            if self.how == "reward":
                reward = np.inf
            if self.how == "tuple":
                return observation, reward, False, {}
        return observation, reward, False, self.t == self.length, {}


@pytest.fixture
def agent_on():
    """Makes agents and always closes them."""
    made = []

    def make(*arguments, **more):
        made.append(make_agent(*arguments, **more))
        return made[-1]

    yield make
    for agent in made:
        agent.close()


def make_agent(how, backend="workers", **more):
    own = {name: more.pop(name) for name in ("row", "always", "length") if name in more}

    def frail():
        return Frail(how, **own)

    workers = {"num_workers": 2} if backend == "workers" else {}
    settings = {**SMALL, "vector_backend": backend, "engine": "torch", **workers, **more}
    return tightrope.PPO(frail, **settings)


def weights(agent):
    return torch.cat([p.detach().flatten().clone() for p in agent.policy.parameters()])


def children():
    """Child processes that still exist, including zombies."""
    return Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()


@pytest.fixture(autouse=True)
def nothing_is_left_behind():
    before, segments, threads = set(children()), set(os.listdir("/dev/shm")), set(threading.enumerate())
    yield
    multiprocessing.active_children()
    assert set(children()) <= before
    assert set(os.listdir("/dev/shm")) <= segments
    left = set(threading.enumerate()) - threads
    assert not [thread for thread in left if thread.name == "tightrope-watchdog"]


WORDS = {
    "raise": "RuntimeError: the simulator broke",
    "leave": "raised SystemExit: 0",
    "stubborn": r"not (back after|answered for) 0.5 s \(env_timeout\)",
    "exit": r"has died \(exit code 7\)",
    "kill": r"has died \(exit code -9\)",
    "hang": r"not (back after|answered for) 0.5 s \(env_timeout\)",
    "shape": r"shape \(4,\), the space says \(3,\)",
    "tuple": "expected 5, got 4",
}


@pytest.mark.parametrize(
    ("how", "backend", "engine"),
    [(how, "workers", "torch") for how in WORDS]
    + [(how, "serial", "torch") for how in ("raise", "leave", "hang", "stubborn", "shape", "tuple")]
    + [("raise", "serial", "fused"), ("kill", "workers", "fused")],
)
def test_every_fault_names_environment_worker_step_seed_and_action(how, backend, engine, agent_on):
    agent = agent_on(how, backend, engine=engine, env_timeout=0.5)
    before, begin = weights(agent), time.monotonic()
    with pytest.raises(EnvironmentFault, match=WORDS[how]) as caught:
        agent.learn(1000)
    assert time.monotonic() - begin < 10
    fault, text = caught.value, str(caught.value)
    worker = 2 if backend == "workers" else 0
    assert (fault.index, fault.step, fault.env_id, fault.worker) == (3, AT, "frail", worker)
    assert fault.seed == seed_of(3)
    assert fault.action in ("0", "1") and f"last action {fault.action}" in text
    assert "environment 3" in text and "step 5" in text and f"seed {seed_of(3)}" in text and "frail" in text
    assert f"worker {worker}" in text if worker else "in this process" in text
    if how == "raise":
        assert "Traceback" in text and 'RuntimeError("the simulator broke")' in text
    assert torch.equal(weights(agent), before)


@pytest.mark.parametrize("backend", ["workers", "serial"])
@pytest.mark.parametrize(("how", "what"), [("nan", "observation = nan"), ("reward", "reward = inf")])
def test_numbers_that_are_not_finite_are_named_likewise(how, what, backend, agent_on):
    agent = agent_on(how, backend)
    worker = "worker 2" if backend == "workers" else "in this process"
    where = rf"at step {AT}.*\({worker}, seed {seed_of(3)}, "
    with pytest.raises(BadNumbers, match=rf"Environment 3 of .*{what} {where}"):
        agent.learn(1000)


def test_the_action_named_is_the_one_that_led_there(agent_on):
    agent = agent_on("nan", "serial")
    with pytest.raises(BadNumbers) as caught:
        agent.learn(1000)
    action = int(re.search(r"last action (\d)", str(caught.value))[1])
    assert action == agent.collector._rollout.actions[3, AT - 1, 0]


# --------------------------------------------------------------------------------------------------- restart


@pytest.mark.parametrize("how", ["raise", "exit", "kill", "hang", "shape", "tuple", "nan", "reward", "reset"])
def test_with_restart_a_run_continues_and_counts_it(how, agent_on):
    agent = agent_on(how, on_env_fault="restart", env_timeout=0.5)
    counts = [progress.metrics["rollout/environment_restarts"] for progress in agent.iterate(256)]
    assert counts[0] == 1.0 and sum(counts) == 1.0
    assert agent.environments.restarts == 1
    assert bool(torch.isfinite(weights(agent)).all())


@pytest.mark.parametrize("how", ["raise", "hang", "nan", "tuple"])
def test_the_same_in_this_process_and_to_the_same_bits(how, agent_on):
    """A fault that leaves the process alive cuts only one copy, on every backend."""
    results = []
    for backend in ("serial", "workers", "serial"):
        if how == "hang" and backend == "workers":
            continue  # the whole process is replaced, including its other copy
        agent = agent_on(how, backend, on_env_fault="restart", env_timeout=0.5)
        agent.learn(256)
        results.append(weights(agent))
        agent.close()
    assert all(torch.equal(results[0], other) for other in results[1:])


def test_death_is_survived_to_the_same_bits_each_time(agent_on):
    results = []
    for _ in range(2):
        agent = agent_on("exit", on_env_fault="restart")
        agent.learn(256)
        results.append(weights(agent))
        agent.close()
    assert torch.equal(*results)


@pytest.mark.parametrize(("how", "rows"), [("raise", [3]), ("exit", [2, 3])])
def test_the_failed_step_does_not_count_and_the_one_before_is_bootstrapped(how, rows, agent_on):
    from tightrope.control.rollout.rollout import to_batch

    plain = {"normalise_observations": False, "normalise_rewards": False}
    agent = agent_on(how, on_env_fault="restart", length=12, **plain)
    agent.collector.reset(SMALL["seed"])
    rollout = agent.collector.collect(agent.engine, 16)
    others = [row for row in range(4) if row not in rows]
    column = AT - 1  # the fifth step
    assert not rollout.mask[rows, column].any() and rollout.ended[rows, column].all()
    assert rollout.mask.sum() == 64 - len(rows) == rollout.steps
    assert rollout.mask[others].all() and not rollout.terminated.any()
    # the cut episode does not count; the next ones start after it, with their own seed
    assert rollout.episodes == [(12.0, 12, False)] * len(others)
    seeds = [seed_of(row, 1) for row in rows]
    np.testing.assert_array_equal(rollout.inputs["flat"][rows, column + 1, 0], np.float32(seeds))
    assert (agent.collector._lengths[rows] == 16 - AT).all()
    batch = to_batch(rollout, agent.engine, agent.normalisers, agent.settings.update)
    values, rewards = batch.old_values, torch.from_numpy(rollout.rewards).float()
    delta = rewards + agent.settings.update.gamma * values.roll(-1, 1) - values
    torch.testing.assert_close(batch.advantages[rows, column - 1], delta[rows, column - 1])
    assert (batch.advantages[rows, column] == 0).all()


def test_an_environment_that_fails_only_in_the_reset_after_an_episode_loses_no_step():
    class FailsToReset(Frail):
        def reset(self, *, seed=None, options=None):
            if seed is None and self.seed == 5:
                raise OSError("no display")
            return super().reset(seed=seed)

    policy = FaultPolicy(restart=True, max_restarts=3)
    with make_environments(lambda: FailsToReset("no", length=2), 2, policy=policy) as environments:
        environments.reset(5)
        first, second, third = (environments.step(np.zeros((2, 1), np.float32)) for _ in range(3))
        assert first.cut is None and second.cut is None and third.cut is None
        assert second.truncated.all() and second.rewards.tolist() == [1.0, 1.0]
        assert second.final_inputs["flat"][:, 1].tolist() == [2.0, 2.0]
        assert second.inputs["flat"][:, 0].tolist() == [np.float32(seed_of(0, 2)), 0.0]
        assert environments.restarts == 1


@pytest.mark.parametrize(("how", "backend"), [("raise", "serial"), ("raise", "workers"), ("exit", "workers")])
def test_an_environment_that_always_fails_ends_the_run_after_so_many_restarts(how, backend, agent_on):
    agent = agent_on(how, backend, always=True, on_env_fault="restart", max_env_restarts=3, num_envs=2)
    begin = time.monotonic()
    with pytest.raises(EnvironmentFault, match="max_env_restarts allows no more") as caught:
        agent.learn(1000)
    assert time.monotonic() - begin < 20
    assert re.search(r"restarted [34] times", str(caught.value))


def test_pauses_grow_and_stay_bounded():
    assert [pause(n, None) for n in (1, 2, 3, 9, 10_000)] == [0.05, 0.1, 0.2, 2.0, 2.0]
    assert pause(9, 0.4) == 0.1  # well below the time limit


@pytest.mark.parametrize(("policy", "code"), [("raise", 2), ("restart", 2)])
def test_the_command_exits_with_2_and_a_reason(policy, code, capsys, tmp_path):
    gym.register("tightrope_tests/Frail-v0", entry_point=lambda: Frail("raise", always=True))
    words = ["--total-steps", "500", "--run-dir", str(tmp_path / "r"), "--max-env-restarts", "2"]
    try:
        assert main(["train", "tightrope_tests/Frail-v0", "--on-env-fault", policy, *words]) == code
    finally:
        del gym.registry["tightrope_tests/Frail-v0"]
    error = capsys.readouterr().err
    assert "RuntimeError: the simulator broke" in error and "tightrope_tests/Frail-v0" in error
    assert ("max_env_restarts allows no more" in error) == (policy == "restart")
    assert ("max_env_restarts 2 has no effect" in error) == (policy == "raise")


def test_restarts_are_in_the_metrics_of_a_run_and_episodes_are_none_of_them(tmp_path):
    gym.register("tightrope_tests/Frail-v0", entry_point=lambda: Frail("raise", row=0))
    words = ["--total-steps", "400", "--num-steps", "16", "--num-envs", "2", "--seed", "5", "--quiet"]
    words += ["--minibatch-size", "32", "--num-epochs", "1", "--engine", "torch", "--evaluate-every", "none"]
    words += ["--checkpoint-every", "none"]
    try:
        assert main(
            ["train", "tightrope_tests/Frail-v0", *words, "--on-env-fault", "restart", "--run-dir",
             str(tmp_path / "r")]
        ) == 0  # fmt: skip
    finally:
        del gym.registry["tightrope_tests/Frail-v0"]
    rows = [json.loads(line) for line in (tmp_path / "r" / "metrics.jsonl").read_text().splitlines()]
    assert [row["rollout/environment_restarts"] for row in rows][:3] == [1.0, 0.0, 0.0]
    episodes = (tmp_path / "r" / "episodes.jsonl").read_text().splitlines()
    assert {json.loads(line)["length"] for line in episodes} == {40}


# ------------------------------------------------------------------------------- states that come and go


class Keeper(Frail):
    """The first episode of copy 3 fails when its state is saved (``how`` "kill get") or put back."""

    def _keep(self, when):
        how, _, at = self.how.partition(" ")
        if self.mine and at == when:
            os.kill(os.getpid(), signal.SIGKILL) if how == "kill" else time.sleep(600)

    def get_state(self):
        self._keep("get")
        return self.t

    def set_state(self, state):
        self._keep("set")
        self.t = state


@pytest.mark.parametrize(
    ("how", "backend", "words"),
    [
        ("kill get", "workers", r"worker 2 .* died \(exit code -9\).* environment 3: the reset, seed"),
        ("kill set", "workers", r"worker 2 .* died \(exit code -9\).* environment 3: the reset, seed"),
        ("hang get", "workers", r"worker 2 .* not answered for 0.5 s .* environment 3: the reset, seed"),
        ("hang get", "serial", r"environment 3 .*not back after 0.5 s"),
    ],
)
@pytest.mark.parametrize("restart", [False, True])
def test_a_fault_while_a_state_is_kept_is_one_of_the_environment(how, backend, words, restart):
    policy = FaultPolicy(restart, 3, 0.5)
    number = {"num_workers": 2} if backend == "workers" else {}
    with make_environments(
        lambda: Keeper(how), 4, backend=backend, policy=policy, reseed_after=0, **number
    ) as environments:
        if restart:
            environments.reset(SMALL["seed"])
            assert environments.restarts == 1 and len(environments.carried()) == 4
            return
        with pytest.raises(EnvironmentFault, match=words):
            environments.reset(SMALL["seed"])


class Choosy(Keeper):
    """Cannot be reset with the first seed of copy 3."""

    def reset(self, *, seed=None, options=None):
        if seed == seed_of(3):
            raise OSError("no display")
        return super().reset(seed=seed)


@pytest.mark.parametrize("backend", ["serial", "workers"])
def test_faults_of_the_first_resets_are_not_counted_again_on_a_resume(backend, tmp_path):
    number = {"num_workers": 2} if backend == "workers" else {}
    values = {**SMALL, **number, "vector_backend": backend, "on_env_fault": "restart", "max_env_restarts": 1}
    values |= {"total_steps": 192, "checkpoint_every": 0.3, "evaluate_every": None}
    rows = []
    for name in ("whole", "broken"):
        run = tmp_path / name
        settings = resolve(lambda: Choosy("none"), "ppo", values)
        train(settings, run_dir=run, env=lambda: Choosy("none"))
        if name == "broken":
            for later in sorted((run / "checkpoints").iterdir(), key=step_of)[1:]:
                shutil.rmtree(later)
            resume(run, env=lambda: Choosy("none"))
        found = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
        rows.append([{k: v for k, v in row.items() if "time" not in k and k != "seconds"} for row in found])
    assert rows[0] == rows[1]
    assert [row["rollout/environment_restarts"] for row in rows[0]] == [1.0, 0.0, 0.0]


# ------------------------------------------------------------------------------- the end of the processes


def test_hung_workers_are_ended_side_by_side():
    policy = FaultPolicy(False, 0, None)
    environments = make_environments(
        lambda: Frail("hang", always=True), 9, backend="workers", num_workers=9, policy=policy
    )
    environments.reset(SMALL["seed"])
    for worker in environments._workers:
        for _ in range(AT):
            worker.send(STEP)
    time.sleep(0.5)
    begin = time.monotonic()
    environments.close()
    assert time.monotonic() - begin < 6


ORPHANS = """
import sys
sys.path.insert(0, sys.argv[1])
from faults.test_environment_faults import make_agent
make_agent("hang", always=True, env_timeout=None).learn(1000)
"""


def test_a_worker_that_hangs_does_not_outlive_its_parent():
    tests = str(Path(__file__).parent.parent)
    process = subprocess.Popen([sys.executable, "-c", ORPHANS, tests], start_new_session=True)
    task, workers = Path(f"/proc/{process.pid}/task/{process.pid}/children"), list[str]()
    until = time.monotonic() + 60
    while not workers and time.monotonic() < until:
        workers = task.read_text().split()
        time.sleep(0.1)
    time.sleep(2.0)  # by now it hangs
    process.kill()
    process.wait()
    until = time.monotonic() + 10
    while any(alive(pid) for pid in workers) and time.monotonic() < until:
        time.sleep(0.1)
    assert workers and not any(alive(pid) for pid in workers)


def alive(pid):
    """Whether a process exists and is not a zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


# --------------------------------------------------------------------------------- vector environments


class FrailVector(gym.vector.SyncVectorEnv):
    """Two Frails in one; only the very first one fails."""

    made = 0

    def __init__(self, num_envs=2, how="raise", **_):
        type(self).made += 1
        how = how if type(self).made == 1 else "no"
        second = [lambda i=i: Frail(how, always=i == 1) for i in range(num_envs)]
        super().__init__(second, autoreset_mode="SameStep")


@pytest.mark.parametrize(
    ("how", "words"),
    [("raise", "raised RuntimeError: the simulator broke"), ("hang", "not back after 0.5 s")],
)
def test_a_users_vector_environment_is_named_and_cannot_be_restarted(how, words):
    FrailVector.made = 0
    vector = FrailVector(how=how)
    agent = tightrope.PPO(vector, **{**SMALL, "num_envs": 2}, on_env_fault="restart", env_timeout=0.5)
    with pytest.raises(EnvironmentFault, match=words) as caught:
        agent.learn(1000)
    text = str(caught.value)
    assert "at step 5" in text and f"seed {seed_of(0)}" in text and "last action [" in text
    assert "cannot be restarted" in text and "Traceback" in text
    agent.close()
    vector.close()


def test_a_vector_version_of_an_id_is_restarted_with_all_its_copies():
    FrailVector.made = 0
    kinds = {"entry_point": lambda: Frail("no"), "vector_entry_point": FrailVector}
    gym.register("tightrope_tests/FrailVector-v0", **kinds)
    settings = {**SMALL, "num_envs": 2, "vector_backend": "vector", "on_env_fault": "restart"}
    settings |= {"normalise_observations": False}  # no warm-up: the fault comes in the rollout
    try:
        agent = tightrope.PPO("tightrope_tests/FrailVector-v0", **settings, engine="torch")
        FrailVector.made = 1
        first = next(agent.iterate(256))
        assert first.metrics["rollout/environment_restarts"] == 1.0
        rollout = agent.collector._rollout
        assert not rollout.mask[:, AT - 1].any() and rollout.mask.sum() == 30
        agent.close()
    finally:
        del gym.registry["tightrope_tests/FrailVector-v0"]


def test_evaluation_leaves_out_what_a_fault_cut(agent_on):
    from tightrope.control.rollout.evaluation import evaluate_agent

    agent = agent_on("no", "serial")
    policy = FaultPolicy(restart=True, max_restarts=5)
    with make_environments(lambda: Frail("raise", row=1, length=7), 2, policy=policy) as environments:
        found = evaluate_agent(agent, environments, 6, seed=5)
        assert environments.restarts == 1
    assert found["returns"] == [7.0] * 6
    agent.close()


# ------------------------------------------------------------------------------- the episode that failed


class Loose(gym.Wrapper):
    """Fails in a state that depends on the seed and the actions."""

    def __init__(self, env, how):
        super().__init__(env)
        self.how = how

    def step(self, action):
        observation, *rest = self.env.step(action)
        if abs(observation[2]) > 0.15:
            if self.how == "nan":
                return observation * np.nan, *rest
            raise RuntimeError("the pole is loose")
        return observation, *rest


@pytest.mark.parametrize(("how", "policy"), [("raise", "raise"), ("nan", "raise"), ("raise", "restart")])
@pytest.mark.parametrize("backend", ["serial", "workers"])
@pytest.mark.parametrize("reseed_after", [0, 60])
def test_a_fault_leaves_the_episode_that_failed_and_three_lines_repeat_it(
    tmp_path, how, policy, backend, reseed_after
):
    gym.register(
        "tightrope_tests/Loose-v0", lambda length: Loose(gym.make("CartPole-v1"), how), kwargs={"length": 3}
    )
    values = {**SMALL, "vector_backend": backend, "total_steps": 192, "evaluate_every": None}
    values |= {
        "on_env_fault": policy,
        "reseed_after": reseed_after,
        "max_env_restarts": 1000,
        "engine": "torch",
    }
    said = []
    try:
        settings = resolve("tightrope_tests/Loose-v0", "ppo", values)
        try:
            train(settings, run_dir=tmp_path / "r", listeners=[lambda event: said.append(str(event))])
        except (EnvironmentFault, BadNumbers) as error:
            said.append(str(error))
        files = sorted((tmp_path / "r").glob("fault-*.json"))
        assert len(files) == 1 if policy == "raise" else len(files) > 1
        for file in files:
            assert any(str(file) in line for line in said)
            fault = json.loads(file.read_text())
            env = gym.make(fault["id"], **fault["kwargs"])
            env.reset(seed=fault["seed"])
            *before, last = env.action_space.from_jsonable(fault["actions"])
            for action in before:
                observation, _, terminated, truncated, _ = env.step(action)
                if terminated or truncated:
                    assert fault["after"]
                    env.reset()
            assert fault["kwargs"] == {"length": 3} and np.isfinite(observation).all()
            if how == "nan":
                assert np.isnan(env.step(last)[0]).all()
                continue
            with pytest.raises(RuntimeError, match="the pole is loose"):
                env.step(last)
    finally:
        del gym.registry["tightrope_tests/Loose-v0"]


def test_a_run_tells_once_that_no_episode_finishes(tmp_path):
    said = []
    for length, total in ((4000, 16_000), (1200, 24_000)):
        env = lambda length=length: Frail("no", length=length)  # noqa: E731
        values = {**SMALL, "vector_backend": "serial", "evaluate_every": None, "num_steps": 256}
        values |= {"engine": "torch", "total_steps": total, "minibatch_size": 1024}
        settings = resolve(env, "ppo", values)
        listen = [lambda event: said.append(str(event))]
        train(settings, run_dir=tmp_path / str(length), env=env, listeners=listen)
    told = [line for line in said if line.startswith("No episode has finished")]
    assert len(told) == 1 and "the longest has run for 1,024 steps" in told[0]
