"""What supervised fine-tuning and reward modelling share: a run, new or resumed, its state, and one optimiser
step.

Files are read again when a run is resumed; an object in Python must be given again. A step:
minibatch -> micro-batches, whose gradients add up -> Adam; held-out examples after every epoch
"""

from __future__ import annotations

import dataclasses
import math
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from tightrope.algorithms.descent import CheckedSteps, MicroBatches
from tightrope.algorithms.nonfinite import explain_loss
from tightrope.algorithms.optimise import Adam
from tightrope.language.data.examples import Item, Rows
from tightrope.language.model.architecture import parameter_counts
from tightrope.language.model.load import quiet_libraries
from tightrope.language.settings import SupervisedSettings, recorded
from tightrope.language.supervised.prepare import GivenModel, Loaded, prepared
from tightrope.runs import signals
from tightrope.runs.checkpoint import counted, understood
from tightrope.runs.folders import require_kind
from tightrope.runs.records import figures
from tightrope.runs.retention import Checkpoint
from tightrope.runs.run import Run
from tightrope.settings.fields import scheduled
from tightrope.training import loop
from tightrope.training.events import Listener, Listeners
from tightrope.training.learner import Update, crosses
from tightrope.training.loop import continue_from, newest_point
from tightrope.training.parameters import Tensors, restore_tensors, tensors_of
from tightrope.training.tensorboard import require_tensorboard


@dataclass(frozen=True)
class Objective:
    """What is learnt from ``items``: ``parameters`` are trained, ``data`` describes the items in words.

    ``loss(items)`` is the loss summed over their terms, and sums of further figures by name; ``count(item)``
    its number of terms, ``length(item)`` its tokens. Metrics are named ``name/...``, those of the optimiser
    ``steps/...``; ``seen`` names a metric of all terms so far. ``evaluate()`` gives the figures of held-out
    items. ``save(folder, newest)`` writes the model into the run folder and returns numbers for its summary.
    """

    name: str
    steps: str
    items: Sequence[Any]
    loss: Callable[[Sequence[Any]], tuple[Tensor, dict[str, Tensor]]]
    count: Callable[[Any], int]
    length: Callable[[Any], int]
    evaluate: Callable[[], dict[str, float]]
    save: Callable[[Path, dict[str, float]], dict[str, Any]] = lambda folder, newest: {}
    seen: str | None = None
    parameters: Sequence[nn.Parameter] = ()
    data: str = ""


