"""A rollout, the Batch that update rules learn from (values, advantages, returns), and the training episodes
that ended last.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
import torch

from tightrope.algorithms.batch import Batch, moved_scale
from tightrope.algorithms.settings import ReinforceSettings, UpdateSettings
from tightrope.control.engine.base import Engine, Steps
from tightrope.control.environments.base import Environments
from tightrope.control.environments.faults import FailedEpisode
from tightrope.control.policy.normalise import EDGE, Normalisers
from tightrope.control.spaces.structure import Array, Inputs
from tightrope.maths.values import ReturnScale
from tightrope.runs.checkpoint import counted


class Rollout:
    """What happened in T steps of B environments, in arrays [B, T, ...] that are allocated once.

    ``mask`` False: not a transition. That is NEXT_STEP's reset row, or, with ``ended`` beside it, the step in
    which an environment failed and was restarted; its input is the last observation of the episode that was
    cut, from whose value the step before it is bootstrapped.

    ``inputs``: what the policy saw (normalised). ``raw``: flat observations, and ``rewards``, unchanged.
    ``last``: encoded observation after the last step. ``finals``: (column, rows, encoded true final
    observations) of truncated episodes whose next row already belongs to a new episode.
    """

    def __init__(self, environments: Environments, num_steps: int, *, has_masks: bool) -> None:
        layout = environments.observation_layout
        actions = environments.action_layout
        shape = (environments.num_envs, num_steps)
        self.inputs: Inputs = {
            name: np.zeros((*shape, *x.shape[1:]), np.float32 if name == "flat" else x.dtype)
            for name, x in layout.allocate(0).items()
        }
        self.raw = np.zeros((*shape, layout.size), np.float64)
        if has_masks:
            self.inputs["action_mask"] = np.ones((*shape, actions.num_logits), bool)
        self.actions = np.zeros((*shape, actions.num_columns), np.float32)
        self.logp = np.zeros(shape, np.float32)
        self.rewards = np.zeros(shape, np.float64)
        self.terminated = np.zeros(shape, bool)
        self.truncated = np.zeros(shape, bool)
        self.mask = np.ones(shape, bool)
        self.ended = np.zeros(shape, bool)
        self.last: Inputs = {}
        self.finals: list[tuple[int, Array, Inputs]] = []
        self.origins: list[tuple[int, Array]] = []  # (column in which episodes ended, origins after it)
        self.episodes: list[tuple[float, int, bool]] = []
        self.successes: list[float] = []  # of the episodes that said whether they reached their goal
        self.seeds: list[tuple[int | None, int]] = []  # of these episodes, see Update
        self.reward_statistics_taken = False
        self.warm_up = 0  # steps before it that are not learned from
        self.failed: list[FailedEpisode] = []  # of copies that were restarted
        self.env_seconds = 0.0
        self.restarts: int | None = None  # of environments; None: the settings do not allow it

    @property
    def steps(self) -> int:
        """How many transitions there are, those of the warm-up included."""
        return int(self.mask.sum()) + self.warm_up

    def counts(self) -> dict[str, Any]:
        """What is told of a rollout beside its arrays; ``warm_up``: its steps, if it is not learned from."""
        names = ("episodes", "successes", "seeds", "failed", "env_seconds", "restarts")
        found = {name: getattr(self, name) for name in names} | {"warm_up": self.steps}
        return {name: x for name, x in found.items() if x is not None}

    def clear(self) -> None:
        """Make the arrays ready to be filled again."""
        self.mask.fill(True)
        self.ended.fill(False)
        self.finals = []
        self.successes = []
        self.origins = []
        self.reward_statistics_taken = False
        self.warm_up = 0


def cut_shares(rollout: Rollout, environments: Environments, normalisers: Normalisers) -> dict[str, float]:
    """The shares of a rollout's numbers that were cut off at a bound, or pressed together as outliers."""
    clipped = environments.action_layout.clipped_share(rollout.actions[rollout.mask])
    found = {} if clipped is None else {"rollout/action_clip_fraction": clipped}
    if normalisers.observations is not None:
        columns = normalisers.observations.continuous
        far = np.abs(rollout.inputs["flat"][rollout.mask][:, columns]) >= EDGE
        found["rollout/observation_outlier_fraction"] = float(far.mean()) if far.size else 0.0
    return found


def to_batch(
    rollout: Rollout,
    engine: Engine,
    normalisers: Normalisers,
    settings: UpdateSettings,
    critic_lambda: float | None = None,
    *,
    move: bool = False,
) -> Batch:
    """Values, advantages and returns of a rollout, as a Batch [B, T] in the scale of returns.

    The returns, which the critic learns, have ``critic_lambda`` (None: the lambda of advantages).
    ``move``: first the scale moves to these returns, and the critic's last layer with it, so that values
    stay; a module of the user's has to follow by learning.
    """
    rewards = rollout.rewards if normalisers.rewards is None else normalisers.scaled_rewards(rollout)
    scale = normalisers.returns or ReturnScale(deviation=1.0)
    values, following = (scale.values(torch.from_numpy(x)).numpy() for x in critic_values(rollout, engine))
    mask = rollout.mask
    if isinstance(settings, ReinforceSettings) and not settings.baseline:
        mask = mask & finished(rollout.ended, mask)
        values = np.zeros_like(values)
        following = np.zeros_like(values)
    steps = Steps(rewards, values, following, rollout.terminated, rollout.ended, mask)
    lambdas = [x for x in (settings.gae_lambda, critic_lambda) if x is not None]
    estimates = [engine.gae(steps, settings.gamma, x) for x in lambdas]
    advantages, learned = estimates[0], estimates[-1]

    def tensor(array: Array) -> torch.Tensor:
        return torch.from_numpy(array).to(engine.device)

    batch = Batch(
        inputs={name: tensor(x) for name, x in rollout.inputs.items()},
        actions=tensor(rollout.actions),
        old_logp=tensor(rollout.logp),
        old_values=tensor(values),
        advantages=tensor(advantages),
        returns=tensor(learned + values),
        mask=tensor(mask),
    )
    kept = settings.normalise_advantages
    if move and normalisers.returns is not None:
        batch, normalisers.returns, _ = moved_scale(
            batch, normalisers.returns, engine.policy.last_critic_layer, advantages=kept
        )
        return batch
    return batch.in_scale(normalisers.returns, advantages=kept)


