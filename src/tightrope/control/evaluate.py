"""Episodes with a frozen policy: mean, deviation and 95 % interval of the return."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tightrope.control.environments import tasks
from tightrope.control.environments.base import Environments
from tightrope.control.environments.faults import policy_of
from tightrope.control.environments.make import make_environments
from tightrope.control.settings import EVALUATION_SEED, TrainSettings

MAX_COPIES = 10


def evaluate_agent(
    agent: Any,
    environments: Environments,
    episodes: int = 10,
    *,
    seed: int = EVALUATION_SEED,
    deterministic: bool = True,
) -> dict[str, Any]:
    """Returns and lengths of ``episodes`` episodes; normalisers and weights are not touched.

    Every copy plays its own fixed share of the episodes, so that short episodes are not counted more often
    than long ones. Gives ``mean_return``, ``std_return``, ``ci95`` (half width), ``mean_length``,
    ``episodes``, ``returns``.
    """
    rows = environments.num_envs
    share = np.array([episodes // rows + (i < episodes % rows) for i in range(rows)])
    rng = None if deterministic else np.random.default_rng([seed, 3])
    inputs, action_mask = environments.reset(seed)
    totals, lengths = np.zeros(rows), np.zeros(rows, np.int64)
    found: list[tuple[float, int]] = []
    while share.any():
        step = environments.step(agent.choose(inputs, action_mask, rng))
        real = np.ones(rows, bool) if step.phantom is None else ~step.phantom
        if step.cut is not None:  # an episode that a fault cut does not count; another one takes its place
            real &= ~step.cut
            totals[step.cut], lengths[step.cut] = 0.0, 0
        totals += np.where(real, step.rewards, 0.0)
        lengths += real
        for row in np.flatnonzero((step.terminated | step.truncated) & real):
            if share[row]:
                found.append((float(totals[row]), int(lengths[row])))
                share[row] -= 1
            totals[row], lengths[row] = 0.0, 0
        inputs, action_mask = step.inputs, step.action_mask
    return _summary(found)


def _summary(found: list[tuple[float, int]]) -> dict[str, Any]:
    returns = np.array([episode[0] for episode in found])
    std = float(returns.std(ddof=1)) if len(returns) > 1 else 0.0
    return {
        "mean_return": float(returns.mean()),
        "std_return": std,
        "ci95": 1.96 * std / math.sqrt(len(returns)),
        "mean_length": float(np.mean([episode[1] for episode in found])),
        "episodes": len(found),
        "returns": [float(x) for x in returns],
    }


def evaluation_environments(env: Any, settings: TrainSettings, episodes: int) -> Environments:
    """Copies for evaluation, in this process: at most MAX_COPIES, apart from those that train.

    Raises ValueError when the environment cannot be made a second time (a vector environment, say).
    """
    if hasattr(env, "single_observation_space"):
        raise ValueError(
            "A vector environment cannot be copied for evaluation; pass a Gymnasium id or a factory."
        )
    source: Any = settings.env if env is None else env
    backend = settings.vector_backend if settings.vector_backend in ("vector", "envpool") else "serial"
    if hasattr(source, "observation_space"):  # an instance trains already: evaluation needs copies, not it
        source = tasks.replicas(source, 2)[1]
    return make_environments(
        source,
        min(episodes, MAX_COPIES),
        backend=backend,
        squash=settings.squash,
        policy=policy_of(settings),
    )
