"""The torch engine: any policy, any device, every setting. The compiled engine is checked against it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from tightrope.algorithms import a2c, ppo, reinforce
from tightrope.algorithms.batch import Batch
from tightrope.algorithms.settings import UpdateSettings
from tightrope.control.engine.base import Acted, Steps
from tightrope.control.policy.normalise import ObservationNormaliser
from tightrope.control.policy.policy import Policy
from tightrope.control.settings import TrainSettings
from tightrope.control.spaces.structure import Array, Inputs
from tightrope.maths import returns

ALGORITHMS = {"ppo": ppo, "a2c": a2c, "reinforce": reinforce}
IMAGES_AT_ONCE = 1024  # in one pass of the critic, to save memory


class TorchEngine:
    """See Engine."""

    name = "torch"

    def __init__(self, policy: Policy, optimiser: torch.optim.Optimizer, settings: TrainSettings) -> None:
        self.policy = policy
        self.optimiser = optimiser
        self.algorithm = ALGORITHMS[settings.algorithm]
        self.gsde_steps = settings.gsde_steps
        self.device = policy.device
        self.model: Any = policy
        if settings.compile:
            cuda = self.device.type == "cuda"
            mode = "reduce-overhead" if cuda else "default"  # the former uses CUDA graphs
            self.model = torch.compile(policy, mode=mode, dynamic=not cuda)

    def begin_rollout(self, num_envs: int, rng: np.random.Generator) -> None:
        """Remember what gSDE draws its matrices from; the first `act` draws them."""
        self._num_envs = num_envs
        self._rng = rng
        self._steps = 0

    def act(
        self,
        inputs: Inputs,
        normaliser: ObservationNormaliser | None,
        action_mask: Array | None,
        noise: Array,
        rows: slice,
        out: Acted,
    ) -> None:
        """See Engine."""
        if self.policy.gsde and rows.stop == self._num_envs:  # the first row group of a step has the last row
            if self._steps % self.gsde_steps == 0:
                self.policy.hold_exploration(self._num_envs, self._rng)
            self._steps += 1
        for name, x in inputs.items():
            normalise = normaliser is not None and name == "flat"
            out.inputs[name][:] = normaliser(x[rows]) if normalise else x[rows]  # type: ignore[misc]
        if action_mask is not None:
            out.inputs["action_mask"][:] = action_mask[rows]
        actions, logp = self.policy.act(out.inputs, noise[rows], rows)
        out.actions[:] = actions.cpu().numpy()
        out.logp[:] = logp.cpu().numpy()

    @torch.no_grad()
    def values(self, inputs: Inputs) -> Array:
        """See Engine."""
        total = len(next(iter(inputs.values())))
        size = IMAGES_AT_ONCE if any(name.startswith("image") for name in inputs) else total
        parts = [
            self.policy.values({name: x[i : i + size] for name, x in inputs.items()})
            for i in range(0, total, size)
        ]
        return torch.cat(parts).float().cpu().numpy()

    def gae(self, steps: Steps, gamma: float, gae_lambda: float) -> Array:
        """See Engine."""
        tensors = {name: torch.from_numpy(x) for name, x in steps._asdict().items()}  # float64
        return returns.gae(**tensors, gamma=gamma, gae_lambda=gae_lambda).numpy()

    def update(
        self,
        batch: Batch,
        settings: UpdateSettings,
        rng: np.random.Generator,
        *,
        refresh: Callable[[Batch], Batch] | None = None,
        log_ratio_limit: float | None = None,
    ) -> dict[str, float]:
        """The algorithm's update, on single steps: no policy here remembers earlier ones."""
        return self.algorithm.update(
            self.model, self.optimiser, batch.as_steps(), settings, rng,
            refresh=refresh, log_ratio_limit=log_ratio_limit,
        )  # fmt: skip

    def close(self) -> None:
        """Nothing to end."""
