"""Threads for the work at hand: a 64-row batch is too small to share, and idle BLAS threads spin."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from threadpoolctl import ThreadpoolController

_controller: ThreadpoolController | None = None


@contextmanager
def limited_threads(threads: int) -> Iterator[None]:
    """Torch and BLAS use at most ``threads`` threads inside; the user's own numbers come back afterwards."""
    global _controller
    if _controller is None:  # looking through the loaded libraries takes milliseconds: once is enough
        _controller = ThreadpoolController()
    before = torch.get_num_threads()
    with _controller.limit(limits=threads, user_api="blas"):
        torch.set_num_threads(threads)
        try:
            yield
        finally:
            torch.set_num_threads(before)
