"""Cost grows linearly: with the steps of a run, the number of environments, the parameters of the networks.

    python benchmarks/scaling.py                # two minutes; nothing else should run

Every point is the smallest of several timings, because other programs can only add time. Two fits describe a
series: cost = a + b x by least squares, with 1 - R^2 as the unexplained share, and the exponent p of cost ~
x^p through the points: 1 is linear, below 1 is cheaper than linear (fixed costs, or matrix products that
become more efficient).
"""

from __future__ import annotations

import argparse
import datetime
import json
import math
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from speed_inside import clocked
from speed_report import scaling_text

RESULTS = Path(__file__).resolve().parent / "results" / "scaling.json"
REPEATS = 5
BASE: dict[str, Any] = {
    "num_envs": 8,
    "num_steps": 128,
    "minibatch_size": 64,
    "num_epochs": 4,
    "hidden": (64, 64),
    "activation": "tanh",
    "learning_rate_schedule": "constant",
    "entropy_weight": 0.01,
    "seed": 1,
}


def fit(points: Sequence[tuple[float, float]]) -> dict[str, float]:
    """Least squares cost = intercept + slope x, its 1 - R^2 ("spread"), and the exponent of cost ~ x^p."""
    x, y = np.array(points, np.float64).T
    slope, intercept = np.polyfit(x, y, 1)
    residual = float(np.sum((y - intercept - slope * x) ** 2))
    total = float(np.sum((y - y.mean()) ** 2))
    exponent = float(np.polyfit(np.log(x), np.log(y), 1)[0])
    spread = residual / total if total > 0 else math.nan
    return {"intercept": float(intercept), "slope": float(slope), "spread": spread, "exponent": exponent}


def series(unit: str, points: list[tuple[float, float]]) -> dict[str, Any]:
    """A series of points with its fits."""
    return {"unit": unit, "points": points, **fit(points)}


def _agent(**values: Any) -> Any:
    import tightrope

    return tightrope.PPO("CartPole-v1", **(BASE | values))


def rollout_seconds(repeats: int, **values: Any) -> float:
    """The fastest of ``repeats`` whole updates (collect, advantages, learn), without the first one."""
    agent = _agent(**values)
    updates, best = agent.iterate(10**9), math.inf
    next(updates)
    for _ in range(repeats):
        begin = time.perf_counter()
        next(updates)
        best = min(best, time.perf_counter() - begin)
    agent.close()
    return best


def minibatch_microseconds(repeats: int, **values: Any) -> tuple[int, float]:
    """The number of parameters, and the fastest of ``repeats`` updates in microseconds per minibatch."""
    agent = _agent(**values)
    seconds: Counter[str] = Counter()
    clocked(agent.engine, "update", "update", seconds)
    updates, best = agent.iterate(10**9), math.inf
    next(updates)
    for _ in range(repeats):
        seconds.clear()
        minibatches = next(updates).metrics["train/minibatches"]
        best = min(best, 1e6 * seconds["update"] / minibatches)
    agent.close()
    return sum(p.numel() for p in agent.policy.parameters()), best


def steps_series(repeats: int) -> list[tuple[float, float]]:
    """Seconds of training at several step counts of one run; the best of a few runs."""
    marks = [8 * 128 * k for k in (4, 8, 16, 32, 64)]
    best = dict.fromkeys(marks, math.inf)
    for _ in range(max(1, repeats // 2)):
        agent = _agent(vector_backend="serial")  # every row is a step, so rollouts hit the counts exactly
        updates = agent.iterate(marks[-1] + 8 * 128)
        next(updates)
        begin, offset = time.perf_counter(), agent.steps
        for _ in updates:
            if agent.steps - offset in best:
                best[agent.steps - offset] = min(best[agent.steps - offset], time.perf_counter() - begin)
        agent.close()
    return list(best.items())


def measure(repeats: int) -> dict[str, Any]:
    """All series."""
    environments = [(n, 1e3 * rollout_seconds(repeats, num_envs=n)) for n in (8, 16, 32, 64, 128)]
    rows = [(n, 1e3 * rollout_seconds(repeats, num_steps=n)) for n in (64, 128, 256, 512)]
    widths = [minibatch_microseconds(repeats, hidden=(w, w)) for w in (32, 64, 128, 256)]
    depths = [minibatch_microseconds(repeats, hidden=(64,) * d) for d in (1, 2, 3, 4, 6, 8)]
    return {
        "steps of a run": series("seconds", steps_series(repeats)),
        "environments": series("milliseconds per rollout and its update", environments),
        "steps per rollout": series("milliseconds per rollout and its update", rows),
        "parameters, by width": series("microseconds per minibatch", [(float(p), us) for p, us in widths]),
        "parameters, by depth": series("microseconds per minibatch", [(float(p), us) for p, us in depths]),
    }


def main(words: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--repeats", type=int, default=REPEATS, help=f"timings a point (default {REPEATS})")
    parser.add_argument("--results", type=Path, default=RESULTS, help="JSON file to write")
    options = parser.parse_args(words)
    results = {
        "date": datetime.date.today().isoformat(),
        "command": "python benchmarks/scaling.py",
        "settings": {name: list(v) if isinstance(v, tuple) else v for name, v in BASE.items()},
        "series": measure(options.repeats),
    }
    options.results.parent.mkdir(parents=True, exist_ok=True)
    options.results.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    print(scaling_text(results), file=sys.stdout)


if __name__ == "__main__":
    main()
