"""Where a run continues: at its newest checkpoint, with the changes of settings that were made before it."""

from __future__ import annotations

from tightrope.runs.checkpoint import understood
from tightrope.runs.retention import Checkpoint, steps_in
from tightrope.runs.run import Run
from tightrope.training.events import Listeners
from tightrope.training.learner import Learner, change, update_of


def newest_point(run: Run, listeners: Listeners) -> Checkpoint | None:
    """The newest usable checkpoint; None if the run has saved nothing yet."""
    if steps_in(run.checkpoints):
        return run.resume_point(listeners.warn, listeners.info)
    if run.read_metrics():
        listeners.warn(f"{run.path} has rows and no checkpoint; it begins at step 0 again.")
    return None


def continue_from(learner: Learner, run: Run, point: Checkpoint | None) -> None:
    """Bring the run folder to the position of the learner, ``point`` (None: the beginning). Later rows are
    removed, and settings.json gets the present settings.
    """
    run.rewind(point)
    run.update_settings(learner.settings.to_json())
    restore_rows(learner, run, point)


def restore_rows(learner: Learner, run: Run, point: Checkpoint | None) -> None:
    """Apply exactly the changes of settings that the run has recorded; and the update of ``point`` that it
    had not recorded yet is pending again.
    """
    learner.changes.clear()
    with understood(run.path):
        for row in run.read_changes():
            change(learner, row["setting"], row["value"])
    pending = None if point is None else point.state.get("pending")
    with understood(run.path if point is None else point.folder):
        learner.pending = None if pending is None else update_of(pending)
