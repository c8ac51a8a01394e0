"""``tightrope evaluate``: how good the policy of a run folder, or of a saved agent, is."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tightrope.control.environments.tasks import EnvSource
from tightrope.control.policy.policy import OwnPolicy
from tightrope.control.rollout.evaluation import (
    cut_text,
    evaluate_agent,
    evaluation_environments,
    step_limit,
)
from tightrope.control.saving import load
from tightrope.control.settings import EVALUATION_SEED, TrainSettings


def evaluate_run(
    path: str | Path,
    *,
    episodes: int = 100,
    stochastic: bool = False,
    best: bool = False,
    seed: int | None = None,
    env: EnvSource | None = None,
    env_kwargs: Mapping[str, object] | None = None,
    policy: OwnPolicy | None = None,
    device: str = "cpu",
    evaluation_max_steps: int | None = None,
) -> dict[str, Any]:
    """Evaluate the policy of a run or of a saved folder; see `load` and `evaluate_agent`.

    ``max_steps`` in the result: where an episode is cut, None where nothing cuts it; ``evaluation_max_steps``
    None: as in training.
    """
    if type(episodes) is not int or episodes < 1:
        raise ValueError(f"episodes is {episodes!r}, expected a whole number from 1 on.")
    if evaluation_max_steps is not None:
        TrainSettings().with_values(evaluation_max_steps=evaluation_max_steps)  # refuses the same values
    agent = load(
        path, env=env, env_kwargs=env_kwargs, policy=policy, best=best, device=device, engine="torch"
    )  # nothing is learnt
    try:
        environments = evaluation_environments(agent.env, agent.settings, episodes)
        seed = EVALUATION_SEED if seed is None else seed
        limit = step_limit(agent.settings, environments, agent.episodes.longest)
        limit = limit if evaluation_max_steps is None else evaluation_max_steps
        how: dict[str, Any] = {"seed": seed, "deterministic": not stochastic, "max_steps": limit}
        result = evaluate_agent(agent, environments, episodes, **how)
        environments.close()
    finally:
        agent.close()
    if text := cut_text(result, limit):
        warnings.warn(text, stacklevel=2)
    how["max_steps"] = limit if math.isfinite(limit) else None
    return {**result, "step": agent.steps, **how}
