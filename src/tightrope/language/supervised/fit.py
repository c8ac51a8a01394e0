"""The loop that supervised fine-tuning and reward modelling share, and what stands before it: memory, model,
data.

minibatch -> micro-batches, whose gradients add up -> Adam -> record -> save; held-out examples after an epoch
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from tightrope.algorithms.memory import Parts
from tightrope.algorithms.nonfinite import explain_loss
from tightrope.algorithms.optimise import Adam, Brake, Meter
from tightrope.algorithms.settings import scheduled
from tightrope.language.data.examples import Item
from tightrope.language.settings import SupervisedSettings
from tightrope.language.supervised.progress import Progress, load_progress, save_progress
from tightrope.runs import signals
from tightrope.runs.checkpoint import understood
from tightrope.runs.run import Run
from tightrope.training.grid import crosses
from tightrope.training.parameters import put_back, tensors_of
from tightrope.training.report import Reporter, teller


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