def critic_values(rollout: Rollout, engine: Engine) -> tuple[Array, Array]:
    """The critic's output for every observation, and for the true next observation of every step, [B, T].

    The second differs from a shift of the first at the end of the rollout and at truncations.
    """
    observed = {name: x.reshape(-1, *x.shape[2:]) for name, x in rollout.inputs.items()}
    finals = [inputs for _, _, inputs in rollout.finals]
    groups = [observed, rollout.last]
    if finals:
        groups.append({name: np.concatenate([x[name] for x in finals]) for name in finals[0]})
    values, last_values, *final_values = [engine.values(group) for group in groups]
    values = values.reshape(rollout.logp.shape)
    following = np.concatenate([values[:, 1:], last_values[:, None]], axis=1)
    if finals:
        rows = np.concatenate([rows for _, rows, _ in rollout.finals])
        columns = np.concatenate([np.full(len(rows), t) for t, rows, _ in rollout.finals])
        following[rows, columns] = final_values[0]
    return values, following


def finished(ended: Array, mask: Array) -> Array:
    """True [B, T] for steps whose episode ends inside the rollout, other than by a fault that cut it.

    A fault is ``ended`` where ``mask`` is False.
    """
    found = np.zeros_like(ended)
    complete = np.zeros(len(ended), bool)
    for t in range(ended.shape[1] - 1, -1, -1):
        complete = np.where(ended[:, t], mask[:, t], complete)
        found[:, t] = complete
    return found


RECENT = 100  # episodes that rollout/ep_rew_mean and its like are means of, as in stable-baselines3


class FinishedEpisodes:
    """Returns, lengths and successes of the last RECENT episodes, and the longest of all.

    ``longest``: steps; infinity where it is not known, after a checkpoint of an older version.
    """

    def __init__(self) -> None:
        self._newest: deque[tuple[float, int]] = deque(maxlen=RECENT)  # return, length
        self.successes: deque[float] = deque(maxlen=RECENT)
        self.longest: float = 0
        self._heard: int | None = 0  # when an episode last finished; None: it was told that none does

    def silence(self, rollout: Rollout, step: int, budget: int, longest: int, usual: int) -> str | None:
        """A line after a rollout, once, where no episode has ended for a quarter of the budget, and not
        because they are just long. ``longest``: steps of the longest that runs; ``usual``: of one that is not
        too long.
        """
        if rollout.episodes and self._heard is not None:
            self._heard = step
        if self._heard is None or step - self._heard <= budget / 4 or longest <= usual:
            return None
        since = f"since step {self._heard:,}" if self._heard else "so far"
        self._heard = None
        return (
            f"No episode has finished {since}, at step {step:,}; the longest has run for {longest:,} steps. "
            "Returns are counted when an episode ends. If episodes should end, look at when the task "
            "terminates, or give it a time limit (gymnasium.wrappers.TimeLimit)."
        )

    def add(self, rollout: Rollout) -> dict[str, float]:
        """Count the episodes of a rollout; the metrics of these and of the last RECENT ones."""
        here = [(episode[0], episode[1]) for episode in rollout.episodes]
        self._newest.extend(here)
        self.successes.extend(rollout.successes)
        self.longest = max([self.longest, *(length for _, length in here)])
        found = {"rollout/episodes": float(len(here))}
        for name, episodes in (("ep", self._newest), ("new_ep", here)):
            if episodes:
                found[f"rollout/{name}_rew_mean"], found[f"rollout/{name}_len_mean"] = np.mean(
                    episodes, axis=0
                ).tolist()
        if self.successes:
            found["rollout/success_rate"] = float(np.mean(self.successes))
        return found

    def state(self) -> dict[str, Any]:
        """What `restore` needs, as JSON."""
        longest = self.longest if math.isfinite(self.longest) else None
        return {"newest": list(self._newest), "successes": list(self.successes), "longest": longest}

    def restore(self, state: dict[str, Any]) -> None:
        """Put back a `state`; an empty one is that of an older version."""
        longest = state.get("longest")
        self.longest = math.inf if longest is None else counted(longest)
        newest = [(float(total), counted(length)) for total, length in state.get("newest", [])]
        successes = [float(success) for success in state.get("successes", [])]
        if not np.isfinite([*(total for total, _ in newest), *successes]).all():
            raise ValueError("a return or a success of the finished episodes is not finite")
        self._newest.clear()
        self._newest.extend(newest)
        self.successes.clear()
        self.successes.extend(successes)
