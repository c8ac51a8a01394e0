"""The memory that a job needs, from only the shapes of its model, before anything large is allocated.

    peak = what stays + max(while responses are sampled and scored, while gradients are computed)

What stays are the weights of the four roles, their gradients (kept until the next step) and Adam's moments.
Not counted: Python and torch themselves, a GPU's context, and what the allocator holds in reserve (about a
tenth on a CPU); `require_fit` leaves room for them.

The model is built on torch's meta device from its configuration. What a forward pass keeps for the backward
pass is measured there too: torch shows every tensor that it saves, at three lengths, and the part that grows
with the square of the length, which fused attention does not keep, is subtracted.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import torch
from torch import Tensor, nn

from tightrope.language.generation.distribution import CHUNK
from tightrope.language.model.architecture import Parts, accepted, computes_linear, parts
from tightrope.language.model.load import HEAD, fused, pretrained, read_tensors, without_weights
from tightrope.language.settings import AlignSettings, ModelSettings, RewardSettings, SupervisedSettings
from tightrope.training.memory import SHARE, DoesNotFit, available_memory

if TYPE_CHECKING:
    from transformers import PreTrainedConfig

Phase = Literal["always", "rollout", "update"]
FLOAT = 4  # bytes of a float32: adapters, heads, numbers per step
LENGTHS = (16, 32, 48)  # tokens at which a forward pass is measured, evenly spaced
LOGIT_COPIES = 6  # [chunk, vocabulary] at once in token_statistics: p and log p of two models, gradients
DRAW_BYTES = 28  # per row and word while a token is drawn: logits twice, log p; p and its sum in float64


@dataclass(frozen=True, kw_only=True)
class Job:
    """The numbers that decide the memory of a job. A row is a response or an example, padded.

    ``dtype`` is that of whole models, trained or frozen; adapters and heads are float32. ``critic``: none,
    head, adapter, separate; ``reward``: none (a function), adapter, separate. With ``response_tokens`` 0
    nothing is sampled. ``rows_per_example``: 2 where pairs are compared. ``language_head`` False: no logits.
    ``extra_tokens``: tokens of a pretraining loss per micro-batch. ``keeps_float32``: where every weight is
    trained, the weights stay float32 and ``dtype`` lowers copies of them for the arithmetic. ``judges``: name
    and bytes of every reward model with a trunk of its own; ``reward`` separate is one whose size is not
    known, assumed to be as large as the policy, in float32.
    """

    tune: str = "lora"
    lora_rank: int = 16
    lora_layers: int | None = None
    dtype: str = "float32"
    gradient_checkpointing: bool = False
    reference: bool = True
    critic: str = "none"
    reward: str = "none"
    batch_size: int = 1
    micro_batch_size: int = 1
    rows_per_example: int = 1
    prompt_tokens: int = 0
    response_tokens: int = 0
    keeps_exact_kl: bool = False
    language_head: bool = True
    extra_tokens: int = 0
    keeps_float32: bool = False
    judges: tuple[tuple[str, int], ...] = ()

    @property
    def trained(self) -> str:
        """What the model is called: a policy has a reference beside it."""
        return "policy" if self.reference else "model"

    @property
    def lowered(self) -> bool:
        """Whether a forward pass makes copies of float32 weights in a lower precision."""
        return self.keeps_float32 and self.tune == "full" and self.dtype != "float32"


def job_of(
    settings: ModelSettings,
    *,
    reward: str = "none",
    extra_tokens: int = 0,
    judges: tuple[tuple[str, int], ...] = (),
) -> Job:
    """The job of a command's settings. ValueError for settings of another kind."""
    common: dict[str, Any] = {
        name: getattr(settings, name)
        for name in ("tune", "lora_rank", "lora_layers", "dtype", "gradient_checkpointing")
    }
    if isinstance(settings, AlignSettings):
        rows = settings.update.micro_batch_size or settings.update.minibatch_size
        return Job(
            **common, critic=settings.critic, reward=reward, batch_size=settings.batch_size,
            micro_batch_size=min(rows, settings.batch_size), prompt_tokens=settings.max_prompt_tokens,
            response_tokens=settings.max_new_tokens, extra_tokens=extra_tokens,
            keeps_exact_kl=settings.exact_in_loss, judges=judges,
        )  # fmt: skip
    if not isinstance(settings, SupervisedSettings):
        raise ValueError(f"{type(settings).__name__} is not a job whose memory is known.")
    pairs = isinstance(settings, RewardSettings)
    rows = min(settings.micro_batch_size or settings.minibatch_size, settings.minibatch_size)
    return Job(
        **common, reference=False, critic="head" if pairs else "none", language_head=not pairs,
        micro_batch_size=rows, rows_per_example=2 if pairs else 1, prompt_tokens=settings.max_tokens,
        keeps_float32=True,
    )  # fmt: skip


