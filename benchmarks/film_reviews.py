"""The three stages on film reviews over several seeds: does the gold score follow the reward, with and
without KL?

    python benchmarks/film_reviews.py                    # an hour, two runs at a time with one thread each
    python benchmarks/film_reviews.py --collect FOLDER   # the tables of existing runs

One SFT model and one reward model. PPO from them with each seed; once without a KL penalty; once for each
other fixed KL weight; and shorter with each kind of critic. The gold judge learned from other reviews than
the reward model. It scores continuations of reviews that PPO never saw: P(positive) of 512 responses before
and after. Settings were tuned on seeds 1 to 3, which are not among the seeds.
"""

from __future__ import annotations

import argparse
import datetime
import json
import statistics
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from speed import machine
from speed_report import fill
from speed_runs import HERE, our_environment

RESULTS = HERE / "results" / "language" / "film_reviews.json"
PAGE, README = HERE.parent / "docs" / "benchmarks.md", HERE.parent / "README.md"
DEMO = HERE.parent / "demos" / "sentiment.py"
SEEDS = (71, 72, 73, 74, 75)
CRITICS = ("head", "adapter", "separate")
SHORT = 2048  # responses of a run that compares critics
JOBS: dict[str, tuple[str, ...]] = {
    **{f"seed-{seed}": ("--seed", str(seed)) for seed in SEEDS},
    **{f"beta-{beta}": ("--seed", "76", "--kl-beta", beta) for beta in ("0", "0.02", "0.05", "0.2")},
    **{
        f"critic-{critic}-{seed}": ("--seed", str(seed), "--critic", critic, "--episodes", str(SHORT))
        for seed in SEEDS
        for critic in CRITICS
    },
    "smollm2": ("--seed", "72", "--model", "smollm2"),
}


def run(folder: Path, name: str) -> None:
    """Run the demo once, with the first two stages beside it; skip a run that already exists."""
    result = folder / f"{name}.json"
    if result.exists():
        return
    stages = folder / ("stages-smollm2" if name == "smollm2" else "stages")
    command = [sys.executable, str(DEMO), "--stages", str(stages), "--out", str(folder / name)]
    command += ["--threads", "1", "--json", str(result), *JOBS[name]]
    command += [] if name == "smollm2" else ["--evaluate-every", "0.025"]
    with open(folder / f"{name}.log", "w", encoding="utf-8") as log:
        subprocess.run(command, env=our_environment() | {"OMP_NUM_THREADS": "1"}, stdout=log, check=True)


def collect(folder: Path) -> dict[str, Any]:
    """The figures of the runs in a folder."""
    runs = {
        name: json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
        for name in JOBS
        if (folder / f"{name}.json").exists()
    }
    held = [found for name, found in runs.items() if name.startswith("seed-")]
    gained = [found["gold_after"] - found["gold_before"] for found in held]
    return {
        "date": datetime.date.today().isoformat(),
        "command": "python benchmarks/film_reviews.py",
        "machine": machine(),
        "gain_mean": statistics.mean(gained),
        "gain_worst": min(gained),
        "kl_mean": statistics.mean(found["kl"] for found in held),
        "kl_worst": max(found["kl"] for found in held),
        "runs": runs,
    }


def text(results: dict[str, Any]) -> str:
    """One row per run, the critics in their own table, and the monitor's messages without a KL penalty."""
    lines = ["| run | gold before | gold after | score | KL, nats | distinct pairs of tokens | PPO, s |"]
    lines.append("|---|---|---|---|---|---|---|")
    for name, found in results["runs"].items():
        if name.startswith("critic"):
            continue
        lines.append(
            f"| {found['model']}, seed {found['seed']}, kl_beta {found['kl_beta']:g} | "
            f"{found['gold_before']:.2f} | **{found['gold_after']:.2f}** | "
            f"{found['scores']:.2f} | {found['kl']:.1f} | {found['curve'][-1]['objective/distinct_2']:.2f} | "
            f"{found['ppo_seconds']:.0f} |"
        )
    free = results["runs"].get("beta-0")
    if free:
        judged = [row for row in free["curve"] if row["eval/gold"] is not None]
        top = max(judged, key=lambda row: row["eval/gold"])
        lines += [
            "",
            f"Without a KL the gold score was highest after {top['episodes']:,} responses, at a KL of",
        ]
        lines[-1] += (
            f" {top['objective/kl']:.0f} nats ({top['eval/gold']:.2f}). What the monitor said, and when:"
        )
        lines += [
            "",
            *(f"- {alarm['after']:,}: {alarm['text']}" for alarm in free["warnings"] if alarm["after"]),
        ]
    return "\n".join(lines)


