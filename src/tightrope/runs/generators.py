"""The global generators of this process: random's, numpy's and torch's on the CPU.

The library draws from none of them. Environments and modules of the user may, and their draws should depend
on the seed of the run alone.
"""

from __future__ import annotations

import contextlib
import random
import sys
from collections.abc import Iterator
from typing import Any


def seed(*numbers: int) -> None:
    """Start all of them from these numbers, by numpy's SeedSequence."""
    import numpy as np

    words = np.random.SeedSequence(numbers).generate_state(3)
    random.seed(int(words[0]))
    np.random.seed(int(words[1]))  # noqa: NPY002 - the global one is what this is about
    if torch := sys.modules.get("torch"):  # nobody who has not imported it draws from it
        torch.random.default_generator.manual_seed(int(words[2]))


@contextlib.contextmanager
def apart(*numbers: int) -> Iterator[None]:
    """Inside, all of them start from these numbers; afterwards they continue where they were."""
    before = _states()
    seed(*numbers)
    try:
        yield
    finally:
        _restore(*before)


def _states() -> tuple[Any, Any, Any]:
    import numpy as np

    torch = sys.modules.get("torch")
    numpy = np.random.get_state()  # noqa: NPY002
    return random.getstate(), numpy, None if torch is None else torch.get_rng_state()


def _restore(python: Any, numpy: Any, torch: Any) -> None:
    import numpy as np

    random.setstate(python)
    np.random.set_state(numpy)  # noqa: NPY002
    if torch is not None:
        sys.modules["torch"].set_rng_state(torch)
