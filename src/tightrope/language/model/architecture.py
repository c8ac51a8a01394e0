"""A causal language model taken apart: base, decoder layers, head, and what is done to its head's logits.

    x = factor * head(base(tokens)),   logits = x, or cap * tanh(x / cap)

Granite divides the logits by a constant, Cohere multiplies them, Gemma 2 caps them; for most models the
factor is 1 and there is no cap. Both are measured once and stored on the head, where
`generation.distribution.at_head` reads them.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    from transformers import PreTrainedModel

LAYER_NAMES = ("layers", "h", "blocks")
WINDOW_FIELDS = ("sliding_window", "attention_chunk_size")  # how far back a layer of a config may look
FACTOR, CAP = "logit_factor", "logit_cap"  # attributes of a head that was measured
SPAN = 100.0  # logits far beyond those of real models: a soft cap bends them
PLATEAU = 1e6  # far beyond any cap
ROUTER_UNUSED = (
    "config.json asks for a router auxiliary loss (output_router_logits). It is not used: {}. Experts may "
    "come to be used unevenly."
)
# what layers raise that need other inputs than they are given
MISFITS = (TypeError, ValueError, RuntimeError, AttributeError, KeyError, IndexError)
FACTOR_TOLERANCE = 1e-3  # relative; the same operations twice, and one multiplication


class Parts(NamedTuple):
    """The parts of a causal language model. Its logits are head(base(tokens)) times a factor, and capped
    where there is a cap; both are stored on the head.
    """

    base: nn.Module
    layers: nn.ModuleList
    head: nn.Linear


def parts(model: PreTrainedModel) -> Parts:
    """The base transformer, its decoder layers and the language-model head.

    Raises ValueError for an architecture in which they cannot be found, or whose logits are something else
    than the head's output, scaled and capped.
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


def accepted(base: nn.Module, **inputs: Any) -> dict[str, Any]:
    """Those of the inputs that a base's forward pass has a parameter for: a recurrent one takes no positions,
    and a model without a cache no use_cache.
    """
    kind: Any = type(base)  # mypy takes a class of modules for one that cannot be hashed
    names, anything = _parameters_of(kind)
    return {name: value for name, value in inputs.items() if anything or name in names}


@functools.cache
def _parameters_of(kind: Any) -> tuple[frozenset[str], bool]:
    """The names of a forward pass's parameters, and whether it takes any others."""
    found = inspect.signature(kind.forward).parameters
    anything = any(parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in found.values())
    return frozenset(found), anything


@torch.no_grad()
def computes_linear(module: nn.Module) -> bool:
    """Whether a module computes W x + b of its own weight and bias and nothing else, so that an adapter, or
    a sum of our own, can stand in for it. A router that is a linear layer and also chooses experts does not.
    """
    if type(module).__name__ == "Conv1D":  # transformers' own, in GPT-2: weights are [in, out]
        return True
    if not isinstance(module, nn.Linear) or type(module).forward is nn.Linear.forward:
        return isinstance(module, nn.Linear)
    numbers = torch.linspace(-1, 1, 3 * module.in_features, device=module.weight.device)
    x = numbers.view(3, -1).to(module.weight.dtype)
    try:
        found = module(x)
    except (RuntimeError, ValueError, TypeError, IndexError):
        return False
    wanted = nn.functional.linear(x, module.weight, module.bias)
    if not isinstance(found, Tensor) or found.shape != wanted.shape:
        return False
    return found.is_meta or not _apart(found, wanted)


def router_weight(model: PreTrainedModel) -> float:
    """The coefficient of the router auxiliary loss that config.json asks for; 0.0 where it asks for none."""
    config = model.config.get_text_config()
    if not getattr(config, "output_router_logits", False):
        return 0.0
    return float(getattr(model, "router_aux_loss_coef", getattr(config, "router_aux_loss_coef", 0.0)) or 0.0)


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
    """Check once, on a few tokens, that the model's logits are factor * head(base(tokens)), capped or not,
    and store factor and cap on the head.

    Raises ValueError for a model that does anything else. On the meta device, where only the head's output
    has numbers, a model that computes something from its weights there is left for later.
    """
    if hasattr(head, FACTOR):
        return
    was = model.training
    model.eval()
    try:
        found = _measured(model, base, head)
    finally:
        model.train(was)
    if found is not None:
        setattr(head, FACTOR, found[0])
        setattr(head, CAP, found[1])


