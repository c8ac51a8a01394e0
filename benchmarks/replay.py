"""What exact resume costs while nothing is resumed: seeded resets, and the log of running episodes.

    python benchmarks/replay.py --repeats 3 --out benchmarks/results/replay.json

One agent a task learns at its defaults. Timed inside it: what is kept of every rollout (`Collector._log`).
Seeded resets, less unseeded ones of the same copies, are timed apart. Both are shares of the processor time
of the main thread, which other load on the machine changes less than seconds. The worst case is last: every
episode is one step.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
TASKS = {
    "CartPole-v1, serial": ("CartPole-v1", 100_000, {"vector_backend": "serial"}),
    "HalfCheetah-v5, serial": ("HalfCheetah-v5", 40_000, {"vector_backend": "serial"}),
    "HalfCheetah-v5, workers": ("HalfCheetah-v5", 40_000, {}),
    "MiniGrid-Empty-8x8-v0": ("MiniGrid-Empty-8x8-v0", 20_000, {}),
    "ALE/Pong-v5, vector": ("ALE/Pong-v5", 2_048, {}),
    "one-step episodes": ("OneStep-v0", 40_000, {"vector_backend": "serial"}),
}


class OneStep(gym.Env):
    """Every episode is one step."""

    observation_space = gym.spaces.Box(-1, 1, (4,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        return np.zeros(4, np.float32), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        return np.zeros(4, np.float32), float(action), True, False, {}


def minigrid(name: str) -> gym.Env:
    """A task of MiniGrid as a vector."""
    import minigrid.wrappers

    return gym.wrappers.FlattenObservation(minigrid.wrappers.ImgObsWrapper(gym.make(name)))


def seconds(function: Any, count: int) -> float:
    """The shortest of five times, for one call."""
    found = []
    for _ in range(5):
        begin = time.perf_counter()
        for _ in range(count):
            function()
        found.append((time.perf_counter() - begin) / count)
    return min(found)


def measure(task: str) -> dict[str, Any]:
    """One task."""
    import tightrope
    from tightrope.control.rollout.collector import Collector

    env_id, steps, values = TASKS[task]
    env: Any = (lambda: minigrid(env_id)) if env_id.startswith("MiniGrid") else env_id
    spent, log = 0.0, Collector._log

    def timed(self: Any, rollout: Any) -> None:
        nonlocal spent
        begin = time.thread_time()
        log(self, rollout)
        spent += time.thread_time() - begin

    Collector._log = timed  # type: ignore[method-assign]
    agent = tightrope.PPO(env, seed=1, notify=lambda text: None, **values)
    try:
        agent.learn(max(512, steps // 8))  # compiles
        spent, before, episodes = 0.0, agent.steps, 0
        begin, clock = time.thread_time(), time.perf_counter()
        for report in agent.iterate(steps):
            episodes += len(report.episodes)
        whole, trained = time.thread_time() - begin, agent.steps - before
        wall = time.perf_counter() - clock
    finally:
        Collector._log = log  # type: ignore[method-assign]
        agent.close()
    if env_id.startswith("ALE/"):
        seeded, plain, resets = atari(env_id, agent.settings.num_envs)
        resets *= trained / agent.settings.reseed_after
    else:
        copy = env() if callable(env) else gym.make(env_id, disable_env_checker=True)
        copy.reset(seed=1)
        count = 20 if "MiniGrid" in task or "Half" in task else 200
        seeded, plain = (seconds(f, count) for f in (lambda: copy.reset(seed=5), copy.reset))
        resets = episodes
    return {
        "steps": trained, "steps_per_second": round(trained / wall, 1), "episodes": episodes,
        "log_us_a_step": round(1e6 * spent / trained, 4), "log_share": round(spent / whole, 6),
        "seeded_reset_us": round(1e6 * seeded, 1), "unseeded_reset_us": round(1e6 * plain, 1),
        "seeds_share": round(resets * (seeded - plain) / whole, 6),
    }  # fmt: skip


def atari(env_id: str, copies: int) -> tuple[float, float, float]:
    """Seconds of a masked reset of one copy with a seed and without; and 1 per reset."""
    from tightrope.control.environments.tasks import make_vector_by_id

    vector, mask = make_vector_by_id(env_id, copies), np.arange(copies) == 0
    vector.reset(seed=1)
    pair = []
    for seed in (np.array([5]), None):
        times = []
        for _ in range(5):
            begin = time.perf_counter()
            vector.reset(seed=seed, options={"reset_mask": mask})
            times.append(time.perf_counter() - begin)
        pair.append(statistics.median(times))
    vector.close()
    return pair[0], pair[1], 1.0


def main(words: list[str] | None = None) -> int:
    """Measure the tasks whose packages are there, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--repeats", type=int, default=1, help="of each task: the median is kept")
    parser.add_argument("--out", type=Path, help="JSON to write, or to add to")
    given = parser.parse_args(words)
    import torch

    torch.set_num_threads(1)
    from tightrope.runs.versions import known

    gym.register("OneStep-v0", entry_point=OneStep)
    found: dict[str, Any] = {}
    for task in given.tasks:
        try:
            several = [measure(task) for _ in range(given.repeats)]
            several.sort(key=lambda one: one["log_share"] + one["seeds_share"])
            found[task] = several[given.repeats // 2]
        except (ImportError, ValueError) as error:
            found[task] = {"left out": str(error).splitlines()[0]}
        print(f"{task}: {json.dumps(found[task])}", flush=True)
    if given.out is not None:
        command = " ".join(["python", "benchmarks/replay.py", *(sys.argv[1:] if words is None else words)])
        old = json.loads(given.out.read_text()) if given.out.exists() else {}
        tasks = old.get("tasks", {}) | {name: {"command": command, **one} for name, one in found.items()}
        given.out.write_text(json.dumps({**known(), "tasks": tasks}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT / "src"))
    sys.exit(main())
