"""PPO on a language model beside TRL 1.12 (the last with PPO): response tokens per second, whole processes.

    python benchmarks/rlhf.py --peer-python VENV/bin/python          # glassllm: ten minutes
    python benchmarks/rlhf.py --peer-python VENV/bin/python --models smollm2   # half an hour

Installs nothing. Same model, same batch, responses of exactly 24 tokens, 4 epochs, one minibatch, float32,
reference and reward model included. Each measurement is two fresh processes, of n1 and n2 iterations, timed
from outside; rate = tokens of the difference / difference of wall times, so that loading drops out.
Contenders take turns; a ratio is the median of the ratios within pairs.
"""

from __future__ import annotations

import argparse
import datetime
import importlib.metadata
import json
import os
import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any

from rlhf_peers import OPENINGS
from speed import machine
from speed_runs import HERE, our_environment, plain_environment, run_process

RESULTS = HERE / "results" / "rlhf" / "speed.json"
TOKENS = 24
# model -> batch of responses, iterations n1 and n2 of the peer and of ours, layers that one trunk adapts
MODELS: dict[str, dict[str, Any]] = {
    "glassllm": {"batch": 64, "peer": (2, 10), "ours": (2, 22), "layers": 2},
    "smollm2": {"batch": 16, "peer": (1, 3), "ours": (1, 4), "layers": 10},
}
LAYOUTS: dict[str, dict[str, Any]] = {
    "full": {"tune": "full", "critic": "separate", "learning_rate": 1e-5},
    "one trunk, head": {"tune": "lora", "lora_rank": 32, "critic": "head"},
    "one trunk, adapter": {"tune": "lora", "lora_rank": 32, "critic": "adapter"},
}


def ours(job: dict[str, Any]) -> dict[str, Any]:
    """Our side of one run: reward model on the trunk or, in full fine-tuning, one with its own."""
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
    parts = ("time/generate_seconds", "time/score_seconds", "time/update_seconds", "time/seconds")
    inside = {name: statistics.median(row[name] for row in rows) for name in parts[:3]}
    return {"tokens": job["batch"] * job["iterations"] * TOKENS, "inside": inside}


def one_run(command: list[str], job: dict[str, Any], environment: dict[str, str]) -> dict[str, Any]:
    """A process that does the job: its wall time and memory from outside, its tokens from inside."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "result.json"
        found = run_process([*command, json.dumps(job), str(file)], environment)
        return found | json.loads(file.read_text())


def rate(
    command: list[str], job: dict[str, Any], between: tuple[int, int], environment: dict[str, str]
) -> dict:
    """Response tokens per second by difference."""
    short, long = (one_run(command, job | {"iterations": n}, environment) for n in between)
    tokens, wall = long["tokens"] - short["tokens"], long["wall"] - short["wall"]
    return {"rate": tokens / wall, "memory_mb": long["memory_mb"], "short": short, "long": long}


def make_reward(folder: str, layers: int | None, out: Path) -> str:
    """A reward model of the same trunk; how good it is does not matter for its speed."""
    from tightrope.language import RewardSettings, train_reward

    rows = [{"chosen": f"good film {i}", "rejected": f"bad film {i}"} for i in range(32)]
    settings = RewardSettings(model=folder, data="-", lora_layers=layers, minibatch_size=16)
    train_reward(settings, data=rows, run_dir=out)
    return str(out)


def compare(
    name: str, peer_python: str | None, pairs: int, layouts: list[str], reward: str
) -> list[dict[str, Any]]:
    """Every layout of one model beside the peer."""
    from tightrope.language.models import find_model

    shape, folder = MODELS[name], find_model(name)
    found = []
    for layout in layouts:
        values = dict(LAYOUTS[layout])
        if values["tune"] == "lora":
            values["lora_layers"] = shape["layers"]
        job = {"folder": folder, "batch": shape["batch"], "tokens": TOKENS, "threads": 2}
        mine = job | {"values": values, "reward": reward}
        contenders = {
            "tightrope": ([sys.executable, __file__, "ours"], mine, shape["ours"], our_environment())
        }
        if peer_python:
            script = [peer_python, str(HERE / "rlhf_peers.py")]
            contenders["trl"] = (script, job, shape["peer"], plain_environment())
        taken: list[dict[str, Any]] = []
        for k in range(pairs):
            order = list(contenders) if k % 2 == 0 else list(reversed(contenders))
            taken.append({who: rate(*contenders[who]) for who in order})
            rates = ", ".join(f"{who} {taken[-1][who]['rate']:,.1f}" for who in contenders)
            print(f"{name}, {layout}, pair {k + 1} of {pairs}: {rates} tokens/s", file=sys.stderr, flush=True)
        entry: dict[str, Any] = {"model": name, "layout": layout, "values": values, "batch": shape["batch"]}
        entry["pairs"] = taken
        for who in contenders:
            entry[who] = statistics.median(pair[who]["rate"] for pair in taken)
            entry[f"{who}_memory_mb"] = max(pair[who]["memory_mb"] for pair in taken)
        if "trl" in contenders:
            ratios = [pair["tightrope"]["rate"] / pair["trl"]["rate"] for pair in taken]
            entry["ratio"] = {"median": statistics.median(ratios), "low": min(ratios), "high": max(ratios)}
        found.append(entry)
    return found


def main(words: list[str] | None = None) -> None:
    """The command."""
    words = sys.argv[1:] if words is None else words
    if words and words[0] == "ours":
        Path(words[2]).write_text(json.dumps(ours(json.loads(words[1]))), encoding="utf-8")
        return
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--peer-python", help="interpreter with trl==1.12.0 and datasets")
    parser.add_argument("--models", nargs="+", choices=tuple(MODELS), default=["glassllm"])
    parser.add_argument("--layouts", nargs="+", choices=tuple(LAYOUTS), default=list(LAYOUTS))
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args(words)
    results: dict[str, Any] = {
        "date": datetime.date.today().isoformat(),
        "command": " ".join(
            ["python benchmarks/rlhf.py", *(Path(w).name if os.path.isabs(w) else w for w in words)]
        ),
        "machine": machine(),
        "versions": {name: importlib.metadata.version(name) for name in ("torch", "transformers")},
        "rows": [],
    }
    if options.peer_python:
        script = [options.peer_python, str(HERE / "rlhf_peers.py"), "versions"]
        with tempfile.TemporaryDirectory() as folder:
            run_process([*script, f"{folder}/versions.json"], plain_environment())
            results["peer"] = json.loads(Path(f"{folder}/versions.json").read_text())
    from tightrope.language.models import find_model

    with tempfile.TemporaryDirectory() as folder:
        for name in options.models:
            reward = make_reward(find_model(name), MODELS[name]["layers"], Path(folder) / name)
            results["rows"] += compare(name, options.peer_python, options.pairs, options.layouts, reward)
            options.results.parent.mkdir(parents=True, exist_ok=True)
            options.results.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    for row in results["rows"]:
        beside = f", TRL {row['trl']:,.1f}: {row['ratio']['median']:.2f} times" if "trl" in row else ""
        print(f"{row['model']:<10} {row['layout']:<20} {row['tightrope']:>9,.1f} tokens/s{beside}")


if __name__ == "__main__":
    main()
