"""Who computes: torch, which covers everything and is the truth, or the compiled CPU engine, which repeats
it.

Both have the same face: ``act``, ``values``, ``gae`` and ``update``. The choice is a pure function of the
settings.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from tightrope.algorithms import a2c, ppo, reinforce
from tightrope.algorithms.batch import Batch
from tightrope.algorithms.settings import PPOSettings, UpdateSettings
from tightrope.control.policy.normalise import CLIP, ObservationNormaliser
from tightrope.control.policy.policy import Policy
from tightrope.control.settings import TrainSettings
from tightrope.maths import returns

Array = np.ndarray
CHECK_LIMIT = 1e-4
ALGORITHMS = {"ppo": ppo, "a2c": a2c, "reinforce": reinforce}


class TorchEngine:
    """The torch path: any policy, any device, every setting."""

    name = "torch"

    def __init__(self, policy: Policy, settings: TrainSettings) -> None:
        self.policy, self.algorithm = policy, ALGORITHMS[settings.algorithm]
        self.gsde_steps = settings.gsde_steps
        self.device = policy.device
        mode = "reduce-overhead" if self.device.type == "cuda" else "default"  # the former uses CUDA graphs
        self.model = (
            torch.compile(policy, mode=mode, dynamic=self.device.type != "cuda")
            if settings.compile
            else policy
        )

    def begin_rollout(self, num_envs: int, rng: np.random.Generator) -> None:
        """Remember what gSDE draws its matrices from; the first act draws them."""
        self._num_envs, self._rng, self._act_count = num_envs, rng, 0

    def act(
        self,
        inputs: dict[str, Array],
        normaliser: ObservationNormaliser | None,
        action_mask: Array | None,
        noise: Array,
        rollout: Any,
        rows: slice,
        t: int,
    ) -> None:
        """Fill ``rows`` of column ``t`` of the rollout: inputs as seen, actions, their log-probabilities."""
        if self.policy.gsde and rows.stop == self._num_envs:  # the first wave of a step holds the last row
            if self._act_count % self.gsde_steps == 0:
                self.policy.hold_exploration(self._num_envs, self._rng)
            self._act_count += 1
        for name, x in inputs.items():
            seen = normaliser(x[rows]) if normaliser is not None and name == "flat" else x[rows]
            rollout.inputs[name][rows, t] = seen
        tensors = self.policy.tensors({name: rollout.inputs[name][rows, t] for name in rollout.inputs})
        chosen = self.policy.act(tensors, torch.from_numpy(noise[rows]).to(self.device), rows)
        rollout.actions[rows, t], rollout.logp[rows, t] = (x.cpu().numpy() for x in chosen)

    @torch.no_grad()
    def values(self, inputs: dict[str, Array]) -> Array:
        """Values [N] of encoded observations [N, ...], in one pass (images in parts, to save memory)."""
        total = len(next(iter(inputs.values())))
        size = 1024 if any(name.startswith("image") for name in inputs) else total
        parts = [
            self.policy.tensors({n: x[i : i + size] for n, x in inputs.items()})
            for i in range(0, total, size)
        ]
        return torch.cat([self.policy.values(part) for part in parts]).float().cpu().numpy()

    def gae(
        self,
        rewards: Array,
        values: Array,
        next_values: Array,
        terminated: Array,
        ended: Array,
        mask: Array,
        gamma: float,
        gae_lambda: float,
    ) -> Array:
        """maths.returns.gae on arrays."""
        r, v, following, dead, cut, counts = (
            torch.from_numpy(x) for x in (rewards, values, next_values, terminated, ended, mask)
        )
        return returns.gae(r, v, following, dead, cut, gamma, gae_lambda, counts).numpy()

    def update(
        self,
        optimiser: torch.optim.Optimizer,
        batch: Batch,
        settings: UpdateSettings,
        rng: np.random.Generator,
        **more: Any,
    ) -> dict[str, float]:
        """The algorithm's update on torch, step by step: memory of earlier steps is not part of a policy
        here.
        """
        return self.algorithm.update(self.model, optimiser, batch.as_steps(), settings, rng, **more)

    def close(self) -> None:
        """Nothing to end."""

    def check(self, batch: Batch, settings: UpdateSettings) -> str:
        """Nothing to check: this is what the compiled engine is checked against."""
        return ""


class CompiledEngine:
    """The compiled path, on the very memory of the torch parameters and of torch's Adam."""

    name = "fused"
    device = torch.device("cpu")

    def __init__(self, policy: Policy, optimiser: torch.optim.Optimizer, threads: int) -> None:
        from tightrope.control.engine.compiled.fused import FusedEngine

        self.policy = policy
        self.fused = FusedEngine(policy, optimiser, threads)
        self.gae = self.fused.gae

    def begin_rollout(self, num_envs: int, rng: np.random.Generator) -> None:
        """Take over parameters whose memory was replaced since the last update."""
        self.fused.attach()

    def close(self) -> None:
        """End the helping thread."""
        self.fused.close()

    def act(
        self,
        inputs: dict[str, Array],
        normaliser: ObservationNormaliser | None,
        action_mask: Array | None,
        noise: Array,
        rollout: Any,
        rows: slice,
        t: int,
    ) -> None:
        """Fill ``rows`` of column ``t`` of the rollout: inputs as seen, actions, their log-probabilities."""
        mean, inverse_std = (None, None) if normaliser is None else (normaliser.mean, normaliser.inverse_std)
        mask = None if action_mask is None else action_mask[rows]
        columns = (rollout.actions[rows, t], rollout.logp[rows, t], rollout.inputs["flat"][rows, t])
        self.fused.act(inputs["flat"][rows], mean, inverse_std, CLIP, mask, noise[rows], *columns)

    def values(self, inputs: dict[str, Array]) -> Array:
        """Values [N] of encoded observations."""
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
        """One minibatch by ppo.py and by this engine, on copies: a line with the largest difference of a
        parameter.

        Raises RuntimeError when the engine does not compute what ppo.py does.
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


def usable_device(name: str) -> torch.device:
    """The torch device of that name. ValueError: none on this machine, or torch is built without it."""
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"device is {name!r}, which cannot be used here ({reason}). Choose cpu.") from error
    return device


def choose(
    policy: Policy,
    optimiser: torch.optim.Optimizer,
    settings: TrainSettings,
    cores: int,
    notify: Callable[[str], None],
) -> tuple[TorchEngine | CompiledEngine, str]:
    """The engine for these settings, and a line that says which and why.

    Raises ValueError when ``engine`` is ``fused`` and the compiled engine does not cover the settings.
    """
    if settings.engine == "torch":
        return TorchEngine(policy, settings), "engine: torch, as asked"
    from tightrope.control.engine.compiled.plan import unsupported

    reason = unsupported(policy, settings.update, policy.device, settings.algorithm)
    if reason is None and settings.compile:
        reason = "--compile"
    if reason is None:
        from tightrope.control.engine.compiled.cache import compilation_due, when_compiled

        if compilation_due():
            notify(f"compiling the CPU engine: about 15 seconds, {when_compiled()} ...")
        return CompiledEngine(
            policy, optimiser, threads=min(2, cores)
        ), "engine: fused (compiled for this CPU)"
    if settings.engine == "fused":
        raise ValueError(
            f"engine is 'fused', which does not cover {reason}. Use --engine auto or torch, or change that "
            "setting."
        )
    return TorchEngine(policy, settings), f"engine: torch (the compiled engine does not cover {reason})"
