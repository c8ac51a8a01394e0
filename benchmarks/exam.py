"""The exam of the defaults: small tasks with known best returns, each different in one way from the usual.

    python benchmarks/exam.py --peer-python VENV/bin/python     # all tasks, three seeds; goes on
    python benchmarks/exam.py --tasks bounds-512-follow,delay-5 --seeds 1
    python benchmarks/exam.py --fast                            # three tasks, one seed, seconds
    python benchmarks/exam.py --table                           # only prints what is known
    python benchmarks/exam.py --render                          # the committed table into docs/benchmarks.md

A contender gets the task, a seed and a number of steps: ``tightrope.PPO(env, seed=s).learn(n)`` beside
stable-baselines3's PPO with its defaults, in an interpreter of its own, which installs with
``pip install 'stable-baselines3==2.*'``. Its policy is CnnPolicy for pictures that its network can take,
MultiInputPolicy for a Dict, else MlpPolicy. Then the same code plays episodes with either one's deterministic
``predict`` in the plain environment. Solved: the mean return is 95 % of the way from random to the best.
The luck of the drawn episodes is taken out: a hand policy that is the best one plays the same episodes.

Each run is a process of its own, on one thread. Every row is written when it is known, and is not run again
for the same contender's version, task and seed. Nothing is chosen by its result.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from code_lines import commit
from exam_tasks import TASKS, Task
from gymnasium import spaces

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results" / "exam.json"
PAGE = Path(__file__).resolve().parents[1] / "docs" / "benchmarks.md"
EPISODES, LONG_EPISODES, FIRST_SEED, SOLVED = 100, 20, 10_000, 0.95
MAX_STEPS = 5_000  # an episode of evaluation that has not ended by then counts as it stands
FAST = {"one-step-bandit": 4_096, "actions-multibinary": 8_192, "discrete": 8_192}  # task: steps
OURS, PEER = "tightrope", "stable-baselines3"
PACKAGES = {OURS: ("torch", "numpy", "gymnasium", "numba"), PEER: ("torch", "numpy", "gymnasium", PEER)}
Choose = Callable[[Any, Any], Any]  # observation, action mask (or None) -> action


# ---------------------------------------------------------------------------------------------- one contender


def play(env: Any, choose: Choose, episodes: int, max_steps: int = MAX_STEPS) -> tuple[list[float], int]:
    """Returns of so many episodes on the seeds of evaluation, and how many were cut at ``max_steps``."""
    returns, cut = [], 0
    for k in range(episodes):
        observation, info = env.reset(seed=FIRST_SEED + k)
        total, ended, steps = 0.0, False, 0
        while not ended and steps < max_steps:
            observation, reward, terminated, truncated, info = env.step(choose(observation, mask(env, info)))
            total, ended, steps = total + reward, terminated or truncated, steps + 1
        returns.append(total)
        cut += not ended
    return returns, cut


def mask(env: Any, info: dict[str, Any]) -> Any:
    """The action mask, from the info or by the environment's method; None without any."""
    method = getattr(env.unwrapped, "action_masks", None)
    return info.get("action_mask", method() if method else None)


def train_ours(task: Task, seed: int, steps: int) -> Choose:
    """tightrope with no argument but the seed."""
    import tightrope

    agent = tightrope.PPO(task.make() if task.instance else task.make, seed=seed).learn(steps)
    return lambda observation, allowed: agent.predict(observation, action_masks=allowed)[0]