def _measured(model: PreTrainedModel, base: nn.Module, head: nn.Linear) -> tuple[float, float | None] | None:
    """What the model does to its head's output, measured by replacing that output by known numbers: factor
    and cap. None where that takes the weights and there are none.
    """
    given = torch.linspace(-SPAN, SPAN, head.out_features).double()
    if not computes_linear(head):
        raise ValueError(
            f"{_name(model)} has a head that computes something else than W x + b ({type(head).__name__}); "
            "sampling and training would be of another distribution. Choose another model."
        )
    try:
        read, before, logits = _replaced(model, base, head, given)
    except Exception:
        if head.weight.is_meta:  # a layer looks at numbers, as routed experts do
            return None
        raise
    if logits.is_meta:
        return None
    alike = read is not None and before is not None and read.shape == before.shape
    before_head = _scale(read, before) if alike else 0.0
    if before_head is None:
        return None
    if before_head <= 0 or (before_head != 1.0 and head.bias is not None):
        raise ValueError(
            f"{_name(model)} changes its last hidden states before its head reads them; expected the hidden "
            "states themselves or times a factor. Sampling and training would be of another distribution. "
            "Choose another model."
        )
    factor = float((logits * given).mean() / (given * given).mean())
    if factor > 0 and not _apart(logits, factor * given):
        return factor * before_head, None
    cap = float(_replaced(model, base, head, torch.full_like(given, PLATEAU))[2].max())
    # tanh is invertible in double precision up to about 15
    bent = (logits / cap).clamp(-1, 1).atanh() * cap
    small = (given.abs() < cap).expand(logits.shape)
    factor = float((bent * given)[small].mean() / (given * given).expand(logits.shape)[small].mean())
    if cap > 0 and factor > 0 and not _apart(logits, cap * (factor * given / cap).tanh()):
        return factor * before_head, cap
    raise ValueError(
        f"{_name(model)} does more to the logits of its head than to scale and to cap them: {-SPAN:g}, "
        f"{SPAN / 2:g} and {SPAN:g} become {_seen(logits, 0):g}, {_seen(logits, 0.75):g} and "
        f"{_seen(logits, 1):g}. Sampling and training would be of another distribution. Choose another model."
    )


def _replaced(
    model: PreTrainedModel, base: nn.Module, head: nn.Linear, given: Tensor
) -> tuple[Tensor | None, Tensor | None, Tensor]:
    """What the head reads, the base's last hidden states, and the logits [1, T, V] when the head gives
    ``given`` [V] for every token.
    """
    reads: list[Tensor] = []
    states: list[Tensor] = []
    meta = head.weight.is_meta
    given = given.float().to("cpu" if meta else head.weight.device)

    def replace(module: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> Tensor:
        reads.append(inputs[0])
        return given.expand(output.shape).clone()

    def keep(module: nn.Module, inputs: tuple[Any, ...], output: Any) -> None:
        states.append(output.last_hidden_state)

    tokens = torch.arange(4, device=head.weight.device)[None] % head.out_features
    inputs: dict[str, Any] = {"input_ids": tokens, "use_cache": False}
    if meta:  # with a mask of four axes transformers looks at no number of it, which on meta it could not
        inputs["attention_mask"] = torch.ones(1, 1, 4, 4, dtype=torch.bool, device="meta")
    handles = [head.register_forward_hook(replace), base.register_forward_hook(keep)]
    try:
        logits = model(**accepted(model, **inputs)).logits.double()
        if not states and not meta:  # some models call an inner part of their base
            base(**accepted(base, **inputs))
    finally:
        for handle in handles:
            handle.remove()
    if meta and not states:
        states = reads
    return reads[-1] if reads else None, states[0] if states else None, logits if meta else logits.cpu()


def _scale(read: Any, before: Any) -> float | None:
    """The factor from the base's hidden states to what the head reads (MiniCPM divides them); 0 where there
    is none, None where there are no numbers to tell.
    """
    if read.is_meta:
        return 1.0 if read.untyped_storage()._cdata == before.untyped_storage()._cdata else None
    if not _apart(read, before):
        return 1.0
    read, before = read.double(), before.double()
    factor = float((read * before).mean() / (before * before).mean())
    return 0.0 if _apart(read, factor * before) else factor


def _apart(x: Tensor, y: Tensor) -> bool:
    """Whether two tensors differ by more than rounding. NaN is not counted; other checks find it."""
    return bool((x - y).abs().max() > FACTOR_TOLERANCE * y.abs().max())


def relative_gap(x: Tensor, y: Tensor) -> float:
    """max |x - y| as a share of max |y|."""
    return float((x - y).abs().max() / y.abs().max())


def _seen(logits: Tensor, place: float) -> float:
    return float(logits[0, -1, round(place * (logits.shape[-1] - 1))])


def _name(model: PreTrainedModel) -> str:
    return f"{type(model).__name__} (model type {model.config.model_type})"