class Entry(NamedTuple):
    """One entry: what it is, its size in bytes, and when it is there."""

    what: str
    size: int
    phase: Phase = "always"


@dataclass(frozen=True)
class Ledger:
    """The entries of a job, and what they were computed from."""

    rows: tuple[Entry, ...]
    job: Job
    config: PreTrainedConfig

    def sum_of(self, phase: Phase) -> int:
        """Bytes of one phase."""
        return sum(row.size for row in self.rows if row.phase == phase)

    @property
    def total(self) -> int:
        """Bytes at the peak."""
        return self.sum_of("always") + max(self.sum_of("rollout"), self.sum_of("update"))

    def text(self) -> str:
        """The ledger as a small table, each phase with its largest entries first."""
        titles: dict[Phase, str] = {
            "always": "", "rollout": " (while sampling and scoring)", "update": " (while learning)",
        }  # fmt: skip
        lines = []
        for phase, title in titles.items():
            found = sorted((row for row in self.rows if row.phase == phase), key=lambda row: -row.size)
            lines += [f"{row.what + title:<66}{amount(row.size):>10}" for row in found if row.size]
        return "\n".join([*lines, f"{'memory at the peak':<66}{amount(self.total):>10}"])


def amount(size: float) -> str:
    """Bytes for people, in powers of 1000: 812 kB, 3.4 MB, 12.1 GB."""
    for unit, scale in (("GB", 1e9), ("MB", 1e6)):
        if size >= scale:
            return f"{size / scale:.1f} {unit}"
    return f"{size / 1e3:.0f} kB"


def ledger(config: PreTrainedConfig, job: Job) -> Ledger:
    """The memory that ``job`` needs with a model of this configuration (transformers' PretrainedConfig).

    Allocates nothing large. ValueError when the architecture is not known, or has too few layers.
    """
    shapes = shapes_of(config, "float32" if job.lowered else job.dtype)
    count = len(shapes.linears)
    adapted = count if job.lora_layers is None else job.lora_layers
    if job.tune == "lora" and adapted > count:
        raise ValueError(f"lora_layers is {adapted}, but the model has {count} layers.")
    rows = [*_roles(shapes, job, adapted), *_update(shapes, job, adapted)]
    if job.response_tokens:
        rows += _rollout(shapes, job, adapted)
    return Ledger(tuple(rows), job, config)


def _roles(shapes: Shapes, job: Job, adapted: int) -> Iterator[Entry]:
    """Weights, gradients and moments."""
    whole, head = shapes.item * shapes.parameters, FLOAT * (shapes.hidden + 1)
    adapter = FLOAT * shapes.adapter(job.lora_rank, adapted)
    yield Entry(f"{job.trained}: weights of the trunk", whole)
    if job.tune == "lora":
        yield Entry(f"{job.trained}: weights of its adapter", adapter)
    elif job.reference:
        yield Entry("reference: a frozen copy", whole)
    learnt = whole if job.language_head else shapes.item * shapes.base
    yield from _trained(job.trained, learnt if job.tune == "full" else adapter)
    own = {"adapter": adapter, "separate": shapes.item * shapes.base}.get(job.critic, 0)
    if job.response_tokens and job.tune == "lora" and job.critic != "separate":
        kept = adapter + (own + head if job.critic != "none" else 0)
        yield Entry("a copy of what is trained, to undo an update", 3 * kept, "update")
    if job.critic != "none":
        role = "critic" if job.language_head else "score head"
        yield Entry(f"{role}: weights", head + (whole if job.critic == "separate" else own))
        yield from _trained(role, own + head)
    if job.reward != "none":
        own = FLOAT * shapes.parameters if job.reward == "separate" else adapter
        yield Entry("reward model: weights", head + own)
    for name, size in job.judges:
        yield Entry(f"reward model {name}: weights", size)


