"""A training command around its run: the display, and the message when the run was stopped."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

from tightrope.cli.options import print_json
from tightrope.runs import checkpoint, signals
from tightrope.runs.signals import Stopped


def watched(
    run: Callable[[Any], dict[str, Any]],
    display_of: Callable[..., Any],
    given: dict[str, Any],
    *,
    what: str,
    resume: Callable[[str | None], str],
    print_end: Callable[[dict[str, Any], str | None, bool, TextIO], None],
) -> int:
    """Run ``run(display)`` and print its end; returns the exit code.

    ``display_of(stream, quiet=, live=)`` makes the display. ``resume(folder)`` is the command to type after
    SIGINT or SIGTERM; ``what`` is counted: steps, responses. ``print_end(summary, folder, quiet, stream)``.
    """
    from tightrope.cli.display import can_live

    as_json, quiet = bool(given.get("json")), bool(given.get("quiet"))
    stream = sys.stderr if as_json else sys.stdout
    live = not as_json and can_live(sys.stdout, dict(os.environ))
    display = display_of(stream, quiet=quiet, live=live)
    try:
        with signals.stoppable(), display:
            summary = run(display)
    except KeyboardInterrupt as error:
        print(farewell(error, display.run, display.step, what, resume(display.run)), file=sys.stderr)
        return code_of(error)
    if as_json:
        print_json({**summary, "run_dir": display.run})
    else:
        print_end(summary, display.run, quiet, stream)
    return 0


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
    from tightrope.runs.run import Run  # which has its saves wrapped in `uninterrupted`

    try:
        return Run.open(run).newest().folder
    except ValueError:
        return None


def code_of(error: BaseException) -> int:
    """The exit code of a command that was stopped: 130 for Ctrl-C, 143 for SIGTERM."""
    return error.code if isinstance(error, Stopped) else 130
