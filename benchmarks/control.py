"""Returns on the control tasks: every listed task, several seeds, unchanged presets.

    python benchmarks/control.py                       # all tasks; writes benchmarks/results/control/*.json
    python benchmarks/control.py --tasks CartPole-v1 --seeds 3 --jobs 2
    python benchmarks/control.py --render              # only writes the tables into docs/ and README

Each run is `tightrope train TASK --seed S` in a separate process, on one core, without evaluation during
training. Then `tightrope evaluate` plays 100 deterministic episodes with the final policy, on seeds far from
the training seeds. The first seed is 0 for every task. No run is selected by its result: every run is listed.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path
from queue import SimpleQueue
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results" / "control"
EPISODES = 100
T95 = {2: 12.71, 3: 4.303, 4: 3.182, 5: 2.776, 6: 2.571, 8: 2.365, 10: 2.262}  # Student's t, two-sided, by n

# task, algorithm, agent steps, seeds, the goal
TASKS: list[tuple[str, str, int, int, str]] = [
    ("CartPole-v1", "ppo", 100_000, 10, "475 for 9 of 10 seeds; mean 490"),
    ("CartPole-v1", "a2c", 300_000, 3, "450"),
    ("CartPole-v1", "reinforce", 300_000, 3, "450"),
    ("CartPole-v1", "reinforce-plain", 300_000, 3, "450"),
    ("Acrobot-v1", "ppo", 500_000, 5, "-82"),
    ("MountainCarContinuous-v0", "ppo", 100_000, 5, "90"),
    ("Pendulum-v1", "ppo", 200_000, 5, "-175"),
    ("LunarLander-v3", "ppo", 1_000_000, 5, "245"),
    ("LunarLanderContinuous-v3", "ppo", 1_000_000, 5, "265"),
    ("HalfCheetah-v5", "ppo", 1_000_000, 5, "5,650"),
    ("Hopper-v5", "ppo", 1_000_000, 5, "2,480"),
    ("Walker2d-v5", "ppo", 1_000_000, 5, "3,410"),
    ("ALE/Pong-v5", "ppo", 1_000_000, 1, "none"),
]
# stable-baselines3's zoo: one tuned agent per task, deterministic evaluation; older versions of some tasks
PEERS = {
    "CartPole-v1": "500",
    "Acrobot-v1": "-73.5 (1M)",
    "MountainCarContinuous-v0": "88.3 (20k)",
    "Pendulum-v1": "-172.2 (100k)",
    "LunarLander-v3": "242.1 (v2)",
    "LunarLanderContinuous-v3": "270.9 (v2)",
    "HalfCheetah-v5": "5,819 (v3); CleanRL 1,443 (v4)",
    "Hopper-v5": "2,410 (v3)",
    "Walker2d-v5": "3,479 (v3)",
    "ALE/Pong-v5": "21.0 (10M, NoFrameskip-v4)",
}
FLAGS = {"reinforce-plain": ["--algorithm", "reinforce", "--no-baseline"]}


def run_once(task: str, algorithm: str, steps: int, seed: int, core: int | None) -> dict[str, Any]:
    """Train one seed and evaluate its final policy; raises RuntimeError with the command's own error."""
    tightrope = [sys.executable, "-m", "tightrope"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    pin = (lambda: os.sched_setaffinity(0, {core})) if core is not None else None

    def call(arguments: list[str]) -> dict[str, Any]:
        finished = subprocess.run(
            [*tightrope, *arguments, "--json", "--quiet"],
            capture_output=True, text=True, env=environment, preexec_fn=pin, check=False,
        )  # fmt: skip
        if finished.returncode:
            raise RuntimeError(
                f"{' '.join(arguments)} exited {finished.returncode}: {finished.stderr[-2000:]}"
            )
        return json.loads(finished.stdout.strip().splitlines()[-1])

    flags = FLAGS.get(algorithm, ["--algorithm", algorithm])
    with tempfile.TemporaryDirectory() as folder:
        run = str(Path(folder) / "run")
        budget = ["--total-steps", str(steps), "--seed", str(seed)]
        trained = call(["train", task, *flags, *budget, "--evaluate-every", "none", "--run-dir", run])
        found = call(["evaluate", run, "--episodes", str(EPISODES)])
    return {
        "seed": seed,
        "mean_return": found["mean_return"],
        "std_return": found["std_return"],
        "steps": trained["steps"],
        "wall_seconds": round(trained["wall_seconds"], 1),
        "engine": trained["engine"],
    }


def summarise(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Mean over seeds, its 95 % interval by Student's t, the worst and the best seed."""
    means = [run["mean_return"] for run in runs]
    half = T95.get(len(means), 1.96) * statistics.stdev(means) / len(means) ** 0.5 if len(means) > 1 else 0.0
    summary = {"mean": statistics.fmean(means), "ci95": half, "min": min(means), "max": max(means)}
    return {name: round(x, 2) for name, x in summary.items()}


def machine() -> dict[str, Any]:
    """The machine and the versions behind the figures."""
    packages = ("torch", "numpy", "numba", "gymnasium", "mujoco", "box2d")
    names = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    return {
        "processor": names[0].split(":", 1)[1].strip() if names else platform.processor(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in packages},
    }


def measure(task: str, algorithm: str, steps: int, seeds: int, goal: str, jobs: int) -> dict[str, Any]:
    """All seeds of one row, ``jobs`` at a time, each on its own core if the system allows it."""
    cores: SimpleQueue[int | None] = SimpleQueue()
    available = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    for i in range(jobs):
        cores.put(available[i % len(available)] if available else None)

    def one(seed: int) -> dict[str, Any]:
        core = cores.get()
        try:
            return run_once(task, algorithm, steps, seed, core)
        finally:
            cores.put(core)

    with ThreadPoolExecutor(jobs) as pool:
        runs = list(pool.map(one, range(seeds)))
    command = (
        f"python benchmarks/control.py --tasks {task} --algorithms {algorithm} --seeds {seeds} --jobs {jobs}"
    )
    row = {"task": task, "algorithm": algorithm, "total_steps": steps, "goal": goal, "episodes": EPISODES}
    return {**row, **summarise(runs), "runs": runs, "command": command, "machine": machine()}


def result_path(task: str, algorithm: str) -> Path:
    """The committed file of a row."""
    return RESULTS / f"{task.replace('/', '-')}-{algorithm}.json"


def table() -> str:
    """The Markdown table of all committed results."""
    lines = [
        "| task | algorithm | steps | mean of seeds ± 95 % | worst seed | seeds | goal | SB3 zoo (one) |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for task, algorithm, steps, _, goal in TASKS:
        path = result_path(task, algorithm)
        if not path.is_file():
            continue
        row = json.loads(path.read_text())
        interval = f" ± {row['ci95']:,.1f}" if len(row["runs"]) > 1 else ""  # one seed shows no spread
        score = f"**{row['mean']:,.1f}**{interval}"
        peer = PEERS[task] if algorithm == "ppo" else ""
        lines.append(
            f"| {task} | {algorithm} | {steps:,} | {score} | {row['min']:,.1f} | "
            f"{len(row['runs'])} | {goal} | {peer} |"
        )
    return "\n".join(lines)


def render(path: Path) -> None:
    """Put the table between the page's markers."""
    begin, end = "<!-- figures:returns -->", "<!-- figures:end -->"
    text = path.read_text()
    if begin not in text:
        return
    head, rest = text.split(begin, 1)
    tail = rest.split(end, 1)[1] if end in rest else rest
    path.write_text(f"{head}{begin}\n{table()}\n{end}{tail}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", nargs="*", help="only these tasks")
    parser.add_argument("--algorithms", nargs="*", help="only these algorithms")
    parser.add_argument("--seeds", type=int, help="seeds per row (default: the row's own)")
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time (default 1)")
    parser.add_argument("--render", action="store_true", help="only write the tables")
    chosen = parser.parse_args()
    RESULTS.mkdir(parents=True, exist_ok=True)
    for task, algorithm, steps, seeds, goal in TASKS if not chosen.render else []:
        if (chosen.tasks and task not in chosen.tasks) or (
            chosen.algorithms and algorithm not in chosen.algorithms
        ):
            continue
        row = measure(task, algorithm, steps, chosen.seeds or seeds, goal, chosen.jobs)
        result_path(task, algorithm).write_text(json.dumps(row, indent=1) + "\n")
        print(
            f"{task} {algorithm}: {row['mean']:,.1f} ± {row['ci95']:,.1f} (goal {goal}), worst "
            f"{row['min']:,.1f}",
            flush=True,
        )
    for page in (ROOT / "docs" / "benchmarks.md", ROOT / "README.md"):
        render(page)


if __name__ == "__main__":
    main()
