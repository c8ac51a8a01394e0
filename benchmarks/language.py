"""PPO on a language model against TRL 1.12 (the last with PPO): response tokens per second, whole processes.

    python benchmarks/language.py --peer-python VENV/bin/python          # glassllm: ten minutes
    python benchmarks/language.py --peer-python VENV/bin/python --models smollm2   # an hour
    python benchmarks/language.py --render       # the table of the committed results into docs/benchmarks.md

Installs nothing. Same model, same batch, responses of exactly 24 tokens, 4 epochs, one minibatch, float32
unless a row states bfloat16, including reference and reward model. The adapted layers and the form of the KL
are those of the film-review demo that reaches its quality goal. Each measurement is two fresh processes with
n1 and n2 iterations, timed from outside; rate = difference in tokens / difference in wall time, so that
loading cancels out. Contenders take turns; a ratio is the median of the ratios within pairs.
"""

from __future__ import annotations

import argparse
import datetime
import importlib.metadata
import itertools
import json
import os
import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any

from language_peers import OPENINGS
from speed import machine
from speed_report import fill
from speed_runs import HERE, our_environment, plain_environment, run_process

sys.path.insert(0, str(HERE.parent / "demos"))
from sentiment import STAGES

RESULTS = HERE / "results" / "language" / "speed.json"
PAGE, README = HERE.parent / "docs" / "benchmarks.md", HERE.parent / "README.md"
TOKENS = 24
# model -> batch of responses, iterations n1 and n2 of the peer and of ours
MODELS: dict[str, dict[str, Any]] = {
    "glassllm": {"batch": 64, "peer": (2, 10), "ours": (2, 22)},
    "smollm2": {"batch": 16, "peer": (2, 6), "ours": (2, 8)},
}
LAYOUTS: dict[str, dict[str, Any]] = {
    "full": {"tune": "full", "critic": "separate", "learning_rate": 1e-5},
    "one trunk": {"critic": "head"},
    "one trunk, critic an adapter": {"critic": "adapter"},
    "one trunk, bfloat16": {"critic": "head", "dtype": "bfloat16"},
}
OF_THE_DEMO = ("lora_rank", "lora_layers", "kl", "kl_beta", "learning_rate", "critic_learning_rate")


def values_of(name: str, layout: str) -> dict[str, Any]:
    """The settings of a row."""
    values = {"dtype": "float32", **LAYOUTS[layout]}
    if values.get("tune") == "full":
        return values
    present = STAGES[name]["align"]
    return {**{key: present[key] for key in OF_THE_DEMO if key in present}, "tune": "lora", **values}


def ours(job: dict[str, Any]) -> dict[str, Any]:
    """Our side of one run: the reward model shares the trunk or, in full fine-tuning, has its own."""
    from tightrope.language import align

    values = dict(job["values"])
    with tempfile.TemporaryDirectory() as folder:
        run = align(
            model=job["folder"], prompts=list(OPENINGS) * 64, reward=job["reward"], run_dir=folder,
            total_episodes=job["batch"] * job["iterations"], batch_size=job["batch"],
            minibatch_size=job["batch"],
            num_epochs=4, max_new_tokens=TOKENS, max_prompt_tokens=16, ignore_eos=True, checkpoint_every=None,
            threads=job["threads"], **values,
        )  # fmt: skip
        rows = run.metrics
    parts = ("time/generate_seconds", "time/score_seconds", "time/update_seconds")
    inside = {name: statistics.median(row[name] for row in rows) for name in parts}
    between = [b["time/seconds"] - a["time/seconds"] for a, b in itertools.pairwise(rows)]
    inside["time/iteration_seconds"] = statistics.median(between) if between else None
    return {"tokens": job["batch"] * job["iterations"] * TOKENS, "inside": inside}


