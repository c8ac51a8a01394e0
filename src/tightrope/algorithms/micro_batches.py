"""Gradients in parts that fit into memory. After an out-of-memory error the parts are halved; the gradient
stays the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from tightrope.errors import TightropeError

SIGNS = ("out of memory", "not enough memory", "defaultcpuallocator")  # in the texts of torch's RuntimeErrors


class OutOfMemory(TightropeError, RuntimeError):
    """Memory is not enough even for the smallest part; the message says which setting makes it smaller."""


def is_out_of_memory(error: BaseException) -> bool:
    """Whether torch, on any device, or Python could not get the memory it asked for."""
    if isinstance(error, torch.OutOfMemoryError | MemoryError):
        return True
    return isinstance(error, RuntimeError) and any(sign in str(error).lower() for sign in SIGNS)


def free() -> None:
    """Free the memory of a GPU that torch holds but does not use."""
    if torch.cuda.is_available():
        torch.cuda.empty_cache()


def _random_state() -> Callable[[], None]:
    """A function that restores the present state of torch's generators, CPU and CUDA."""
    cpu = torch.get_rng_state()
    cuda = torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else []

    def put_back() -> None:
        torch.set_rng_state(cpu)
        for index, state in enumerate(cuda):
            torch.cuda.set_rng_state(state, index)

    return put_back


@dataclass
class MicroBatches:
    """How many rows a gradient is computed on at a time: ``size``, None: all of them.

    ``halvings`` counts how often memory was not enough.
    """

    size: int | None
    halvings: int = 0

    def compute(
        self, rows: int, attempt: Callable[[int | None], Any], optimiser: torch.optim.Optimizer
    ) -> Any:
        """Return ``attempt(size)``, which computes a gradient over ``rows`` rows, ``size`` at a time.

        When memory runs out, the attempt is repeated at half the size with the same random numbers of torch.
        It must reset everything else that it changes: draw and count outside of it. OutOfMemory when a single
        row is too much.
        """
        start_over = _random_state()
        while True:
            try:
                return attempt(self.size)
            except (RuntimeError, MemoryError) as error:
                if not is_out_of_memory(error):
                    raise
                now = min(self.size or rows, rows)
                if now == 1:
                    raise OutOfMemory(_advice(error)) from error
            # outside the except clause, which keeps the failed pass's tensors alive
            optimiser.zero_grad(set_to_none=True)
            self.size, self.halvings = (now + 1) // 2, self.halvings + 1
            free()
            start_over()

    def metrics(self) -> dict[str, float]:
        """The present size and how often it was halved; nothing while memory was enough."""
        if not self.halvings:
            return {}
        return {
            "train/micro_batch_size": float(self.size or 0),
            "train/memory_halvings": float(self.halvings),
        }


def _advice(error: BaseException) -> str:
    reason = (str(error).splitlines() or [""])[0][:200]
    return (
        f"Memory is not enough for the gradient of a single row ({reason}). The step was not taken. Use a "
        "smaller model or less of it (language: --tune lora, --lora-layers, --gradient-checkpointing, fewer "
        "--max-new-tokens and --max-prompt-tokens; control: smaller --hidden), or a device with more memory."
    )