class SupervisedLearner:
    """The state of supervised training, a `Learner`: ``step`` optimiser steps, ``seen`` terms, the newest
    value of every metric, and the micro-batch that fits into memory. A step is one minibatch.
    """

    def __init__(
        self,
        objective: Objective,
        settings: SupervisedSettings,
        lines: Sequence[str] = (),
    ) -> None:
        self.objective = objective
        self.parameters = objective.parameters
        self.settings = settings
        self.lines = list(lines)
        group = {"params": list(objective.parameters), "lr": settings.learning_rate}
        self.optimiser = Adam([group], eps=1e-8, fused=True)
        self.steps_per_epoch = math.ceil(len(objective.items) / settings.minibatch_size)
        self.step = 0
        self.seen = 0
        self.seconds = 0.0
        self.rollbacks = 0
        self.newest: dict[str, float] = {}
        self.micro_batch_size = settings.micro_batch_size
        self.changes: dict[str, Any] = {}
        self.pending: Update | None = None

    @property
    def position(self) -> int:
        """Optimiser steps so far."""
        return self.step

    @property
    def total(self) -> int:
        """Optimiser steps of all epochs."""
        return self.steps_per_epoch * self.settings.num_epochs

    @property
    def complete(self) -> bool:
        """Whether every epoch is over."""
        return self.step >= self.total

    @property
    def merit(self) -> float | None:
        """The newest figure of held-out examples; higher is better."""
        loss = self.newest.get("sft/held_out_loss")
        return self.newest.get("reward/held_out_accuracy") if loss is None else -loss

    def begin(self) -> list[str]:
        """The lines that describe model and data."""
        return self.lines

    def iterate(self) -> Iterator[Update]:
        """One optimiser step at a time.

        Raises NonFiniteError before a step with a NaN or an infinity in its gradient.
        """
        objective, total = self.objective, self.total
        checked = CheckedSteps(self.parameters[0].device)
        batches = minibatches(objective.items, self.settings, self.rollbacks)
        for minibatch in islice(batches, self.step, None):
            now = dataclasses.replace(self.settings, **self.changes)
            rate = scheduled(now.learning_rate, now.learning_rate_schedule, self.step / total)
            self.optimiser.param_groups[0]["lr"] = rate
            memory = MicroBatches(self.micro_batch_size)
            metrics = take_step(objective, minibatch, self.optimiser, checked, now, memory)
            metrics |= {f"{objective.steps}/learning_rate": rate or 0.0, **memory.metrics()}
            self.step += 1
            self.micro_batch_size = memory.size
            self.seen += sum(objective.count(item) for item in minibatch)
            if objective.seen is not None:
                metrics[objective.seen] = float(self.seen)
            on_grid = crosses(self.step - 1, self.step, total, now.checkpoint_every)
            yield Update(self.step, total, metrics, self.step - 1, on_grid)

    def evaluate(self, update: Update | None) -> dict[str, float]:
        """Held-out figures before the first step and after every epoch."""
        due = update is None or update.step % self.steps_per_epoch == 0
        found = self.objective.evaluate() if due else {}
        self.newest |= found if update is None else update.metrics | found
        return found

    def conclude(self) -> dict[str, float]:
        """Nothing: the last epoch was evaluated."""
        return {}

    def snapshot(self) -> tuple[Tensors, dict[str, Any]]:
        """Everything that `restore` needs, as tensors and JSON. The tensors are not copied."""
        state = {
            "story": self.objective.name,
            "items": len(self.objective.items),
            "step": self.step,
            "seen": self.seen,
            "seconds": self.seconds,
            "newest": self.newest,
            "micro_batch_size": self.micro_batch_size,
            "rollbacks": self.rollbacks,
        }
        return tensors_of(self.parameters, self.optimiser), state

    def restore(self, point: Checkpoint) -> None:
        """Put back a checkpoint. ValueError for one of another command, or of other data."""
        folder, tensors, state = point
        if state.get("story") != self.objective.name:
            raise ValueError(
                f"{folder} is a checkpoint of {state.get('story')!r}, expected {self.objective.name!r}."
            )
        items = len(self.objective.items)
        with understood(folder):
            step, before = counted(state["step"]), state["items"]
            newest = figures(state["newest"])
            if before == items:
                restore_tensors(tensors, self.parameters, self.optimiser)
            self.step = step
            self.seen = counted(state["seen"])
            self.seconds = float(state["seconds"])
            self.newest = newest
            self.micro_batch_size = state["micro_batch_size"]
            self.rollbacks = counted(state.get("rollbacks", 0))
        if before != items:
            raise ValueError(
                f"{folder.parent.parent} was learning from {before} examples, the data now have {items}. "
                "Give the data that the run started with, or start a new run."
            )

    def roll_back(self, point: Checkpoint) -> None:
        """Put back a checkpoint of this run; examples come in another order from there on."""
        rollbacks, size = self.rollbacks + 1, self.micro_batch_size
        self.restore(point)
        self.rollbacks = rollbacks
        self.micro_batch_size = size

    def finish(self, run: Run) -> dict[str, Any]:
        """Write the model; returns the summary."""
        numbers = self.objective.save(run.path, self.newest)
        return {
            "model": self.settings.model,
            "seed": self.settings.seed,
            **numbers,
            "wall_seconds": self.newest.get("time/seconds", 0.0),
            "final": {name: value for name, value in self.newest.items() if name != "time/seconds"},
            "run_dir": str(run.path),
        }


def minibatches(
    items: Sequence[Item], settings: SupervisedSettings, rollbacks: int = 0
) -> Iterator[list[Item]]:
    """Those of every step, in order: a function of only the seed and the number of rollbacks, also after a
    resume. In the epoch of a rollback some examples come twice and others not at all.
    """
    rng = np.random.default_rng([settings.seed, rollbacks] if rollbacks else settings.seed)
    size = settings.minibatch_size
    for _ in range(settings.num_epochs):
        order = rng.permutation(len(items))
        for start in range(0, len(items), size):
            yield [items[i] for i in order[start : start + size]]


