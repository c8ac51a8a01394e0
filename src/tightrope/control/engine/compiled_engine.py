"""The compiled CPU engine, behind the interface that it shares with torch."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from tightrope.algorithms.batch import Batch
from tightrope.algorithms.settings import PPOSettings, UpdateSettings
from tightrope.control.engine.base import Acted, Array
from tightrope.control.engine.compiled.fused import FusedEngine
from tightrope.control.policy.normalise import CLIP, ObservationNormaliser
from tightrope.control.policy.policy import Policy

CHECK_LIMIT = 1e-4  # largest difference of a parameter after one minibatch


class CompiledEngine:
    """See Engine. It works on the memory of the torch parameters and of torch's Adam."""

    name = "fused"
    device = torch.device("cpu")

    def __init__(self, policy: Policy, optimiser: torch.optim.Optimizer, threads: int) -> None:
        self.policy = policy
        self.fused = FusedEngine(policy, optimiser, threads)
        self.gae = self.fused.gae

    def begin_rollout(self, num_envs: int, rng: np.random.Generator) -> None:
        """Attach to parameters whose memory was replaced since the last update."""
        self.fused.attach()

    def act(
        self,
        inputs: dict[str, Array],
        normaliser: ObservationNormaliser | None,
        action_mask: Array | None,
        noise: Array,
        rows: slice,
        out: Acted,
    ) -> None:
        """See Engine."""
        mean, inverse_std = (None, None) if normaliser is None else (normaliser.mean, normaliser.inverse_std)
        mask = None
        if action_mask is not None:
            mask = action_mask[rows]
            out.inputs["action_mask"][:] = mask
        flat = inputs["flat"][rows]
        self.fused.act(
            flat, mean, inverse_std, CLIP, mask, noise[rows], out.actions, out.logp, out.inputs["flat"]
        )

    def values(self, inputs: dict[str, Array]) -> Array:
        """See Engine."""
        return self.fused.values(inputs["flat"])

    def update(
        self,
        optimiser: torch.optim.Optimizer,
        batch: Batch,
        settings: UpdateSettings,
        rng: np.random.Generator,
        **more: Any,
    ) -> dict[str, float]:
        """ppo.update, compiled."""
        assert isinstance(settings, PPOSettings)
        return self.fused.update(self.policy, optimiser, batch, settings, rng, **more)

    def check(self, batch: Batch, settings: UpdateSettings) -> str:
        """Compare one minibatch with ppo.py, on copies: a line with the largest difference of a parameter.

        Raises RuntimeError when the difference is above CHECK_LIMIT.
        """
        assert isinstance(settings, PPOSettings)
        difference = self.fused.check_first_minibatch(batch, settings)
        if not difference <= CHECK_LIMIT:
            raise RuntimeError(
                f"After one minibatch the compiled engine differs from ppo.py by {difference:.2g} in a "
                f"parameter (limit {CHECK_LIMIT:g}). Train with --engine torch, and please report this with "
                "your settings.json."
            )
        return f"engine check: one minibatch by ppo.py and compiled, largest difference {difference:.1e}"

    def close(self) -> None:
        """End the helping thread."""
        self.fused.close()
