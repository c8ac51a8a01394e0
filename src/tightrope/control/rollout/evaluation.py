"""Episodes with a frozen policy: mean, deviation and 95 % interval of the return."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from tightrope.control.environments import copies
from tightrope.control.environments.base import Environments
from tightrope.control.environments.episode import EVALUATION
from tightrope.control.environments.faults import policy_of
from tightrope.control.environments.make import make_environments
from tightrope.control.environments.tasks import EnvSource
from tightrope.control.environments.vector import is_vector_env
from tightrope.control.settings import EVALUATION_SEED, TrainSettings
from tightrope.control.spaces.structure import Reading
from tightrope.runs import generators

MAX_COPIES = 10
SHORTEST_LIMIT = 1_000  # steps that an episode may always have


def evaluate_agent(
    agent: Any,
    environments: Environments,
    episodes: int = 10,
    *,
    seed: int = EVALUATION_SEED,
    deterministic: bool = True,
    max_steps: float = math.inf,
) -> dict[str, Any]:
    """Returns and lengths of ``episodes`` episodes; normalisers and weights are not touched.

    Every copy plays its own fixed share of the episodes, so that short episodes are not counted more often
    than long ones. One that has not ended after ``max_steps`` counts as it stands, and its copy waits for the
    others: then all are reset. Gives ``mean_return``, ``std_return``, ``ci95`` (half width), ``mean_length``,
    ``episodes``, ``returns``, ``cut_episodes``, and where episodes tell (masks.py), ``success_rate``, in
    which a cut one is a failure.
    The global generators start from ``seed``, and continue afterwards as if nothing had been drawn.
    """
    with generators.apart(seed):
        return _evaluated(agent, environments, episodes, seed, deterministic, max_steps)


def _evaluated(
    agent: Any,
    environments: Environments,
    episodes: int,
    seed: int,
    deterministic: bool,
    max_steps: float,
) -> dict[str, Any]:
    rows = environments.num_envs
    share = np.array([episodes // rows + (i < episodes % rows) for i in range(rows)])
    rng = None if deterministic else np.random.default_rng([seed, 3])
    inputs, action_mask = environments.reset(seed, EVALUATION)
    totals, lengths, waits = np.zeros(rows), np.zeros(rows, np.int64), np.zeros(rows, bool)
    found: list[tuple[float, int]] = []
    successes: list[float] = []
    cut = 0
    while share.any():
        step = environments.step(agent.choose(inputs, action_mask, rng))
        real = np.ones(rows, bool) if step.phantom is None else ~step.phantom
        if step.cut is not None:  # an episode that a fault cut does not count; another one takes its place
            real &= ~step.cut
            totals[step.cut], lengths[step.cut] = 0.0, 0
        totals += np.where(real, step.rewards, 0.0)
        lengths += real
        ends, counts = (step.terminated | step.truncated) & real, (share > 0) & ~waits
        late = (lengths >= max_steps) & counts & ~ends
        for row in np.flatnonzero(ends | late):
            if counts[row]:
                found.append((float(totals[row]), int(lengths[row])))
                share[row] -= 1
                if step.success is not None and ends[row] and not math.isnan(step.success[row]):
                    successes.append(float(step.success[row]))
            totals[row], lengths[row] = 0.0, 0
        cut, waits = cut + int(late.sum()), waits | late
        inputs, action_mask = step.inputs, step.action_mask
        if waits.any() and share.any() and not share[~waits].any():
            again = np.random.SeedSequence([seed, int(share.sum())]).generate_state(1)[0] >> 2
            inputs, action_mask = environments.reset(int(again))
            totals[:], lengths[:], waits[:] = 0.0, 0, False
    if cut and (successes or agent.episodes.successes):  # what was cut did not reach its goal in time
        successes += [0.0] * cut
    rate = {"success_rate": float(np.mean(successes))} if successes else {}
    return _summary(found) | {"cut_episodes": cut} | rate


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


def step_limit(settings: TrainSettings, environments: Environments, longest: float) -> float:
    """Steps after which an evaluation episode is cut: ``evaluation_max_steps`` where it is given, else the
    time limit of the task, at least SHORTEST_LIMIT and twice the ``longest`` training episode that ended.

    Training ends the episodes that a deterministic policy might never end, by the noise of its actions.
    Infinite where the longest is unknown: a run of an older version, which had no limit.
    """
    if settings.evaluation_max_steps is not None:
        return settings.evaluation_max_steps
    return max(SHORTEST_LIMIT, 2 * longest, environments.max_episode_steps or 0)


def cut_text(result: Mapping[str, object], limit: float) -> str | None:
    """The line that tells how many episodes of an evaluation were cut; None: none was."""
    if not (cut := result["cut_episodes"]):
        return None
    return (
        f"{cut} of {result['episodes']} evaluation episodes had not ended after {limit:,.0f} steps and were "
        "cut: they count with their return so far. --evaluation-max-steps N moves the limit."
    )


def evaluation_environments(env: EnvSource | None, settings: TrainSettings, episodes: int) -> Environments:
    """Copies for evaluation: at most MAX_COPIES, apart from those that train, and not in this process where
    all of those are in workers.

    Raises ValueError when the environment cannot be made a second time (a vector environment, say).
    """
    if is_vector_env(env):
        raise ValueError(
            "A vector environment cannot be copied for evaluation; pass a Gymnasium id or a factory."
        )
    source: Any = settings.env if env is None else env
    own = ("vector", "envpool", "workers")
    backend = settings.vector_backend if settings.vector_backend in own else "serial"
    with generators.apart(EVALUATION_SEED):
        if isinstance(source, gym.Env):  # an instance trains already: evaluation needs copies, not it
            source = copies.replicator(source)
        return make_environments(
            source,
            min(episodes, MAX_COPIES),
            backend=backend,
            num_workers=settings.num_workers,
            env_kwargs=None if isinstance(env, gym.Env) else settings.env_kwargs,
            policy=policy_of(settings),
            reading=Reading.of(settings),
            reseed_after=settings.reseed_after,
            carried=settings.carried,
        )
