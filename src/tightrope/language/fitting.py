"""The loop that supervised fine-tuning and reward modelling share, and what stands before it: memory, model,
data.

minibatch -> micro-batches, whose gradients add up -> Adam -> record -> save; held-out examples after an epoch
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import time
from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from tightrope.algorithms.memory import Parts
from tightrope.algorithms.nonfinite import explain_loss
from tightrope.algorithms.optimise import Adam, Brake, Meter
from tightrope.algorithms.settings import scheduled
from tightrope.language import lora
from tightrope.language.data import Row, read_rows
from tightrope.language.ledger import available_memory, check, job_of, ledger
from tightrope.language.models import (
    context_length,
    eos_ids,
    find_model,
    load_causal,
    load_tokenizer,
    require_device,
    without_dropout,
)
from tightrope.language.reading import pretrained
from tightrope.language.saving import Progress, load_progress, put_back, save_progress, tensors_of
from tightrope.language.settings import SupervisedSettings
from tightrope.runs import signals
from tightrope.runs.checkpoint import understood
from tightrope.runs.grid import crosses
from tightrope.runs.report import Reporter, say, teller
from tightrope.runs.run import Run

Item = TypeVar("Item")


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
    settings: SupervisedSettings, adapter: str, given: tuple[Any, Any] | None, report: Reporter
) -> Iterator[Loaded]:
    """The model, ready to train inside: its memory told and found to fit before it is loaded, its adapter on,
    the settings' threads at work. ValueError for a device that is not there.
    """
    require_device(settings.device)
    with threads(settings.threads), signals.stoppable():
        present_memory(settings, given, report)
        loaded = load(settings, adapter, given)
        with lora.using(loaded.model, loaded.adapter):
            yield loaded


def present_memory(settings: SupervisedSettings, given: tuple[Any, Any] | None, report: Reporter) -> None:
    """Say what the job will take, and refuse it with advice when it cannot fit: from the config alone.

    The weights of a model that is given, where they lie on the device already, need no more room.
    """
    from transformers import AutoConfig

    place = torch.device(settings.device)
    weights = [] if given is None else [p for p in given[0].parameters() if p.device.type == place.type]
    config = pretrained(AutoConfig, find_model(settings.model)) if given is None else given[0].config
    found, available = ledger(config, job_of(settings)), available_memory(place)
    say(report, found.text())
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


def hold_out(
    items: Sequence[Item], share: float, seed: int, group: Callable[[Item], Hashable] | None = None
) -> tuple[list[Item], list[Item]]:
    """Items to train on and items held out, about ``share`` of them, drawn by the seed; in their order.

    Items of one ``group`` stay together, unless a group is larger than the share; equal items always do,
    where not all are equal. At least one item is held out where there are two or more and the share is above
    0.
    """
    left = max(1, round(share * len(items))) if share > 0 and len(items) > 1 else 0
    keys: list[Hashable] = list(items) if len(set(items)) > 1 else list(range(len(items)))
    if group is not None:
        groups: list[Hashable] = [group(item) for item in items]
        keys = groups if max(Counter(groups).values(), default=0) <= left else keys
    sizes = Counter(keys)
    names = list(sizes)
    held: set[Hashable] = set()
    for index in np.random.default_rng([seed, 1]).permutation(len(names)):
        if left <= 0:
            break
        held.add(names[index])
        left -= sizes[names[index]]
    parts: tuple[list[Item], list[Item]] = ([], [])
    for item, key in zip(items, keys, strict=True):
        parts[key in held].append(item)
    return parts


@dataclass(frozen=True)
class Objective:
    """What is learnt from ``items``.

    ``loss(items)`` is the loss summed over their terms, and sums of further figures by name; ``count(item)``
    its number of terms, ``length(item)`` its tokens. Metrics are named ``name/...``, those of the optimiser
    ``steps/...``; ``seen`` names a metric of all terms so far. ``evaluate()`` looks at held-out items.
    """

    name: str
    steps: str
    items: Sequence[Any]
    loss: Callable[[Sequence[Any]], tuple[Tensor, dict[str, Tensor]]]
    count: Callable[[Any], int]
    length: Callable[[Any], int]
    evaluate: Callable[[], dict[str, float]]
    seen: str | None = None


def fit(
    objective: Objective,
    parameters: Sequence[nn.Parameter],
    settings: SupervisedSettings,
    run: Run,
    report: Reporter,
    lines: Sequence[str],
) -> dict[str, float]:
    """Train, from the newest checkpoint of the run where it has one; returns the newest value of every
    metric. A step is one minibatch; ``lines`` are reported at the start.

    Raises NonFiniteError before a step with a NaN or an infinity in its gradient, ValueError for a checkpoint
    of other data.
    """
    group = {"params": list(parameters), "lr": settings.learning_rate}
    optimiser = Adam([group], eps=1e-8, fused=True)
    brake, items = Brake(parameters[0].device), objective.items
    each = math.ceil(len(items) / settings.minibatch_size)
    total = each * settings.num_epochs
    fresh = Progress(objective.name, len(items), micro_batch_size=settings.micro_batch_size)
    now, saved = load_progress(run, fresh, teller(report))
    if saved is not None:
        with understood(saved.folder):
            put_back(saved.tensors, parameters, optimiser)
    run.rewind(saved)  # without a checkpoint what stands at step 0 is recorded again
    run.update_settings(dataclasses.asdict(settings))
    facts = {"run_dir": str(run.path), "step": now.step, "total_steps": total}
    report("start", {"settings": run.settings, "lines": list(lines), **facts})
    if not now.step and (first := objective.evaluate()):
        now.newest |= first
        run.record(0, 0.0, first)
    for minibatch in islice(minibatches(items, settings), now.step, None):
        signals.check()
        clock = time.perf_counter()
        rate = scheduled(settings.learning_rate, settings.learning_rate_schedule, now.step / total)
        optimiser.param_groups[0]["lr"] = rate
        parts = Parts(now.micro_batch_size)
        metrics = take_step(objective, minibatch, optimiser, brake, settings, parts)
        metrics |= {f"{objective.steps}/learning_rate": rate or 0.0, **parts.metrics()}
        now.step, now.micro_batch_size = now.step + 1, parts.size
        now.seen += sum(objective.count(item) for item in minibatch)
        if objective.seen is not None:
            metrics[objective.seen] = float(now.seen)
        now.seconds += time.perf_counter() - clock
        if now.step % each == 0:
            metrics |= objective.evaluate()
        metrics["time/seconds"] = now.seconds
        now.newest |= metrics
        run.record(now.step, now.seconds, metrics)
        event = {"step": now.step, "metrics": metrics, "seconds": now.seconds}
        report("update", {**event, "total_steps": total})
        if now.step == total or crosses(now.step - 1, now.step, total, settings.checkpoint_every):
            keep, say, final = settings.keep_checkpoints, teller(report), now.step == total
            save_progress(run, now, tensors_of(parameters, optimiser), keep=keep, say=say, final=final)
    return now.newest


def minibatches(items: Sequence[Item], settings: SupervisedSettings) -> Iterator[list[Item]]:
    """Those of every step, in order: a function of the seed alone, wherever a run is stopped."""
    rng, size = np.random.default_rng(settings.seed), settings.minibatch_size
    for _ in range(settings.num_epochs):
        order = rng.permutation(len(items))
        for start in range(0, len(items), size):
            yield [items[i] for i in order[start : start + size]]


def take_step(
    objective: Objective,
    minibatch: Sequence[Any],
    optimiser: torch.optim.Optimizer,
    brake: Brake,
    settings: SupervisedSettings,
    parts: Parts | None = None,
) -> dict[str, float]:
    """One optimiser step on the mean over all terms of the minibatch, however it is split; ``parts`` knows
    from the steps before what fits into memory.
    """
    parts = parts or Parts(settings.micro_batch_size)
    meter = Meter()
    count = sum(objective.count(item) for item in minibatch)

    def gradient(size: int | None) -> dict[str, Tensor]:
        sums = dict[str, Tensor]()
        optimiser.zero_grad(set_to_none=True)
        for part in micro_batches(minibatch, size, objective.length):
            loss, figures = objective.loss(part)
            (loss / count).backward()
            for name, x in {"loss": loss.detach(), **figures}.items():
                sums[name] = sums[name] + x if name in sums else x
        return sums

    sums = parts.fitting(len(minibatch), gradient, optimiser)
    brake.bad = brake.bad | ~torch.isfinite(sums["loss"])
    brake.step(optimiser, settings.max_grad_norm, meter)
    brake.halted(lambda: explain_loss(optimiser, sums["loss"], "in this step"), poll=True)
    metrics = {f"{objective.name}/{name}": float(x) / count for name, x in sums.items()}
    metrics[f"{objective.steps}/grad_norm"] = meter.means()["train/grad_norm"]
    return metrics


def micro_batches(
    items: Sequence[Item], size: int | None, length: Callable[[Item], int]
) -> Iterator[list[Item]]:
    """The items, sorted by length so that little is padded, ``size`` at a time (None: all at once)."""
    ordered = sorted(items, key=length)
    for start in range(0, len(ordered), size or max(1, len(ordered))):
        yield ordered[start : start + (size or len(ordered))]