def take_step(
    objective: Objective,
    minibatch: Sequence[object],
    optimiser: torch.optim.Optimizer,
    checked: CheckedSteps,
    settings: SupervisedSettings,
    parts: MicroBatches | None = None,
) -> dict[str, float]:
    """One optimiser step on the mean over all terms of the minibatch, however it is split; ``parts`` knows
    from the steps before what fits into memory.
    """
    parts = parts or MicroBatches(settings.micro_batch_size)
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

    with signals.interruptible():  # a gradient changes nothing yet
        sums = parts.compute(len(minibatch), gradient, optimiser)
    norm = checked.take(optimiser, settings.max_grad_norm, sums["loss"])
    checked.halted(lambda: explain_loss(optimiser, sums["loss"], "in this step"), poll=True)
    metrics = {f"{objective.name}/{name}": float(x) / count for name, x in sums.items()}
    metrics[f"{objective.steps}/grad_norm"] = float(norm)
    return metrics


def micro_batches(
    items: Sequence[Item], size: int | None, length: Callable[[Item], int]
) -> Iterator[list[Item]]:
    """The items, sorted by length so that little is padded, ``size`` at a time (None: all at once)."""
    ordered = sorted(items, key=length)
    for start in range(0, len(ordered), size or max(1, len(ordered))):
        yield ordered[start : start + (size or len(ordered))]


class Stage(NamedTuple):
    """A supervised stage: its ``name``, which is also its adapter's; the class of its settings; and
    ``objective``, which reads the data from what was given, or from the files that the settings name.
    """

    name: str
    kind: type[SupervisedSettings]
    objective: Callable[[Any, Loaded, Mapping[str, Rows | None], Listeners], Objective]


@quiet_libraries()
def train_stage(
    stage: Stage,
    settings: SupervisedSettings,
    given: Mapping[str, Rows | None],
    model: GivenModel | None,
    listeners: Sequence[Listener],
    run_dir: str | Path | None,
) -> dict[str, Any]:
    """Train in a new folder ``run_dir`` (None: named after stage, model and seed); returns the summary."""
    settings = recorded(settings, **given, model=model and model[0])
    events = Listeners(listeners)
    for text in settings.without_effect():
        events.warn(text)
    with prepared(settings, stage.name, model, events) as loaded:
        learner = _learner(settings, loaded, stage.objective(settings, loaded, given, events))
        require_tensorboard(settings.tensorboard)
        name = f"{stage.name}-{Path(settings.model).name.strip('<>')}-{settings.seed}"
        with Run.create(run_dir, settings.to_json(), name) as run:
            return _train(learner, run, events)


@quiet_libraries()
def resume_stage(
    stage: Stage,
    run_dir: str | Path,
    given: Mapping[str, Rows | None],
    model: GivenModel | None,
    listeners: Sequence[Listener],
) -> dict[str, Any]:
    """Continue a run; returns the summary.

    ValueError when it is another stage's, or when something that was an object is not given; RunInUse when
    it has another writer.
    """
    events = Listeners(listeners)
    with Run.open(run_dir, own=True) as run:
        require_kind(run.path, run.settings, stage.name)
        settings = stage.kind.from_json(run.settings, run.path / "settings.json")
        objects: dict[str, object] = {**given, "model": model and model[0]}
        for name, value in objects.items():
            if value is None and str(run.settings.get(name)).startswith("<"):
                word = shlex.quote(str(run_dir))
                command = f", or tightrope resume {word} --data FILE" if name == "data" else ""
                raise ValueError(
                    f"The {name} of {run_dir} was {run.settings[name]}, an object that no file holds. Give "
                    f"it again: {name}=... in Python{command}."
                )
        settings = recorded(settings, **objects)
        with prepared(settings, stage.name, model, events) as loaded:
            objective = stage.objective(settings, loaded, given, events)
            return _train(_learner(settings, loaded, objective), run, events)


def _learner(settings: SupervisedSettings, loaded: Loaded, objective: Objective) -> SupervisedLearner:
    """The learner, with two lines in words about the model and the data."""
    trained, total = parameter_counts(loaded.model, objective.parameters)
    model = f"model: {settings.model}, {settings.tune}, {trained:,} of {total:,} parameters trained"
    return SupervisedLearner(objective, settings, [model, f"data: {objective.data}"])


def _train(learner: SupervisedLearner, run: Run, listeners: Listeners) -> dict[str, Any]:
    point = newest_point(run, listeners)
    if point is not None:
        learner.restore(point)
    continue_from(learner, run, point)
    return loop.train(learner, run, listeners)
