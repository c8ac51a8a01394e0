"""Statistics over the steps that count, and the guard against tensors of different shapes.

Masked steps are cut by `torch.where`: they may hold NaN.
The masked functions are the only reductions in this package, to scalars in the unit of their input.
"""

from dataclasses import dataclass

import torch
from torch import Tensor


def require_same_shape(**tensors: Tensor | None) -> None:
    """Raise ValueError, naming the arguments, unless all given tensors have one shape; None is skipped.

    A guard against silent broadcasting: [B] against [B, T] would compute something, and something wrong.
    """
    shapes = {name: tuple(tensor.shape) for name, tensor in tensors.items() if tensor is not None}
    if len(set(shapes.values())) > 1:
        seen = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise ValueError(f"shapes differ: {seen}. Expected one shape for all; reshape them before the call.")


def masked_sum(x: Tensor, mask: Tensor) -> Tensor:
    """Sum of x where mask, a scalar; gradient 0 where masked. ValueError when the shapes differ."""
    require_same_shape(x=x, mask=mask)
    return torch.where(mask, x, 0.0).sum()


def masked_mean(x: Tensor, mask: Tensor, count: float | Tensor | None = None) -> Tensor:
    """sum(x where mask) / count, a scalar.

    `count` is the number of counting steps of the WHOLE minibatch: with it the results of micro-batches and
    ranks add up to the mean, and their gradients to its gradient. None counts this mask; an empty one then
    gives 0: a part without counting steps adds nothing, and a division by 0 would make every sum NaN.
    ValueError when the shapes differ, or when a given number is not above 0.
    """
    if count is None:
        count = mask.sum().clamp(min=1)
    elif not isinstance(count, Tensor) and count <= 0:
        raise ValueError(f"count is {count}, expected the number of counting steps, above 0.")
    return masked_sum(x, mask) / count


def masked_variance(x: Tensor, mask: Tensor, count: float | Tensor | None = None) -> Tensor:
    """Population variance, sum((x - mean)^2 where mask) / count, a scalar in squared units of x.

    The mean is that of the given steps. `count` replaces their number as the divisor (their number minus 1
    gives the sample variance); unlike the mean, the variances of parts do not add up. An empty mask gives 0.
    ValueError as in `masked_mean`.
    """
    centred = torch.where(mask, x, 0.0) - masked_mean(x, mask)
    return masked_mean(centred.square(), mask, count)


def standardise(x: Tensor, mask: Tensor, eps: float = 1e-8) -> Tensor:
    """(x - mean) / (std + eps) over the mask, [B, T], with the population std; 0 where masked.

    A single counting step is returned unchanged: it has nothing to be compared with, and x - mean would be 0.
    Computed in float64 and returned in the dtype of x, so that equal float32 numbers give exactly 0 and not
    their rounding error divided by eps. For data, not for losses: sqrt has no gradient at variance 0.
    ValueError when the shapes differ.
    """
    wide = torch.where(mask, x, 0.0).double()
    scaled = (wide - masked_mean(wide, mask)) / (masked_variance(wide, mask).sqrt() + eps)
    result = torch.where(mask.sum() > 1, scaled, wide)
    return torch.where(mask, result, 0.0).to(x.dtype)


@dataclass(frozen=True, eq=False)
class RunningMoments:
    """Count, mean and population variance of all rows seen, in float64: `count` a scalar, the others [D].

    Nothing is ever changed in place; `update` returns new moments. Before the first row the mean is 0 and the
    variance 1, so that normalising by them is the identity; their weight is 0 and they leave no trace in
    later moments.
    """

    count: Tensor
    mean: Tensor
    variance: Tensor

    @classmethod
    def empty(cls, size: int) -> "RunningMoments":
        """The moments of no rows of width `size`."""
        zeros = torch.zeros(size, dtype=torch.float64)
        return cls(count=torch.zeros((), dtype=torch.float64), mean=zeros, variance=zeros + 1)

    def update(self, batch: Tensor) -> "RunningMoments":
        """The moments of the rows so far and those of `batch` [N, D], by Chan's parallel formula.

        mean' = mean + d m / (n + m), variance' = (n variance + m batch_var + d^2 n m / (n + m)) / (n + m),
        d = batch_mean - mean, n rows before and m in the batch. Source: Chan et al. 1983.
        ValueError unless batch is [N, D].
        """
        if batch.ndim != 2 or batch.shape[1:] != self.mean.shape:
            raise ValueError(f"batch has shape {tuple(batch.shape)}, expected [N, {len(self.mean)}].")
        added = batch.shape[0]
        if added == 0:
            return self
        batch = batch.to(self.mean)
        total = self.count + added
        shift = batch.mean(0) - self.mean
        squares = self.count * self.variance + added * batch.var(0, correction=0)
        squares = squares + shift.square() * self.count * added / total
        return RunningMoments(total, self.mean + shift * added / total, squares / total)
