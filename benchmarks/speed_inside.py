"""How tightrope spends its time: one run with timers around environments, actor, values and update.

    python speed_inside.py '{"env": "CartPole-v1", "num_envs": 8, ...}' RESULT.json

The timers cost about a microsecond per step, so do not take speeds from here. This file also measures the
unit of the floor: float32 products of 64 x 64 x 64 on one core.
"""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from speed_report import MATRIX, PARTS, tightrope_settings, update_flops

WARM_ROLLOUTS = 3


def clocked(owner: Any, name: str, label: str, seconds: Counter[str]) -> None:
    """From now on, add the time spent in ``owner.name`` to ``seconds[label]``."""
    function = getattr(owner, name)

    def call(*arguments: Any, **keywords: Any) -> Any:
        begin = time.perf_counter()
        try:
            return function(*arguments, **keywords)
        finally:
            seconds[label] += time.perf_counter() - begin

    setattr(owner, name, call)


def breakdown(scenario: dict[str, Any], rollouts: int) -> dict[str, Any]:
    """Microseconds per step of all environments by part, and per minibatch update."""
    import torch

    import tightrope

    agent = tightrope.PPO(scenario["env"], **tightrope_settings(scenario))
    updates = agent.iterate(10**9)
    for _ in range(WARM_ROLLOUTS):
        next(updates)
    seconds: Counter[str] = Counter()
    clocked(agent.environments, "send", "env", seconds)
    clocked(agent.environments, "receive", "env", seconds)
    clocked(agent.engine, "act", "act", seconds)
    clocked(agent.engine, "values", "advantages", seconds)
    clocked(agent.engine, "gae", "advantages", seconds)
    clocked(agent.engine, "update", "update", seconds)
    minibatches, begin = 0.0, time.perf_counter()
    for _ in range(rollouts):
        minibatches += next(updates).metrics["train/minibatches"]
    seconds["rest"] = time.perf_counter() - begin - sum(seconds.values())
    networks = [
        [linears[0].in_features, *(linear.out_features for linear in linears)]
        for part in (agent.policy.actor, agent.policy.critic)
        if (linears := [module for module in part if isinstance(module, torch.nn.Linear)])
    ]
    result = {part: 1e6 * seconds[part] / (rollouts * scenario["num_steps"]) for part in PARTS}
    result |= {
        "minibatch_microseconds": 1e6 * seconds["update"] / minibatches,
        "flops": update_flops(networks, scenario["minibatch_size"]),
        "engine": agent.engine.name,
        "backend": agent.environments.backend,
        "rollouts": rollouts,
    }
    agent.close()
    return result


def sgemm_gflops(seconds: float = 1.0) -> float:
    """The best rate of 64 x 64 x 64 float32 products on one core; one call into numpy makes 32 of them."""
    import threadpoolctl

    count = 32
    rng = np.random.default_rng(0)
    a, b = (rng.standard_normal((MATRIX, MATRIX), dtype=np.float32) for _ in range(2))
    left, right = np.broadcast_to(a, (count, *a.shape)), np.broadcast_to(b, (count, *b.shape))
    out = np.empty(left.shape, np.float32)
    best, end = np.inf, time.perf_counter() + seconds
    with threadpoolctl.threadpool_limits(1, user_api="blas"):
        while time.perf_counter() < end:
            begin = time.perf_counter()
            for _ in range(20):
                np.matmul(left, right, out=out)
            best = min(best, time.perf_counter() - begin)
    return 20 * count * 2 * MATRIX**3 / best / 1e9


def main(words: list[str]) -> None:
    """Measure and write the result file."""
    scenario = json.loads(words[0])
    result = {"breakdown": breakdown(scenario, scenario["rollouts"]), "sgemm_gflops": sgemm_gflops()}
    Path(words[1]).write_text(json.dumps(result), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
