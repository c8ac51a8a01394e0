"""tightrope against stable-baselines3 (sbx, PureJaxRL): identical settings, whole processes.

    python benchmarks/speed.py --peer-python VENV/bin/python   # half an hour; nothing else should run
    python benchmarks/speed.py --quick                         # one pair, a few steps: does it work?
    python benchmarks/speed.py --render                        # the results into docs/performance.md

Installs nothing. A peer runs in its own interpreter (default: this one, if it can import the peer).
PureJaxRL takes part on CartPole if the environment variable PUREJAXRL names the folder of its ppo.py.

How a rate is measured: each measurement is two fresh processes, one with n1 and one with n2 steps, timed from
outside, and rate = (n2 - n1) / (wall2 - wall1). Imports, compilation, creating the environments and the last
save cost both the same and cancel out. What remains is the whole training loop, including metrics written to
a file. n2 - n1 is seconds of training even for us. Measurements come in pairs (A B, then B A ...), and the
ratio is the median of the ratios within pairs, so that a temporary slowdown of the machine affects both
sides.

Both sides learn from the same number of transitions, with the same number of optimiser steps, counted by the
optimiser itself and checked (``check_work``). One difference is inherent: Gymnasium's vector CartPole spends
a row on every reset. tightrope does not count these rows as steps, collects the missing transitions, and
takes a few per cent more optimiser steps than its peer, whose environments reset within the step.
"""

from __future__ import annotations

import argparse
import contextlib
import datetime
import importlib.metadata
import json
import os
import platform
import shlex
import statistics
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import speed_report as report
from speed_runs import HERE, our_environment, plain_environment, train_ours, train_peer, written_by

ROOT = HERE.parent
RESULTS, SCALING = HERE / "results" / "speed.json", HERE / "results" / "scaling.json"
PAGE, README = ROOT / "docs" / "performance.md", ROOT / "README.md"
COMMON = {"learning_rate": 3e-4, "gamma": 0.99, "gae_lambda": 0.95, "entropy_weight": 0.01, "seed": 1}


def _scenario(
    name: str, env: str, shape: tuple[int, int, int, int], rollouts: tuple[int, int], **values: Any
) -> dict:
    num_envs, num_steps, minibatch_size, num_epochs = shape
    own = {
        "num_envs": num_envs,
        "num_steps": num_steps,
        "minibatch_size": minibatch_size,
        "num_epochs": num_epochs,
    }
    # n1 and n2 in whole rollouts; a breakdown takes as many rollouts as the difference, at most 50
    return {
        "name": name,
        "env": env,
        **own,
        **COMMON,
        **values,
        "between": rollouts,
        "rollouts": min(50, rollouts[1]),
    }


ZOO = {"learning_rate": 1e-3, "gamma": 0.98, "gae_lambda": 0.8}
SCENARIOS = (
    _scenario("cartpole-small", "CartPole-v1", (8, 256, 64, 10), (4, 54)),
    _scenario("cartpole-zoo", "CartPole-v1", (8, 32, 256, 20), (16, 416), **ZOO),
    _scenario("cartpole-large", "CartPole-v1", (64, 128, 2048, 4), (4, 54)),
    _scenario("lunarlander", "LunarLander-v3", (8, 256, 64, 10), (2, 27)),
    _scenario("halfcheetah", "HalfCheetah-v5", (8, 256, 64, 10), (2, 27)),
)
LEAST_SECONDS = 1.0  # of training between n1 and n2; start-up varies by a tenth of that
QUICK = {"cartpole-zoo": (2, 22), "cartpole-large": (1, 4)}  # the others: (1, 4) rollouts too


def measure(train: Any, between: tuple[int, int], least_seconds: float) -> dict[str, Any]:
    """A rate by difference; measured again if other work on the machine spoiled the difference."""
    for attempt in range(3):
        short, long = train(between[0]), train(between[1])
        if "call_seconds" in long:  # one compiled call, timed by the peer itself
            return {"rate": long["steps"] / long["call_seconds"], "short": short, "long": long}
        with contextlib.suppress(ValueError) if attempt < 2 else contextlib.nullcontext():
            return {"rate": report.rate(short, long, least_seconds), "short": short, "long": long}
    raise AssertionError("unreachable")


