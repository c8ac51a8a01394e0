"""A causal language model taken apart: base, decoder layers, head, and the factor on its head's logits.

    logits = factor * head(base(tokens))

Granite divides the logits by a constant and Cohere multiplies them; for most models the factor is 1. It is
measured once and stored on the head, where `generation.distribution.at_head` reads it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    from transformers import PreTrainedModel

LAYER_NAMES = ("layers", "h", "blocks")
WINDOW_FIELDS = ("sliding_window", "attention_chunk_size")  # how far back a layer of a config may look
FACTOR = "logit_factor"  # an attribute of a head whose factor is known
SPAN = 100.0  # logits far beyond those of real models: a soft cap bends them
FACTOR_TOLERANCE = 1e-3  # relative; the same operations twice, and one multiplication


class Parts(NamedTuple):
    """The parts of a causal language model. Its logits are head(base(tokens)) times a factor that is stored
    on the head.
    """

    base: nn.Module
    layers: nn.ModuleList
    head: nn.Linear


def parts(model: PreTrainedModel) -> Parts:
    """The base transformer, its decoder layers and the language-model head.

    Raises ValueError for an architecture in which they cannot be found, or whose logits are something else
    than a factor times the head's output.
    """
    base, head = getattr(model, model.base_model_prefix, None), model.get_output_embeddings()
    if base is not None and isinstance(head, nn.Linear):
        for owner in (base, getattr(base, "decoder", None)):
            for name in LAYER_NAMES:
                layers = getattr(owner, name, None)
                if isinstance(layers, nn.ModuleList):
                    measure_factor(model, base, head)
                    return Parts(base, layers, head)
    raise ValueError(
        f"{type(model).__name__} is not a decoder-only model whose layers and head can be found. Llama, "
        "Qwen, Mistral, GPT-2 and similar models are."
    )


def context_length(model: PreTrainedModel) -> int | None:
    """How many positions the model knows; None where its config does not tell."""
    for name in ("max_position_embeddings", "n_positions", "n_ctx"):
        if (found := getattr(model.config, name, None)) is not None:
            return int(found)
    return None


def attention_window(model: PreTrainedModel) -> int | None:
    """How many tokens the narrowest layer looks back over; None: all of them."""
    config = model.config.get_text_config()
    if all(kind == "full_attention" for kind in getattr(config, "layer_types", None) or ["unknown"]):
        return None
    sizes = [size for name in WINDOW_FIELDS if (size := getattr(config, name, None)) is not None]
    return min(sizes, default=None)


def parameter_counts(model: PreTrainedModel, trained: Iterable[nn.Parameter]) -> tuple[int, int]:
    """How many numbers are trained, and how many there are, the model's and those trained beside it."""
    trained = list(trained)
    every = {id(parameter): parameter for parameter in (*model.parameters(), *trained)}
    return sum(p.numel() for p in trained), sum(p.numel() for p in every.values())


@torch.no_grad()
def measure_factor(model: PreTrainedModel, base: nn.Module, head: nn.Linear) -> None:
    """Check once, on a few tokens, that the model's logits are factor * head(base(tokens)), and store the
    factor on the head.

    Raises ValueError for a model that does anything else, such as a soft cap, or whose head does not read
    hidden states of the model's own width. On the meta device, where there are no numbers, only the width is
    checked.
    """
    width = model.config.get_text_config().hidden_size
    if head.in_features != width:
        raise ValueError(
            f"{_name(model)} has hidden states of {width} numbers and a head that reads {head.in_features}; "
            "expected the same. Models that project in between are not supported. Choose another."
        )
    if hasattr(head, FACTOR) or head.weight.is_meta:
        return
    was = model.training
    model.eval()
    try:
        factor = _factor(model, base, head)
    finally:
        model.train(was)
    setattr(head, FACTOR, factor)


def _factor(model: PreTrainedModel, base: nn.Module, head: nn.Linear) -> float:
    """What the model multiplies its head's output by, measured by replacing that output by known numbers."""
    reads: list[Tensor] = []
    given = torch.linspace(-SPAN, SPAN, head.out_features, device=head.weight.device)

    def replace(module: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> Tensor:
        reads.append(inputs[0])
        return given.expand(output.shape).clone()

    tokens = torch.arange(4, device=head.weight.device)[None] % head.out_features
    handle = head.register_forward_hook(replace)
    try:
        logits = model(input_ids=tokens, use_cache=False).logits.double()
    finally:
        handle.remove()
    hidden = base(input_ids=tokens, use_cache=False).last_hidden_state
    if not reads or reads[0].shape != hidden.shape or _apart(reads[0], hidden):
        raise ValueError(
            f"{_name(model)} changes its last hidden states before its head reads them; expected the hidden "
            "states themselves. Sampling and training would be of another distribution. Choose another model."
        )
    wanted = given.double()
    factor = float((logits * wanted).mean() / (wanted * wanted).mean())
    if not factor > 0 or _apart(logits, factor * wanted):
        raise ValueError(
            f"{_name(model)} does more to the logits of its head than to scale them: {-SPAN:g}, {SPAN / 2:g} "
            f"and {SPAN:g} become {_seen(logits, 0):g}, {_seen(logits, 0.75):g} and {_seen(logits, 1):g}. "
            "Sampling and training would be of another distribution; models with soft-capped logits are not "
            "supported. Choose another."
        )
    return factor


def _apart(x: Tensor, y: Tensor) -> bool:
    """Whether two tensors differ by more than rounding. NaN is not counted; other checks find it."""
    return bool((x - y).abs().max() > FACTOR_TOLERANCE * y.abs().max())


def _seen(logits: Tensor, place: float) -> float:
    return float(logits[0, -1, round(place * (logits.shape[-1] - 1))])


def _name(model: PreTrainedModel) -> str:
    return f"{type(model).__name__} (model type {model.config.model_type})"
