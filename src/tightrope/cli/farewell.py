"""The message of a command whose run was stopped: the newest checkpoint and how to resume."""

from __future__ import annotations

import warnings
from pathlib import Path

from tightrope.runs import checkpoint
from tightrope.runs.signals import Stopped


def farewell(error: BaseException, run: str | None, step: int, what: str, command: str) -> str:
    """The message for a ``run`` (None: not begun) that was stopped at ``step``: its newest valid checkpoint,
    what will be repeated, and the ``command`` that resumes it. ``what`` is counted: steps, responses.
    """
    by = f" by {error}" if isinstance(error, Stopped) else ""
    if run is None:
        return f"Stopped{by} before the run began."
    text = f"Stopped{by} at {what.removesuffix('s')} {step:,}. "
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # `resume` reports damaged checkpoints
        folder = newest(run)
    if folder is None:
        text += f"There is no checkpoint yet: all {step:,} {what} will be repeated."
    else:
        saved = max(0, step - checkpoint.step_of(folder))
        text += f"The newest valid checkpoint is {folder}; {saved:,} {what} since then will be repeated."
    return f"{text} Go on with:\n  {command}"


def newest(run: str) -> Path | None:
    """The folder of a run's newest valid checkpoint; None where there is none."""
    from tightrope.runs.run import Run  # which has its saves wrapped in `whole`

    try:
        return Run.open(run).newest().folder
    except ValueError:
        return None


def code_of(error: BaseException) -> int:
    """The exit code of a command that was stopped: 130 for Ctrl-C, 143 for SIGTERM."""
    return error.code if isinstance(error, Stopped) else 130