def start_up(scenario: dict[str, Any]) -> dict[str, float]:
    """A short run with an empty cache, then again: the one-time cost of compiling, in time and memory."""
    with tempfile.TemporaryDirectory() as cache:
        cold = train_ours(scenario, 1, watch_memory=True, XDG_CACHE_HOME=cache)
        warm = [train_ours(scenario, 1, XDG_CACHE_HOME=cache) for _ in range(3)]
    return {
        "cold_seconds": cold["wall"],
        "cold_memory_mb": cold["memory_mb"],
        "warm_seconds": statistics.median(run["wall"] for run in warm),
        "warm_memory_mb": max(run["memory_mb"] for run in warm),
    }


def compare(
    scenario: dict[str, Any], peers: dict[str, str], pairs: int, least_seconds: float
) -> dict[str, Any]:
    """All measurements of one scenario; ``peers``: name -> interpreter."""
    contenders: dict[str, Any] = {"tightrope": lambda n, **more: train_ours(scenario, n, **more)}
    if not scenario["env"].startswith("CartPole"):
        peers = {peer: python for peer, python in peers.items() if peer != "purejaxrl"}
    for peer, python in peers.items():
        contenders[peer] = lambda n, peer=peer, python=python, **more: train_peer(
            peer, python, scenario, n, **more
        )
    memory = {
        name: train(scenario["between"][0], watch_memory=True)["memory_mb"]
        for name, train in contenders.items()
    }
    inside = written_by(
        [sys.executable, str(HERE / "speed_inside.py"), json.dumps(scenario)], our_environment()
    )
    found: list[dict[str, Any]] = []
    for k in range(pairs):
        order = list(contenders) if k % 2 == 0 else list(reversed(contenders))
        found.append({name: measure(contenders[name], scenario["between"], least_seconds) for name in order})
        rates = ", ".join(f"{name} {found[-1][name]['rate']:,.0f}" for name in contenders)
        _say(f"{scenario['name']} pair {k + 1} of {pairs}: {rates} steps/s")
    rates = {name: [pair[name]["rate"] for pair in found] for name in contenders}
    return scenario | {
        "pairs": found,
        "rates": {name: statistics.median(values) for name, values in rates.items()},
        "ratios": {peer: report.ratio(rates["tightrope"], rates[peer]) for peer in peers},
        "memory_mb": memory,
        **inside,
    }


def machine() -> dict[str, Any]:
    """CPU, usable cores, system."""
    cpu = platform.processor() or platform.machine()
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {"cpu": cpu, "cores": cores, "system": f"{platform.system()} {platform.machine()}"}


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in ("torch", "numba", "numpy", "scipy", "gymnasium"):
        found[name] = importlib.metadata.version(name)
    return found


