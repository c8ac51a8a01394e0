"""What supervised training needs first: memory, model, data."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch

from tightrope.language.data.examples import Row, read_rows
from tightrope.language.memory import available_memory, check, job_of, ledger
from tightrope.language.model import lora
from tightrope.language.model.load import (
    eos_ids,
    load_causal,
    load_tokenizer,
    pretrained,
    require_device,
    without_dropout,
)
from tightrope.language.model.packaged import find_model
from tightrope.language.model.parts import context_length
from tightrope.language.settings import SupervisedSettings
from tightrope.runs import signals
from tightrope.training.events import Listeners


class Loaded(NamedTuple):
    """A causal language model that is ready to train: its tokenizer, the folder or id it came from, the ids
    that end a response (the first closes texts), and the adapter that is trained (None: every weight).
    """

    model: Any
    tokenizer: Any
    source: str
    eos: tuple[int, ...]
    adapter: str | None


@contextlib.contextmanager
def prepared(
    settings: SupervisedSettings, adapter: str, given: tuple[Any, Any] | None, listeners: Listeners
) -> Iterator[Loaded]:
    """The model, ready to train inside. It is loaded when its memory was reported and fits; its adapter is
    active, and the settings' threads are used. ValueError for a device that is not there.
    """
    require_device(settings.device)
    with threads(settings.threads), signals.stoppable():
        present_memory(settings, given, listeners)
        loaded = load(settings, adapter, given)
        with lora.using(loaded.model, loaded.adapter):
            yield loaded


def present_memory(settings: SupervisedSettings, given: tuple[Any, Any] | None, listeners: Listeners) -> None:
    """Report what the job will take, and refuse it with advice when it cannot fit: from the config alone.

    The weights of a model that is given, where they lie on the device already, need no more room.
    """
    from transformers import AutoConfig

    place = torch.device(settings.device)
    weights = [] if given is None else [p for p in given[0].parameters() if p.device.type == place.type]
    config = pretrained(AutoConfig, find_model(settings.model)) if given is None else given[0].config
    found, available = ledger(config, job_of(settings)), available_memory(place)
    listeners.info(found.text())
    check(found, None if available is None else available + sum(p.nbytes for p in weights))


def load(settings: SupervisedSettings, adapter: str, given: tuple[Any, Any] | None = None) -> Loaded:
    """Load the settings' model, or take a (model, tokenizer) that is given and train it in place.

    Tuned in full, the weights stay float32 whatever ``dtype`` says: a step of 1e-5 is lost on a bfloat16
    weight; `precision` then lowers the arithmetic alone. ValueError when max_tokens exceeds the context, or
    the device is not there.
    """
    require_device(settings.device)
    if given is not None:
        source = given[0].name_or_path or settings.model
    else:
        source = find_model(settings.model)
        dtype = torch.float32 if settings.tune == "full" else getattr(torch, settings.dtype)
        given = load_causal(source, dtype), load_tokenizer(source)
    model, tokenizer = given
    limit = context_length(model)
    if limit is not None and settings.max_tokens > limit:
        raise ValueError(
            f"max_tokens is {settings.max_tokens}, but {settings.model} reads {limit} tokens. Choose "
            f"max_tokens {limit} or less."
        )
    without_dropout(model.to(settings.device))
    eos = sorted(eos_ids(model, tokenizer), key=lambda token: token != tokenizer.eos_token_id)
    if settings.gradient_checkpointing:
        lora.checkpoint_activations(model)
        model.train()  # transformers checkpoints in training mode alone; dropout is 0 everywhere
    if settings.tune == "full":
        return Loaded(model.requires_grad_(True), tokenizer, source, tuple(eos), None)
    layers = lora.top_layers(model, settings.lora_layers)
    lora.add_adapter(model, adapter, settings.lora_rank, settings.lora_alpha, layers, settings.seed)
    return Loaded(model, tokenizer, source, tuple(eos), adapter)


@contextlib.contextmanager
def precision(settings: SupervisedSettings) -> Iterator[None]:
    """The arithmetic of one forward pass: bfloat16 over float32 weights where all of them are trained.

    Never around a step of the optimiser: inside, torch keeps the lowered weights it has made.
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


def training_rows(settings: SupervisedSettings, data: Any) -> list[Row]:
    """The rows of ``data``, or of the file that the settings name. ValueError when there is neither."""
    source = settings.data if data is None else data
    if isinstance(source, str) and not source:
        raise ValueError("There is no data. Give --data FILE, or data= in Python.")
    return read_rows(source, settings.max_examples)
