"""The checkpoints of a run: the newest valid one, and which are kept."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from tightrope.runs.checkpoint import CheckpointError, load, load_state, step_of
from tightrope.runs.durable import ASIDE, present, remove
from tightrope.runs.records import RECORDS

if TYPE_CHECKING:
    from torch import Tensor

ATTEMPTS = 5  # to read the newest checkpoint while the writer deletes some


class Checkpoint(NamedTuple):
    """A checkpoint that was read: its folder, its tensors (on the CPU) and its state."""

    folder: Path
    tensors: dict[str, dict[str, Tensor]]
    state: dict[str, Any]


def steps_in(checkpoints: Path) -> list[Path]:
    """The checkpoint folders of a run, valid or not, the oldest first; also one that was renamed for a
    replacement.
    """
    inside = checkpoints.iterdir() if checkpoints.is_dir() else ()
    found = {path.with_name(path.name.removeprefix(ASIDE)) for path in inside}
    return sorted((path for path in found if step_of(path) >= 0), key=step_of)


def valid(
    checkpoints: Path, warn: Callable[[str], None] | None = None, accept: Callable[..., None] | None = None
) -> Checkpoint:
    """The newest valid checkpoint in a folder of them, read.

    A damaged one is passed over, and so is one for which ``accept`` raises CheckpointError; ``warn`` gets
    which and why (None: a Python warning). One that its writer deletes meanwhile is no longer looked for.
    CheckpointError when none is left.
    """
    checkpoints, why = Path(checkpoints), ""
    warn = warn or _warn
    for _ in range(ATTEMPTS):
        found, vanished = steps_in(checkpoints), False
        for folder in reversed(found):
            try:
                read = Checkpoint(folder, *load(folder))
                if accept is not None:
                    accept(read)
                return read
            except CheckpointError as error:
                vanished = not present(folder).exists()
                if vanished:  # there is a newer one now
                    break
                why = str(error)
                warn(f"Checkpoint passed over: {why}")
        if not vanished:
            break
    if found:
        raise CheckpointError(
            f"{checkpoints} holds no valid checkpoint, none of {len(found)} can be used. The oldest: {why}"
        )
    raise CheckpointError(
        f"{checkpoints} holds no checkpoint: the run stopped before its first. Train again."
    )


def _warn(text: str) -> None:
    warnings.warn(text, stacklevel=3)


def marks_of(point: Checkpoint) -> dict[str, dict[str, Any]]:
    """The lengths of the record files at a checkpoint, by name. CheckpointError if they are missing."""
    marks = point.state.get("records")
    if not isinstance(marks, dict) or not all(map(_is_mark, marks.values())):
        raise CheckpointError(f"{point.folder / 'state.json'} does not say what had been recorded.")
    return {name: marks[name] for name in RECORDS if name in marks}


def _is_mark(mark: Any) -> bool:
    size = mark.get("bytes") if isinstance(mark, dict) else None
    return isinstance(size, int) and size >= 0 and "sha256" in mark


def prune(checkpoints: Path, keep: int | None) -> list[Path]:
    """Delete all but the newest ``keep`` checkpoints (None: delete none) and the best of the others, the one
    whose state has the highest ``merit``; returns the deleted folders.

    Call it after the newest one was verified, so that a valid one is left whatever happened to the others.
    """
    older = [] if keep is None else steps_in(checkpoints)[: -max(keep, 1)]
    if not older:
        return []
    merits = {folder: _merit(folder) for folder in steps_in(checkpoints)}
    best = max(merits, key=lambda folder: (merits[folder], -step_of(folder)))
    gone = [folder for folder in older if folder != best or merits[folder] == -math.inf]
    for folder in gone:
        remove(folder)
    return gone


def _merit(folder: Path) -> float:
    try:
        merit = load_state(folder).get("merit")
    except (CheckpointError, OSError):
        return -math.inf
    return float(merit) if isinstance(merit, int | float) else -math.inf