def critics(results: dict[str, Any]) -> str:
    """Mean and 95 % interval over the seeds for each kind of critic."""
    if not any(name.startswith("critic-") for name in results["runs"]):
        return "Not measured yet."
    lines = ["| critic | score | gold gained | KL, nats | PPO, s |", "|---|---|---|---|---|"]
    for critic in CRITICS:
        runs = [found for name, found in results["runs"].items() if name.startswith(f"critic-{critic}")]
        if not runs:
            continue
        gained = [found["gold_after"] - found["gold_before"] for found in runs]
        columns = ([found["scores"] for found in runs], gained, [found["kl"] for found in runs])
        cells = [interval(values, digits) for values, digits in zip(columns, (2, 3, 1), strict=True)]
        seconds = statistics.mean(found["ppo_seconds"] for found in runs)
        lines.append(f"| {critic} | {' | '.join(cells)} | {seconds:.0f} |")
    return "\n".join(lines)


def interval(values: list[float], digits: int) -> str:
    """Mean and half the 95 % interval of Student's t."""
    from scipy.stats import t

    mean = statistics.mean(values)
    if len(values) < 2:
        return f"{mean:.{digits}f}"
    half = float(t.ppf(0.975, len(values) - 1)) * statistics.stdev(values) / len(values) ** 0.5
    return f"{mean:.{digits}f} ± {half:.{digits}f}"


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--folder", type=Path, default=Path("runs") / "sentiment-seeds")
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time")
    parser.add_argument("--collect", type=Path, metavar="FOLDER", help="run nothing")
    options = parser.parse_args()
    folder = options.collect or options.folder
    if options.collect is None:
        folder.mkdir(parents=True, exist_ok=True)
        first, *others = JOBS
        run(folder, first)  # it trains the first two stages as well
        with ThreadPoolExecutor(options.jobs) as pool:
            list(pool.map(lambda name: run(folder, name), others))
    results = collect(folder)
    RESULTS.parent.mkdir(parents=True, exist_ok=True)
    RESULTS.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    render(results)
    print(text(results), critics(results), sep="\n\n")


def sentence(results: dict[str, Any]) -> str:
    """The sentences about the runs in the README."""
    held = [found for name, found in results["runs"].items() if name.startswith("seed-")]
    before, after = (statistics.mean(found[f"gold_{when}"] for found in held) for when in ("before", "after"))
    slowest = max(found["ppo_seconds"] for found in held)
    lines = [
        f"glassllm (0.85 M parameters), {len(held)} seeds: P(positive), by a judge that PPO never sees, "
        f"rises from {before:.2f} to **{after:.2f}** at a KL of {results['kl_mean']:.1f} nats a response. "
        f"PPO takes {slowest:.0f} s on one core for the slowest seed."
    ]
    real = results["runs"].get("smollm2")
    if real:
        lines.append(
            f"SmolLM2-135M: from {real['gold_before']:.2f} to **{real['gold_after']:.2f}** at "
            f"{real['kl']:.1f} nats, after {real['ppo_seconds'] / 60:.0f} minutes of PPO."
        )
    return "\n".join(lines)


BLOCKS = (
    (PAGE, "film-reviews", text),
    (PAGE, "critics", critics),
    (README, "readme-film-reviews", sentence),
)


def render(results: dict[str, Any]) -> None:
    """Write the tables into docs/benchmarks.md and the sentences into the README."""
    for page, name, body in BLOCKS:
        page.write_text(fill(page.read_text(encoding="utf-8"), name, body(results)), encoding="utf-8")


if __name__ == "__main__":
    main()