def _find_peers(python: str, wanted: list[str] | None) -> dict[str, dict[str, str]]:
    """The peers that this interpreter can import, with versions. ValueError if a requested one is missing."""
    found = written_by([python, str(HERE / "speed_peers.py"), "versions"], plain_environment())
    missing = [peer for peer in wanted or [] if peer not in found]
    if missing:
        raise ValueError(
            f"{python} cannot import {', '.join(missing)}. Name another one with --peer-python PATH."
        )
    return {peer: versions for peer, versions in found.items() if wanted is None or peer in wanted}


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _scenarios(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    for scenario in SCENARIOS:
        if options.scenarios is None or scenario["name"] in options.scenarios:
            quick = {"between": QUICK.get(scenario["name"], (1, 4)), "rollouts": 5} if options.quick else {}
            yield scenario | quick | {"peer_vec": options.peer_vec}


def benchmark(options: argparse.Namespace) -> dict[str, Any]:
    """All measurements; the file is written after every scenario."""
    peers = _find_peers(options.peer_python, options.peers)
    if not peers:
        _say(f"{options.peer_python} imports no peer: only tightrope is measured. See --peer-python.")
    _say("start-up with an empty cache")
    results: dict[str, Any] = {
        "date": datetime.date.today().isoformat(),
        "command": shlex.join(["python", "benchmarks/speed.py", *_public_words(sys.argv[1:])]),
        "quick": options.quick,
        "machine": machine(),
        "versions": _versions(),
        "peers": peers,
        "start_up": start_up(SCENARIOS[0]),
        "scenarios": [],
    }
    kept = _kept(options)
    results["scenarios"], results["peers"] = kept.get("scenarios", []), kept.get("peers", {}) | peers
    if "command" in kept:
        results["command"] = f"{kept['command']}; then {results['command']}"
    train_ours(SCENARIOS[0], 1)  # everything it had to compile is in the usual cache from here on
    for scenario in _scenarios(options):
        pairs, least = (1, 0.0) if options.quick else (options.pairs, LEAST_SECONDS)
        found = compare(scenario, dict.fromkeys(peers, options.peer_python), pairs, least)
        results["scenarios"].append(found)
        results["scenarios"].sort(key=lambda s: [known["name"] for known in SCENARIOS].index(s["name"]))
        results["sgemm_gflops"] = max(s["sgemm_gflops"] for s in results["scenarios"])
        if options.results is not None:
            options.results.parent.mkdir(parents=True, exist_ok=True)
            options.results.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    return results


def _kept(options: argparse.Namespace) -> dict[str, Any]:
    """Only with --scenarios: the peers and the unmeasured scenarios of an earlier results file."""
    if options.scenarios is None or options.results is None or not options.results.exists():
        return {}
    earlier = json.loads(options.results.read_text(encoding="utf-8"))
    scenarios = [s for s in earlier["scenarios"] if s["name"] not in options.scenarios]
    kept = {"scenarios": scenarios, "peers": earlier["peers"], "command": earlier["command"]}
    return kept if scenarios else {}


def _public_words(words: list[str]) -> list[str]:
    """The command line without this machine's folders."""
    return [Path(word).name if os.path.isabs(word) else word for word in words]


def render(page: Path, results: Path, scaling: Path) -> None:
    """Fill the page's blocks with the figures of the two files; missing blocks and files are skipped."""
    text = page.read_text(encoding="utf-8")
    for name, file, words in (
        ("speed", results, report.speed_text),
        ("readme-speed", results, report.short_text),
        ("scaling", scaling, report.scaling_text),
    ):
        if file.exists() and f"<!-- {name} -->" in text:
            text = report.fill(text, name, words(json.loads(file.read_text(encoding="utf-8"))))
    page.write_text(text, encoding="utf-8")


def _options(words: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--pairs", type=int, default=5, help="measurements of each contender, in turn (default 5)"
    )
    parser.add_argument(
        "--quick", action="store_true", help="one pair of short runs; writes no file unless --results"
    )
    names = [scenario["name"] for scenario in SCENARIOS]
    parser.add_argument(
        "--scenarios",
        nargs="+",
        choices=names,
        help="only these, the others in the results file stay (default: all)",
    )
    parser.add_argument(
        "--peer-python", default=sys.executable, help="interpreter with stable-baselines3 (and sbx)"
    )
    parser.add_argument(
        "--peers",
        nargs="+",
        help="only these peers: stable-baselines3, sbx, purejaxrl (default: those found)",
    )
    parser.add_argument(
        "--peer-vec", choices=("dummy", "subproc"), default="dummy", help="the peers' environments"
    )
    parser.add_argument(
        "--results", type=Path, help=f"JSON file to write (default {RESULTS.relative_to(ROOT)})"
    )
    parser.add_argument(
        "--render", action="store_true", help="measure nothing: results into docs/performance.md"
    )
    return parser.parse_args(words)


def main(words: list[str] | None = None) -> None:
    """The command."""
    options = _options(words)
    if options.results is None and (options.render or not options.quick):
        options.results = RESULTS
    if options.render:
        for page in (PAGE, README):
            render(page, options.results, SCALING)
        return
    print(report.speed_text(benchmark(options)))


if __name__ == "__main__":
    main()
