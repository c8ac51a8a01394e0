"""What the shapes of a model say of its memory, read on a device where tensors have no memory.

The model is built on torch's meta device from its configuration alone. What a forward pass keeps for the
backward pass is measured there too: torch shows every tensor that it saves, at three lengths, and the part
that grows with the square of the length, which fused attention does not keep, is taken off.
"""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from tightrope.language.model.load import fused, without_weights
from tightrope.language.model.parts import Parts, parts

LENGTHS = (16, 32, 48)  # tokens at which a forward pass is measured, evenly spaced


class Shapes(NamedTuple):
    """Numbers of parameters, and bytes per token in one dtype.

    ``parameters``: of the whole model, tied ones once; ``base``: without its own language-model head.
    ``linears``: (outputs, inputs) of every linear layer of every decoder layer, in either order. ``cache``:
    bytes of the KV cache per token; ``saved``: bytes per token that all layers keep for a backward pass;
    ``item``: bytes of one number.
    """

    parameters: int
    base: int
    linears: list[list[tuple[int, int]]]
    hidden: int
    vocabulary: int
    kv_cache: int
    saved: int
    item: int

    def adapter(self, rank: int, layers: int) -> int:
        """Parameters of an adapter of this rank on the topmost layers."""
        return sum(rank * (a + b) for layer in self.linears[-layers:] for a, b in layer)


def shapes_of(config: Any, dtype: str) -> Shapes:
    """The shapes of a causal language model of this configuration (transformers' PretrainedConfig).

    Allocates nothing large. ValueError when the architecture is not known.
    """
    from transformers import AutoModelForCausalLM

    kind = getattr(torch, dtype)
    with torch.device("meta"):
        config = copy.deepcopy(config)  # transformers writes into it
        model = fused(without_weights, AutoModelForCausalLM, config, dtype=kind).eval()
    found = parts(model)
    linears = [_linears(layer) for layer in found.layers]
    inner = config.get_text_config()
    heads = getattr(inner, "num_key_value_heads", None) or inner.num_attention_heads
    width = getattr(inner, "head_dim", None) or inner.hidden_size // inner.num_attention_heads
    return Shapes(
        parameters=sum(p.numel() for p in model.parameters()),
        base=sum(p.numel() for p in found.base.parameters()),
        linears=linears,
        hidden=found.head.weight.shape[1],
        vocabulary=found.head.weight.shape[0],
        kv_cache=2 * len(linears) * heads * width * kind.itemsize,
        saved=_saved_per_token(found, linears, kind.itemsize),
        item=kind.itemsize,
    )


def _linears(layer: nn.Module) -> list[tuple[int, int]]:
    """The shapes of the weights that an adapter would be put on; GPT-2's Conv1D has [in, out]."""
    kinds = [m for m in layer.modules() if isinstance(m, nn.Linear) or type(m).__name__ == "Conv1D"]
    weights = [m.get_parameter("weight").shape for m in kinds]
    return [(shape[0], shape[1]) for shape in weights]


def _saved_per_token(found: Parts, linears: list[list[tuple[int, int]]], item: int) -> int:
    """Bytes per token that the base keeps for a backward pass through all of its weights."""
    try:
        first, second, third = (saved_bytes(found.base, length) for length in LENGTHS)
    except (RuntimeError, NotImplementedError, ValueError, TypeError, AttributeError, IndexError):
        # layers that must look at numbers, as routed experts do, or a base that takes no mask of four axes
        widest = max(side for layer in linears for pair in layer for side in pair)
        return len(linears) * (12 * found.head.weight.shape[1] + 4 * widest) * item
    step = LENGTHS[1] - LENGTHS[0]
    square = (third - 2 * second + first) / (2 * step**2)
    return int((second - first) / step - square * (LENGTHS[0] + LENGTHS[1]))


def saved_bytes(base: nn.Module, length: int) -> int:
    """Bytes of all tensors that the forward pass of one row saves, each once and weights left out."""
    held: dict[int, Tensor] = {}
    weights = {p.untyped_storage()._cdata for p in base.parameters()}
    place = next(base.parameters()).device

    def hold(x: Tensor) -> Tensor:
        storage = x.untyped_storage()
        if storage._cdata not in weights:
            held[storage._cdata] = x  # kept alive, so that no other storage gets its number
        return x

    # with a mask of four axes transformers looks at no number of it, which on meta it could not
    mask = torch.ones(1, 1, length, length, dtype=torch.bool, device=place).tril()
    tokens = torch.zeros(1, length, dtype=torch.int64, device=place)
    with torch.enable_grad(), torch.autograd.graph.saved_tensors_hooks(hold, lambda x: x):
        out = base(input_ids=tokens, attention_mask=mask, use_cache=False).last_hidden_state
    size = sum(x.untyped_storage().nbytes() for x in held.values())
    del out  # until here its graph holds what was saved
    return size