def train_peer(task: Task, seed: int, steps: int) -> Choose:
    """stable-baselines3 with its defaults."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.preprocessing import is_image_space

    torch.set_num_threads(1)
    env = task.make()
    seen, policy = env.observation_space, "MlpPolicy"
    if isinstance(seen, spaces.Dict):
        policy = "MultiInputPolicy"
    elif is_image_space(seen) and sorted(seen.shape)[1] >= 36:  # the smallest side that its network takes
        policy = "CnnPolicy"
    model = PPO(policy, env, seed=seed, device="cpu").learn(steps)
    return lambda observation, allowed: model.predict(observation, deterministic=True)[0]


def sit(task: Task, contender: str, seed: int, steps: int, episodes: int | None = None) -> dict[str, Any]:
    """Train, evaluate and mark; what a contender raises is its answer."""
    begin = time.perf_counter()
    try:
        choose = (train_ours if contender == OURS else train_peer)(task, seed, steps)
        trained = time.perf_counter()
        many = episodes or (LONG_EPISODES if steps_of_best(task) > 100 else EPISODES)
        returns, cut = play(task.make(), choose, many)
    except Exception as error:
        return {"error": f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"}
    best, _ = play(task.make(), lambda observation, allowed: task.hand(observation), many)
    luck = float(np.mean(best)) - task.best
    mean = float(np.mean(returns))
    score = (mean - luck - task.random) / (task.best - task.random)
    return {
        "mean_return": mean, "luck": luck, "score": round(score, 4), "solved": score >= SOLVED,
        "episodes": many, "cut": cut, "train_seconds": round(trained - begin, 1),
    }  # fmt: skip


def steps_of_best(task: Task) -> int:
    """Steps of one episode of the hand policy."""
    env, steps, ended = task.make(), 0, False
    observation, _ = env.reset(seed=FIRST_SEED)
    while not ended:
        observation, _, terminated, truncated, _ = env.step(task.hand(observation))
        ended, steps = terminated or truncated, steps + 1
    return steps


# ----------------------------------------------------------------------------------------------- all of them


def versions(contender: str) -> dict[str, str]:
    """What this interpreter has installed for a contender. PackageNotFoundError: it lacks something."""
    return {name: importlib.metadata.version(name) for name in PACKAGES[contender]}


def run_process(python: str, words: list[str], limit: float) -> Any:
    """What this file writes in a process of its own; an error row when it ends without writing."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    path = os.pathsep.join(filter(None, [str(HERE.parent / "src"), os.environ.get("PYTHONPATH", "")]))
    environment = {**os.environ, **threads, "PYTHONPATH": path}
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / "result.json"
        command = [python, str(HERE / "exam.py"), *words, str(result)]
        try:
            ended = subprocess.run(
                command, env=environment, timeout=limit, capture_output=True, text=True, check=False
            )
        except subprocess.TimeoutExpired:
            return {"error": f"not back after {limit:.0f} s"}
        if not result.is_file():
            return {"error": f"ended with {ended.returncode}: {ended.stderr.strip()[-300:]}"}
        return json.loads(result.read_text(encoding="utf-8"))


def wanted_runs(options: argparse.Namespace) -> list[tuple[str, int, str, int]]:
    """(contender, seed, task, steps) in the order in which they are run."""
    names = options.tasks.split(",") if options.tasks else list(FAST if options.fast else TASKS)
    if unknown := [name for name in names if name not in TASKS]:
        raise SystemExit(f"unknown tasks: {', '.join(unknown)}. Known: {', '.join(TASKS)}.")
    contenders = [name for name in (OURS, PEER) if name == OURS or options.peer_python]
    if options.contenders:
        contenders = [name for name in contenders if name in options.contenders.split(",")]
    default = (lambda name: FAST.get(name, 8_192)) if options.fast else (lambda name: TASKS[name].steps)
    return [
        (contender, seed, name, options.steps or default(name))
        for seed in range(1 if options.fast else options.seeds)
        for contender in contenders
        for name in names
    ]  # fmt: skip


def examine(options: argparse.Namespace, say: Callable[[str], None]) -> dict[str, Any]:
    """Run what is not known yet, writing each row as it comes; gives all rows."""
    results = json.loads(options.out.read_text(encoding="utf-8")) if options.out.is_file() else {"rows": []}
    found = {OURS: versions(OURS) | {"commit": commit()}}
    if options.peer_python:
        found[PEER] = run_process(options.peer_python, ["versions", PEER], 120)
        if "error" in found[PEER]:
            raise SystemExit(f"{options.peer_python} cannot be asked: {found[PEER]['error']}")
    command = " ".join(["python", "benchmarks/exam.py", *options.words])
    names = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    machine = {"processor": names[0].split(":", 1)[1].strip(), "cores": os.cpu_count()} if names else {}
    results |= {"command": command, "machine": machine | {"python": platform.python_version()}}
    lock = threading.Lock()

    def one(run: tuple[str, int, str, int]) -> None:
        contender, seed, name, steps = run
        task = TASKS[name]
        key = {
            "task": name, "contender": contender, "seed": seed, "steps": steps, "best": task.best,
            "random": task.random, "versions": found[contender],
        }  # fmt: skip
        if any(key.items() <= row.items() for row in results["rows"]):
            return
        python = sys.executable if contender == OURS else options.peer_python
        begin = time.perf_counter()
        words = ["sit", name, contender, str(seed), str(steps)]
        answer = run_process(python, words, options.limit)
        row = (
            key | answer | {"wall_seconds": round(time.perf_counter() - begin, 1), "date": str(date.today())}
        )
        with lock:
            mine = (name, contender, seed)
            kept = [r for r in results["rows"] if (r["task"], r["contender"], r["seed"]) != mine]
            results["rows"] = [*kept, row]
            write(options.out, results)
            mark = row.get("error") or f"{'solved' if row['solved'] else 'FAILED'} {row['score']:.3f}"
            say(f"{contender} {name} seed {seed}, {row['wall_seconds']} s: {mark}")

    with ThreadPoolExecutor(options.jobs) as pool:
        list(pool.map(one, wanted_runs(options)))
    return results


