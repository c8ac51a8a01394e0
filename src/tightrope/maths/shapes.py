"""One guard against silent broadcasting: [B] against [B, T] would compute something, and something wrong."""

from torch import Tensor


def require_same_shape(**tensors: Tensor | None) -> None:
    """Raise ValueError, naming the arguments, unless all given tensors have one shape; None is skipped."""
    shapes = {name: tuple(tensor.shape) for name, tensor in tensors.items() if tensor is not None}
    if len(set(shapes.values())) > 1:
        seen = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise ValueError(f"shapes differ: {seen}. Expected one shape for all; reshape them before the call.")