def one_run(command: list[str], job: dict[str, Any], environment: dict[str, str]) -> dict[str, Any]:
    """Run the job in a process: wall time and memory measured from outside, tokens from inside."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "result.json"
        found = run_process([*command, json.dumps(job), str(file)], environment)
        return found | json.loads(file.read_text())


def rate(
    command: list[str], job: dict[str, Any], between: tuple[int, int], environment: dict[str, str]
) -> dict:
    """Response tokens per second, from the difference of two runs."""
    short, long = (one_run(command, job | {"iterations": n}, environment) for n in between)
    tokens, wall = long["tokens"] - short["tokens"], long["wall"] - short["wall"]
    return {"rate": tokens / wall, "memory_mb": long["memory_mb"], "short": short, "long": long}


def make_reward(name: str, folder: str, full: bool, out: str) -> None:
    """A reward model with the row's layout; its quality does not affect speed."""
    from tightrope.language import RewardSettings, train_reward

    stage = {"tune": "lora", "lora_layers": None, **STAGES[name]["reward"]}
    tune = "full" if full else stage["tune"]
    rows = [{"chosen": f"good film {i}", "rejected": f"bad film {i}"} for i in range(32)]
    layers = None if tune == "full" else stage["lora_layers"]
    settings = RewardSettings(model=folder, data="-", tune=tune, lora_layers=layers, minibatch_size=16)
    train_reward(settings, data=rows, run_dir=out)


def compare(
    name: str, layouts: list[str], peer_python: str | None, pairs: int, rewards: Path
) -> list[dict[str, Any]]:
    """The layouts of one model against the peer: in every pair the peer and each layout run once."""
    from tightrope.language.model.packaged import find_model

    shape, folder = MODELS[name], find_model(name)
    job = {"folder": folder, "batch": shape["batch"], "tokens": TOKENS, "threads": 2}
    contenders: dict[str, Any] = {}
    if peer_python:
        script = [peer_python, str(HERE / "language_peers.py")]
        contenders["trl"] = (script, job, shape["peer"], plain_environment())
    for layout in layouts:
        values = values_of(name, layout)
        full = values["tune"] == "full"
        reward = str(rewards / f"{name}-{layout}")
        job_of_reward = json.dumps({"name": name, "folder": folder, "full": full, "out": reward})
        # in a separate process: the system counts the peak of a parent as its children's
        run_process([sys.executable, __file__, "reward", job_of_reward], our_environment())
        between = shape["peer"] if full else shape["ours"]  # every weight takes about as long as the peer
        mine = job | {"values": values, "reward": reward}
        contenders[layout] = ([sys.executable, __file__, "ours"], mine, between, our_environment())
    taken: list[dict[str, Any]] = []
    for k in range(pairs):
        order = list(contenders) if k % 2 == 0 else list(reversed(contenders))
        taken.append({who: rate(*contenders[who]) for who in order})
        rates = ", ".join(f"{who} {taken[-1][who]['rate']:,.1f}" for who in contenders)
        print(f"{name}, pair {k + 1} of {pairs}: {rates} tokens/s", file=sys.stderr, flush=True)
    return [_row(name, layout, contenders[layout][1]["values"], taken) for layout in layouts]


def _row(name: str, layout: str, values: dict[str, Any], taken: list[dict[str, Any]]) -> dict[str, Any]:
    who = {"tightrope": layout, **({"trl": "trl"} if "trl" in taken[0] else {})}
    pairs = [{one: pair[theirs] for one, theirs in who.items()} for pair in taken]
    row: dict[str, Any] = {"model": name, "layout": layout, "values": values, "batch": MODELS[name]["batch"]}
    row["pairs"] = pairs
    for one in who:
        row[one] = statistics.median(pair[one]["rate"] for pair in pairs)
        row[f"{one}_memory_mb"] = max(pair[one]["memory_mb"] for pair in pairs)
    if "trl" in who:
        ratios = [pair["tightrope"]["rate"] / pair["trl"]["rate"] for pair in pairs]
        row["ratio"] = {"median": statistics.median(ratios), "low": min(ratios), "high": max(ratios)}
    return row