def write(path: Path, results: dict[str, Any]) -> None:
    """The whole file or the one before it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_suffix(".fresh")
    fresh.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    fresh.replace(path)


def cell(rows: list[dict[str, Any]]) -> str:
    """Solved seeds, and the worst score where one failed: 1 is the best return, 0 what random reaches."""
    if not rows:
        return ""
    solved = sum(row.get("solved", False) for row in rows)
    errors = [row["error"].split(":")[0] for row in rows if "error" in row]
    scores = [row["score"] for row in rows if "score" in row]
    worst = "" if solved == len(rows) else errors[0] if errors else f"{min(scores):.2f}"
    return f"{solved} of {len(rows)}" + (f" ({worst})" if worst else "")


def table(rows: list[dict[str, Any]]) -> str:
    """The Markdown table: solved seeds of each contender."""
    lines = [f"| task | what is unusual | steps | {OURS} | {PEER} |", "|---|---|---|---|---|"]
    for name, task in TASKS.items():
        mine = [row for row in rows if row["task"] == name]
        cells = [cell([row for row in mine if row["contender"] == one]) for one in (OURS, PEER)]
        if mine:
            steps = max(row["steps"] for row in mine)
            lines.append(f"| {name} | {task.way} | {steps:,} | {cells[0]} | {cells[1]} |")
    return "\n".join(lines)


def render(page: Path, text: str) -> str:
    """A page with the table between its markers."""
    begin, end = "<!-- figures:exam -->", "<!-- figures:end-exam -->"
    head, rest = page.read_text(encoding="utf-8").split(begin)
    return f"{head}{begin}\n{text}\n{end}{rest.split(end)[1]}"


def main(words: list[str] | None = None) -> int:
    """Run, or with ``sit`` and ``versions`` be the process of one contender."""
    words = sys.argv[1:] if words is None else words
    if words[:1] == ["versions"]:
        Path(words[-1]).write_text(json.dumps(versions(words[1])), encoding="utf-8")
        return 0
    if words[:1] == ["sit"]:
        warnings.simplefilter("ignore")
        name, contender, seed, steps = words[1:5]
        answer = sit(TASKS[name], contender, int(seed), int(steps))
        Path(words[-1]).write_text(json.dumps(answer), encoding="utf-8")
        return 0
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", help="only these, with commas between")
    parser.add_argument("--contenders", help=f"only these: {OURS},{PEER}")
    parser.add_argument("--seeds", type=int, default=3, help="seeds 0 to n - 1 (default 3)")
    parser.add_argument("--steps", type=int, help="steps of every task (default: the task's own)")
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time (default 1)")
    parser.add_argument("--limit", type=float, default=3600.0, help="seconds a run may take (default 3600)")
    parser.add_argument("--peer-python", help=f"interpreter with {PEER} (default: only {OURS})")
    parser.add_argument("--out", type=Path, default=RESULTS, help="results file; rows in it are kept")
    parser.add_argument("--fast", action="store_true", help="three easy tasks, few steps, one seed")
    parser.add_argument("--table", action="store_true", help="only print the table of the results file")
    parser.add_argument("--render", action="store_true", help="only write the committed table into docs/")
    options = parser.parse_args(words)
    options.words = words
    if options.render:
        rows = json.loads(RESULTS.read_text(encoding="utf-8"))["rows"]
        PAGE.write_text(render(PAGE, table(rows)), encoding="utf-8")
        return 0
    if options.table:
        results = json.loads(options.out.read_text(encoding="utf-8"))
    else:
        results = examine(options, lambda text: print(text, file=sys.stderr, flush=True))
    print(table(results["rows"]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
