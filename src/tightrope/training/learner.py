"""What the training loop trains: control agents, alignment, supervised fine-tuning and reward models."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

from tightrope.runs.records import figures
from tightrope.runs.retention import Checkpoint
from tightrope.runs.run import Run
from tightrope.training.parameters import Tensors

# settings that are read before every update, so that a listener can change them during a run
CHANGEABLE = (
    "learning_rate", "critic_learning_rate", "clip", "clip_high", "value_clip", "target_kl",
    "entropy_weight", "value_weight", "max_grad_norm",
)  # fmt: skip


@dataclass(frozen=True)
class Update:
    """One update: the steps so far, the budget, every metric, and what was collected for it.

    ``before``: ``step`` before the update. ``on_grid``: it reached a point of the checkpoint grid, whether or
    not anything is saved. ``episodes`` that ended: (return, length, terminated), and ``seeds`` of each: (the
    seed, 0), or the last one before it and how many episodes later it began; None: its copy has none of its
    own. ``samples``: rows of
    samples.jsonl. ``pause``: seconds of it that were not training.
    """

    step: int
    total_steps: int
    metrics: dict[str, float]
    before: int
    on_grid: bool = False
    episodes: list[tuple[float, int, bool]] = field(default_factory=list)
    samples: list[dict[str, Any]] = field(default_factory=list)
    pause: float = 0.0
    seeds: list[tuple[int | None, int]] = field(default_factory=list)


def update_of(saved: dict[str, Any]) -> Update:
    """The update that a checkpoint holds as JSON."""
    checked = {
        **{name: int(saved[name]) for name in ("step", "total_steps", "before")},
        "on_grid": bool(saved["on_grid"]),
        "metrics": figures(saved["metrics"]),
        "episodes": [(float(r), int(n), bool(t)) for r, n, t in saved["episodes"]],
        "samples": [dict(row) for row in saved["samples"]],
        "pause": 0.0,
    }
    return Update(**{**saved, **checked})


class Learner(Protocol):
    """State and updates of a run; `loop.train` does everything else.

    ``seconds`` of training, ``changes`` of settings and the update ``pending``, which is done and not yet
    recorded, are kept by the loop.
    """

    seconds: float
    changes: dict[str, Any]
    pending: Update | None

    @property
    def settings(self) -> Any:
        """The settings of the command, a `Settings`."""

    @property
    def rollbacks(self) -> int:
        """How often `roll_back` was called in this run."""

    @property
    def position(self) -> int:
        """Steps so far."""

    @property
    def total(self) -> int:
        """Steps of the whole run."""

    @property
    def complete(self) -> bool:
        """Whether all updates are done."""

    @property
    def merit(self) -> float | None:
        """How good the present state is: the best checkpoint is kept. None: not known."""

    def begin(self) -> list[str]:
        """Prepare for the first update; returns lines that describe the run."""

    def iterate(self) -> Iterator[Update]:
        """The updates from the present position on. The loop lets no signal interrupt them; what can be left
        at any moment is `signals.interruptible`. When a KeyboardInterrupt comes out, the learner is as it was
        after its newest update.
        """

    def evaluate(self, update: Update | None) -> dict[str, float]:
        """The figures that are due after this update (None: before the first); empty when none are."""

    def conclude(self) -> dict[str, float]:
        """After the last update and before the last save: the final figures, where there are any."""

    def snapshot(self) -> tuple[Tensors, dict[str, Any]]:
        """Everything that `restore` needs, as tensors and JSON."""

    def restore(self, point: Checkpoint) -> None:
        """Restore a checkpoint. ValueError if it does not belong to this run."""

    def roll_back(self, point: Checkpoint) -> None:
        """Restore a checkpoint, use other random numbers from there on, and count the rollback."""

    def finish(self, run: Run) -> dict[str, Any]:
        """Write the final files besides checkpoints; returns the summary."""


def change(learner: Learner, setting: str, value: object) -> None:
    """Use another value of a setting from the next update on. ValueError for what cannot be changed."""
    settings = getattr(learner.settings, "update", learner.settings)  # the update rule's, where there is one
    names = [name for name in CHANGEABLE if hasattr(settings, name)]
    if setting not in names:
        raise ValueError(f"{setting!r} cannot change during a run; these can: {', '.join(names)}.")
    if isinstance(value, bool) or not isinstance(value, int | float | None):
        raise ValueError(f"{setting} is to become {value!r}; expected a number or None.")
    dataclasses.replace(settings, **{setting: value})  # checks the range
    learner.changes[setting] = value


def crosses(before: float, after: float, total: float, fraction: float | None) -> bool:
    """Whether one of ``fraction * total``, ``2 fraction * total``, ... lies in (before, after].

    Several at once count as one. ``fraction`` None: there are no points. The total itself is a point if the
    fraction divides it. A point that is missed only by a rounding error counts as reached.
    """
    if fraction is None:
        return False
    first, last = (int(step / total / fraction + 1e-9) for step in (before, after))
    return last > first
