"""What supervised training needs first: memory, model, data."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Hashable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import nn

from tightrope.language.data.examples import Item, Row, Rows, hold_out, read_rows
from tightrope.language.memory import job_of, require_memory
from tightrope.language.model import lora
from tightrope.language.model.architecture import context_length
from tightrope.language.model.load import (
    eos_ids,
    load_causal,
    load_tokenizer,
    pretrained,
    require_device,
    unreadable,
    without_dropout,
)
from tightrope.language.model.packaged import find_model
from tightrope.language.settings import SupervisedSettings
from tightrope.runs import signals
from tightrope.training.events import Listeners

if TYPE_CHECKING:
    from transformers import PreTrainedModel, PreTrainedTokenizerBase


# a model with its tokenizer, as a user may give them
GivenModel = tuple["PreTrainedModel", "PreTrainedTokenizerBase"]


class Loaded(NamedTuple):
    """A causal language model that is ready to train: its tokenizer, the folder or id it came from, the ids
    that end a response (the first closes texts), and the adapter that is trained (None: every weight).
    """

    model: PreTrainedModel
    tokenizer: PreTrainedTokenizerBase
    source: str
    eos: tuple[int, ...]
    adapter: str | None

    def trained(self, part: nn.Module) -> list[nn.Parameter]:
        """What is trained where ``part`` of the model is: its weights, or the adapter's."""
        if self.adapter is None:
            return list(part.parameters())
        return lora.adapter_parameters(self.model, self.adapter)


@contextlib.contextmanager
def prepared(
    settings: SupervisedSettings, adapter: str, given: GivenModel | None, listeners: Listeners
) -> Iterator[Loaded]:
    """The model, ready to train inside. It is loaded when its memory was reported and fits; its adapter is
    active, and the settings' threads are used. ValueError for a device that is not there.
    """
    require_device(settings.device)
    with threads(settings.threads), signals.stoppable():
        _require_memory(settings, given, listeners)
        loaded = load_for_training(settings, adapter, given, listeners.warn)
        if strangers := unreadable(loaded.model, loaded.tokenizer):
            listeners.info(strangers)
        with lora.using(loaded.model, loaded.adapter):
            yield loaded


def _require_memory(settings: SupervisedSettings, given: GivenModel | None, listeners: Listeners) -> None:
    """Refuse a job that cannot fit; only the config is read. A model that is given and is on the device
    already needs no more room for its weights.
    """
    from transformers import AutoConfig

    place = torch.device(settings.device)
    weights = [] if given is None else [p for p in given[0].parameters() if p.device.type == place.type]
    config = pretrained(AutoConfig, find_model(settings.model)) if given is None else given[0].config
    held = sum(p.nbytes for p in weights)
    require_memory(config, job_of(settings), place, listeners.info, held)


def load_for_training(
    settings: SupervisedSettings,
    adapter: str,
    given: GivenModel | None = None,
    notify: Callable[[str], None] = warnings.warn,
) -> Loaded:
    """Load the settings' model, or take a (model, tokenizer) that is given and train it in place.

    Tuned in full, the weights stay float32 with any ``dtype``: a step of 1e-5 is lost on a bfloat16
    weight; `precision` then lowers only the arithmetic. ValueError when max_tokens exceeds the context.
    """
    if given is not None:
        source = given[0].name_or_path or settings.model
    else:
        source = find_model(settings.model)
        dtype = torch.float32 if settings.tune == "full" else getattr(torch, settings.dtype)
        given = load_causal(source, dtype, notify), load_tokenizer(source)
    model: Any = given[0]  # mypy cannot call the `to` of transformers
    tokenizer = given[1]
    limit = context_length(model)
    if limit is not None and settings.max_tokens > limit:
        raise ValueError(
            f"max_tokens is {settings.max_tokens}, but {settings.model} reads {limit} tokens. Choose "
            f"max_tokens {limit} or less."
        )
    without_dropout(model.to(settings.device).eval())
    eos = sorted(eos_ids(model, tokenizer), key=lambda token: token != tokenizer.eos_token_id)
    if settings.gradient_checkpointing:
        lora.checkpoint_activations(model)
        lora.training_mode(model, True)
    lora.require_repeatable(model)
    if settings.tune == "full":
        return Loaded(model.requires_grad_(True), tokenizer, source, tuple(eos), None)
    layers = lora.top_layers(model, settings.lora_layers)
    lora.add_adapter(model, adapter, settings.lora_rank, settings.lora_alpha, layers, settings.seed)
    return Loaded(model, tokenizer, source, tuple(eos), adapter)


@contextlib.contextmanager
def precision(settings: SupervisedSettings) -> Iterator[None]:
    """The arithmetic of one forward pass: bfloat16 over float32 weights where all of them are trained.

    Never use it around a step of the optimiser: torch keeps the lowered weights that it made inside.
    """
    lowered = settings.tune == "full" and settings.dtype == "bfloat16"
    with torch.autocast(torch.device(settings.device).type, torch.bfloat16, enabled=lowered):
        yield


@contextlib.contextmanager
def threads(count: int | None) -> Iterator[None]:
    """Torch uses ``count`` CPU threads inside (None: as many as now)."""
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def examples_of(
    settings: SupervisedSettings,
    given: Mapping[str, Rows | None],
    read: Callable[[list[Row]], list[Item]],
    group: Callable[[Item], Hashable] | None = None,
) -> tuple[list[Item], list[Item]]:
    """Examples to train on, and those held out: from what was ``given``, or from the files that the settings
    name; without validation data a share of the others. ``read`` makes examples of rows, ``group`` is that of
    `hold_out`. ValueError where there is nothing to train on.
    """
    source = settings.data if given["data"] is None else given["data"]
    if isinstance(source, str) and not source:
        raise ValueError("There is no data. Give --data FILE, or data= in Python.")
    examples = read(read_rows(source, settings.max_examples))
    validation = settings.validation if given["validation"] is None else given["validation"]
    if validation is not None:
        return examples, read(read_rows(validation))
    return hold_out(examples, settings.held_out, settings.seed, group)