def _trained(role: str, size: int) -> Iterator[Entry]:
    yield Entry(f"{role}: gradients", size)
    yield Entry(f"{role}: Adam's two moments", 2 * size)


def _update(shapes: Shapes, job: Job, adapted: int) -> Iterator[Entry]:
    """What one micro-batch keeps for its backward pass."""
    count = len(shapes.linears)
    rows = job.micro_batch_size * job.rows_per_example
    tokens = rows * (job.prompt_tokens + job.response_tokens)
    share = adapted / count if job.tune == "lora" else 1.0

    narrow = job.lora_rank * shapes.item * sum(map(len, shapes.linears)) if job.tune == "lora" else 0

    def activations(tokens: int, share: float) -> int:
        if not job.gradient_checkpointing:
            return int(tokens * share * (shapes.saved + narrow))
        inputs = shapes.item * shapes.hidden * count * share  # of every layer, and one layer at a time
        return int(tokens * (inputs + shapes.saved / count))

    kept = activations(tokens + job.extra_tokens, share)
    yield Entry(f"{job.trained}: activations of a micro-batch", kept, "update")
    if job.critic in ("adapter", "separate"):
        own = 1.0 if job.critic == "separate" else share
        yield Entry("critic: activations of a micro-batch", activations(tokens, own), "update")
    yield Entry("one layer at work", tokens * shapes.saved // count, "update")
    if job.lowered:
        numbers = sum(a * b for layer in shapes.linears for a, b in layer)
        yield Entry(f"{job.trained}: copies of its weights in {job.dtype}", 2 * numbers, "update")
    if job.language_head:
        chosen = rows * job.response_tokens or tokens
        logits = min(chosen * shapes.vocabulary, max(CHUNK, shapes.vocabulary))
        yield Entry("logits of one chunk", LOGIT_COPIES * FLOAT * logits, "update")


def _rollout(shapes: Shapes, job: Job, adapted: int) -> Iterator[Entry]:
    """What sampling and scoring need for a while, and what they hand to all epochs."""
    rows, length = job.batch_size, job.prompt_tokens + job.response_tokens
    count, hidden = len(shapes.linears), job.batch_size * shapes.item * shapes.hidden
    yield Entry("KV cache", rows * length * shapes.kv_cache, "rollout")
    yield Entry("distribution of the next token", rows * shapes.vocabulary * DRAW_BYTES, "rollout")
    at_once = max(rows * job.prompt_tokens, job.micro_batch_size * length)
    yield Entry("one layer at work", at_once * shapes.saved // count, "rollout")
    yield Entry("rollout: tokens and numbers", rows * (length * 9 + job.response_tokens * 10 * FLOAT))
    if job.tune == "lora" and adapted < count:
        yield Entry("rollout: hidden states below the first adapter", hidden * length)
    if job.keeps_exact_kl:
        yield Entry("rollout: hidden states of the reference", hidden * job.response_tokens)


def require_fit(found: Ledger, available: int | None) -> None:
    """Raise DoesNotFit, with what would help and by how much, unless the job fits into ``available`` bytes.

    A tenth of them stays free. None means that it is not known, and always fits.
    """
    if available is None or found.total <= SHARE * available:
        return
    lines = []
    for words, job in _alternatives(found.job):
        total = ledger(found.config, job).total
        if total < 0.99 * found.total:
            fits = "fits" if total <= SHARE * available else "still too much"
            lines.append(f"  {words}: {amount(total)}, {fits}")
    raise DoesNotFit(
        f"This job needs about {amount(found.total)} of memory; {amount(available)} are available, and a "
        "tenth of that is kept free. What would help:\n" + "\n".join(lines or ["  a smaller model"])
    )


def require_memory(
    config: PreTrainedConfig,
    job: Job,
    device: str | torch.device,
    notify: Callable[[str], None],
    held: int = 0,
) -> None:
    """Tell ``notify`` what a job will take, and raise DoesNotFit when it cannot fit on the device.

    ``held``: bytes of it that lie there already.
    """
    found, available = ledger(config, job), available_memory(device)
    notify(found.text())
    require_fit(found, None if available is None else available + held)


def _alternatives(job: Job) -> Iterator[tuple[str, Job]]:
    """Each way to need less by itself, then all of them together."""
    fewer, half = max(1, job.micro_batch_size // 4), max(1, job.batch_size // 2)
    ways: dict[str, dict[str, Any]] = {
        f"--micro-batch-size {fewer}": {"micro_batch_size": fewer},
        f"--batch-size {half}": {"batch_size": half},
        "--gradient-checkpointing": {"gradient_checkpointing": True},
        "--tune lora": {"tune": "lora"},
        "--dtype bfloat16": {"dtype": "bfloat16"},
    }
    if job.critic in ("adapter", "separate"):
        ways["--critic head"] = {"critic": "head"}
    together: dict[str, Any] = {}
    for words, change in ways.items():
        together |= change
        yield words, dataclasses.replace(job, **change)
    yield "all of these", dataclasses.replace(job, **together)


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


def shapes_of(config: PreTrainedConfig, dtype: str) -> Shapes:
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
    # of a configuration that may differ between layers, one for each
    layers = getattr(inner, "per_layer_config", None) or [inner] * len(linears)
    return Shapes(
        parameters=sum(p.numel() for p in model.parameters()),
        base=sum(p.numel() for p in found.base.parameters()),
        linears=linears,
        hidden=found.head.weight.shape[1],
        vocabulary=found.head.weight.shape[0],
        kv_cache=2 * sum(map(_cache_width, layers)) * kind.itemsize,
        saved=_saved_per_token(found, linears, kind.itemsize),
        item=kind.itemsize,
    )


def _cache_width(inner: Any) -> int:
    """Keys of a token in the KV cache of one layer, over all heads; none where there is no attention: the
    state of a recurrent layer does not grow with the text.
    """
    attention = getattr(inner, "num_attention_heads", None)
    if not attention:
        return 0
    heads = getattr(inner, "num_key_value_heads", None) or attention
    return heads * (getattr(inner, "head_dim", None) or inner.hidden_size // attention)


def _linears(layer: nn.Module) -> list[tuple[int, int]]:
    """The shapes of the weights that an adapter would change; GPT-2's Conv1D has [in, out]."""
    kinds = [module for module in layer.modules() if computes_linear(module)]
    weights = [m.get_parameter("weight").shape for m in kinds]
    return [(shape[0], shape[1]) for shape in weights]


def _saved_per_token(found: Parts, linears: list[list[tuple[int, int]]], item: int) -> int:
    """Bytes per token that the base keeps for a backward pass through all of its weights."""
    try:
        first, second, third = (saved_bytes(found.base, length) for length in LENGTHS)
    except (RuntimeError, ValueError, TypeError, AttributeError, IndexError):
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
        inputs = accepted(base, input_ids=tokens, attention_mask=mask, use_cache=False)
        out = base(**inputs).last_hidden_state
    size = sum(x.untyped_storage().nbytes() for x in held.values())
    del out  # until here its graph holds what was saved
    return size


def reward_model_bytes(folder: Path) -> int:
    """The weights of the reward model in this folder as `load_reward` loads them, in float32, from its own
    config.json; 0 where there is none, which loading refuses.
    """
    from transformers import (
        MODEL_FOR_SEQUENCE_CLASSIFICATION_MAPPING,
        AutoConfig,
        AutoModel,
        AutoModelForSequenceClassification,
    )

    path = folder / "model" if (folder / "model" / "config.json").is_file() else folder
    if not (path / "config.json").is_file():
        return 0
    config = pretrained(AutoConfig, path)
    head = read_tensors(path / HEAD)["score.weight"].numel() if (path / HEAD).is_file() else 0
    scores = not head and type(config) in MODEL_FOR_SEQUENCE_CLASSIFICATION_MAPPING
    with torch.device("meta"):
        model = fused(without_weights, AutoModelForSequenceClassification if scores else AutoModel, config)
    return FLOAT * (sum(p.numel() for p in model.parameters()) + head)
