"""Where supervised training stands, as a checkpoint holds it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from tightrope.runs.checkpoint import understood
from tightrope.runs.history import Checkpoint, steps_in
from tightrope.runs.run import Run
from tightrope.training.parameters import Tensors


@dataclass
class Progress:
    """Where supervised training stands: ``step`` optimiser steps of ``story`` (sft, reward) on ``items``
    examples, ``seen`` terms learnt from, ``seconds``, the newest value of every metric, and the micro-batch
    that fits into memory.
    """

    story: str
    items: int
    step: int = 0
    seen: int = 0
    seconds: float = 0.0
    newest: dict[str, float] = dataclasses.field(default_factory=dict)
    micro_batch_size: int | None = None


def save_progress(run: Run, progress: Progress, tensors: Tensors, **how: Any) -> None:
    """A checkpoint of supervised training at its present step; see `Run.save`. The best one is that of the
    best newest figure on held-out examples.
    """
    loss, accuracy = (progress.newest.get(name) for name in ("sft/held_out_loss", "reward/held_out_accuracy"))
    merit = accuracy if loss is None else -loss
    run.save(progress.step, tensors, dataclasses.asdict(progress), merit=merit, **how)


def load_progress(
    run: Run, fresh: Progress, say: Callable[[str], None]
) -> tuple[Progress, Checkpoint | None]:
    """The newest checkpoint of a run; ``fresh`` and None where the run has saved nothing yet.

    ValueError when it is another story's, or stands in other data than ``fresh`` does.
    """
    if not steps_in(run.checkpoints):
        return fresh, None
    point = run.resume_point(say)
    folder, _, state = point
    if state.get("story") != fresh.story:
        raise ValueError(f"{folder} is a checkpoint of {state.get('story')!r}, expected {fresh.story!r}.")
    with understood(folder):
        found = Progress(**{field.name: state[field.name] for field in dataclasses.fields(Progress)})
        found.newest = {name: math.nan if x is None else float(x) for name, x in found.newest.items()}
        found.step, found.seen, found.seconds = int(found.step), int(found.seen), float(found.seconds)
    if found.items != fresh.items:
        raise ValueError(
            f"{run.path} was learning from {found.items} examples, the data now have {fresh.items}. Give the "
            "data that the run began with, or begin a new run."
        )
    return found, point
