"""What every engine offers, and the threads that it may use."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from threadpoolctl import ThreadpoolController

from tightrope.algorithms.batch import Batch
from tightrope.algorithms.settings import UpdateSettings
from tightrope.control.policy.normalise import ObservationNormaliser
from tightrope.control.spaces.structure import Array, Inputs

_controller: ThreadpoolController | None = None


class Acted(NamedTuple):
    """What acting on N observations gives, as arrays that the engine fills: views of a rollout's column.

    The caller provides them because the compiled engine writes in place, which saves a copy.
    """

    inputs: Inputs  # [N, ...]: the observations as the policy saw them (normalised)
    actions: Array  # float32 [N, A]
    logp: Array  # float32 [N]: log-probability of these actions


class Steps(NamedTuple):
    """What advantages are computed from (see maths.returns): float64 and bool arrays [B, T]."""

    rewards: Array
    values: Array
    next_values: Array
    terminated: Array
    ended: Array
    mask: Array


class Engine(Protocol):
    """What computes: acting, values, advantages and updates of one policy. Torch is the reference."""

    @property
    def name(self) -> str:
        """``torch`` or ``fused``."""

    @property
    def device(self) -> torch.device:
        """Where batches must lie."""

    @property
    def policy(self) -> Any:
        """The `Policy` that acts and learns."""

    def begin_rollout(self, num_envs: int, rng: np.random.Generator) -> None:
        """Prepare to act in ``num_envs`` environments; ``rng`` is for exploration beyond the noise given."""

    def act(
        self,
        inputs: Inputs,
        normaliser: ObservationNormaliser | None,
        action_mask: Array | None,
        noise: Array,
        rows: slice,
        out: Acted,
    ) -> None:
        """Choose actions for ``rows`` of observations [B, ...] and write them to ``out``.

        ``action_mask`` bool [B, L]. ``noise`` [B, A]: uniform for categories and bits, normal for Gaussians.
        """

    def values(self, inputs: Inputs) -> Array:
        """The critic's outputs [N] for encoded observations [N, ...]."""

    def gae(self, steps: Steps, gamma: float, gae_lambda: float) -> Array:
        """Advantages [B, T] float64: maths.returns.gae on arrays."""

    def update(
        self,
        batch: Batch,
        settings: UpdateSettings,
        rng: np.random.Generator,
        *,
        refresh: Callable[[Batch], Batch] | None = None,
        log_ratio_limit: float | None = None,
    ) -> dict[str, float]:
        """The algorithm's update. In the first one with a ``log_ratio_limit`` the compiled engine is compared
        with the reference; RuntimeError when they differ.
        """

    def close(self) -> None:
        """End the engine's threads."""


@contextmanager
def limited_threads(threads: int) -> Iterator[None]:
    """Torch and BLAS use at most ``threads`` threads inside; the numbers from before return afterwards.

    A minibatch of 64 rows is too small to share, and idle BLAS threads spin.
    """
    global _controller
    if _controller is None:  # searching the loaded libraries takes milliseconds
        _controller = ThreadpoolController()
    before = torch.get_num_threads()
    with _controller.limit(limits=threads, user_api="blas"):
        torch.set_num_threads(threads)
        try:
            yield
        finally:
            torch.set_num_threads(before)
