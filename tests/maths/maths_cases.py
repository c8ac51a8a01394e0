"""Random rollouts for testing properties, the hypothesis strategy that draws them, and exact comparison."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from hypothesis import settings
from hypothesis import strategies as st
from torch import Tensor

# Fixed draws: a failure repeats tomorrow and on another machine.
PROPERTY = settings(deadline=None, max_examples=50, derandomize=True, database=None)


@dataclass(frozen=True)
class Case:
    """One rollout in float64. Terminated steps have ended; some steps have ended without terminating."""

    seed: int
    gamma: float
    gae_lambda: float
    rewards: Tensor
    values: Tensor
    next_values: Tensor
    last_values: Tensor
    final_values: Tensor
    terminated: Tensor
    ended: Tensor
    mask: Tensor
    log_ratio: Tensor
    advantages: Tensor
    old_values: Tensor
    returns: Tensor

    @property
    def generator(self) -> torch.Generator:
        return torch.Generator().manual_seed(self.seed + 1)


def random_case(
    seed: int,
    rows: int = 3,
    steps: int = 7,
    gamma: float = 0.9,
    gae_lambda: float = 0.7,
    counting: float = 0.8,
) -> Case:
    """A rollout [rows, steps]; each step counts with the probability `counting`, and at least one does."""
    generator = torch.Generator().manual_seed(seed)
    shape = (rows, steps)

    def normal() -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    ended = torch.rand(shape, generator=generator) < 0.35
    terminated = ended & (torch.rand(shape, generator=generator) < 0.5)
    mask = torch.rand(shape, generator=generator) < counting
    mask[seed % rows, seed % steps] = True
    values = normal()
    return Case(
        seed=seed,
        gamma=gamma,
        gae_lambda=gae_lambda,
        rewards=normal(),
        values=values,
        next_values=normal(),
        last_values=normal()[:, 0],
        final_values=normal(),
        terminated=terminated,
        ended=ended,
        mask=mask,
        log_ratio=0.5 * normal(),
        advantages=normal(),
        old_values=values + 0.5 * normal(),
        returns=values + normal(),
    )


CASES = st.builds(
    random_case,
    seed=st.integers(0, 2**31),
    rows=st.integers(1, 4),
    steps=st.integers(1, 9),
    gamma=st.sampled_from([0.0, 0.5, 0.99, 1.0]),
    gae_lambda=st.sampled_from([0.0, 0.3, 0.95, 1.0]),
    counting=st.sampled_from([0.3, 0.8, 1.0]),
)
# A few representative rollouts for the mutants, where hypothesis would take too long.
FIXED_CASES = (
    random_case(0),
    random_case(1, rows=4, steps=9, gamma=0.5, gae_lambda=0.95, counting=0.5),
    random_case(2, rows=1, steps=5, gamma=1.0, gae_lambda=1.0, counting=1.0),
    random_case(3, rows=6, steps=12, gamma=0.99, gae_lambda=0.3, counting=1.0),
    random_case(4, rows=2, steps=3, counting=0.0),
)

close = partial(torch.testing.assert_close, rtol=1e-9, atol=1e-11)
same = partial(torch.testing.assert_close, rtol=0, atol=0)


def with_gradients(function: Callable[..., Tensor], *inputs: Tensor) -> list[Tensor]:
    """The output, and the gradient of the sum of its sine (which has no symmetry) for every input."""
    leaves = [tensor.detach().clone().requires_grad_() for tensor in inputs]
    output = function(*leaves)
    gradients = torch.autograd.grad(output.sin().sum(), leaves, allow_unused=True)
    zero = [torch.zeros_like(leaf) if g is None else g for leaf, g in zip(leaves, gradients, strict=True)]
    return [output.detach(), *zero]


def poisoned(tensor: Tensor, where: Tensor) -> Tensor:
    return torch.where(where, torch.nan, tensor)