def text(results: dict[str, Any]) -> str:
    """One row per layout, with the shares of our time."""
    lines = [
        "| model | layout | adapted | tightrope, tokens/s (MB) | TRL 1.12 | ratio "
        "| generate | score | update |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in results["rows"]:
        values, inside = row["values"], row["pairs"][-1]["tightrope"]["long"]["inside"]
        adapted = (
            "every weight"
            if values.get("tune") == "full"
            else f"top {values['lora_layers']}, rank {values['lora_rank']}"
        )
        whole = inside["time/iteration_seconds"]
        shares = [f"{inside[f'time/{part}_seconds'] / whole:.0%}" for part in ("generate", "score", "update")]
        peer, ratio = "", ""
        if "trl" in row:
            peer = f"{row['trl']:,.1f} ({row['trl_memory_mb']:,.0f})"
            found = row["ratio"]
            ratio = f"**{found['median']:.2f}** ({found['low']:.2f}-{found['high']:.2f})"
        own = f"**{row['tightrope']:,.1f}** ({row['tightrope_memory_mb']:,.0f})"
        cells = (row["model"], row["layout"], adapted, own, peer, ratio, *shares)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def short_text(results: dict[str, Any]) -> str:
    """The README's table."""
    lines = ["| model | layout | tightrope | TRL 1.12 (ratio) | peak memory |", "|---|---|---|---|---|"]
    for row in results["rows"]:
        own, memory = f"**{row['tightrope']:,.0f}**", f"{row['tightrope_memory_mb']:,.0f} MB"
        peer = "-"
        if "trl" in row:
            peer = f"{row['trl']:,.0f} ({row['ratio']['median']:.1f})"
            memory += f" beside {row['trl_memory_mb']:,.0f} MB"
        lines.append(f"| {row['model']} | {row['layout']} | {own} | {peer} | {memory} |")
    where = f"{results['machine']['cpu']}, {results['machine']['cores']} cores, {results['date']}"
    return "\n".join([*lines, "", f"Response tokens/s, medians; {where}."])


BLOCKS = ((PAGE, "language", text), (README, "readme-language", short_text))


def render(results: dict[str, Any]) -> None:
    """Write the tables into docs/benchmarks.md and the README."""
    for page, name, body in BLOCKS:
        page.write_text(fill(page.read_text(encoding="utf-8"), name, body(results)), encoding="utf-8")


def main(words: list[str] | None = None) -> None:
    """The command."""
    words = sys.argv[1:] if words is None else words
    if words and words[0] == "ours":
        Path(words[2]).write_text(json.dumps(ours(json.loads(words[1]))), encoding="utf-8")
        return
    if words and words[0] == "reward":
        make_reward(**json.loads(words[1]))
        return
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--peer-python", help="interpreter with trl==1.12.0 and datasets")
    parser.add_argument("--models", nargs="+", choices=tuple(MODELS), default=["glassllm"])
    parser.add_argument("--layouts", nargs="+", choices=tuple(LAYOUTS), default=list(LAYOUTS))
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--render", action="store_true", help="run nothing")
    options = parser.parse_args(words)
    if not options.render:
        measure(options, words)
    results = json.loads(options.results.read_text(encoding="utf-8"))
    render(results)
    print(text(results))


def measure(options: argparse.Namespace, words: list[str]) -> None:
    """Run every requested row; keep the other rows of the results file."""
    results: dict[str, Any] = {
        "date": datetime.date.today().isoformat(),
        "command": " ".join(
            ["python benchmarks/language.py", *(Path(w).name if os.path.isabs(w) else w for w in words)]
        ),
        "machine": machine(),
        "versions": {name: importlib.metadata.version(name) for name in ("torch", "transformers")},
        "rows": [],
    }
    if options.results.is_file():
        results["rows"] = json.loads(options.results.read_text(encoding="utf-8"))["rows"]
    if options.peer_python:
        script = [options.peer_python, str(HERE / "language_peers.py"), "versions"]
        with tempfile.TemporaryDirectory() as folder:
            run_process([*script, f"{folder}/versions.json"], plain_environment())
            results["peer"] = json.loads(Path(f"{folder}/versions.json").read_text())
    with tempfile.TemporaryDirectory() as folder:
        for name in options.models:
            rows = compare(name, options.layouts, options.peer_python, options.pairs, Path(folder))
            fresh = {(row["model"], row["layout"]) for row in rows}
            kept = [row for row in results["rows"] if (row["model"], row["layout"]) not in fresh]
            results["rows"] = kept + rows
            options.results.parent.mkdir(parents=True, exist_ok=True)
            options.results.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
