"""The run of stage one or two around its loop: new or gone on with, announced, summed up.

What a file holds is read again when a run goes on; an object in Python must be given again.
"""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from torch import nn

from tightrope.language.model.parts import parameter_counts
from tightrope.language.settings import SupervisedSettings
from tightrope.language.supervised.prepare import Loaded
from tightrope.runs.run import Run
from tightrope.training.report import Reporter

Settings = TypeVar("Settings", bound=SupervisedSettings)


def recorded(settings: Settings, **given: Any) -> Settings:
    """The settings that settings.json keeps: a path that was given in Python replaces the name that stood
    there, an object leaves its type, as <list>; None leaves what there is.
    """
    names: dict[str, Any] = {
        name: str(value) if isinstance(value, str | Path) else f"<{type(value).__name__}>"
        for name, value in given.items()
        if value is not None
    }
    return dataclasses.replace(settings, **names)


def reopened(kind: type[Settings], run_dir: str | Path, **given: Any) -> tuple[Run, Settings]:
    """A run to go on with, locked, and its settings with what is given again now.

    ValueError when it is another command's, or when something that was an object is not given; RunInUse when
    it has another writer.
    """
    run = Run.open(run_dir, own=True)
    try:
        return run, _settings_again(kind, run, run_dir, given)
    except BaseException:
        run.close()
        raise


def _settings_again(kind: type[Settings], run: Run, run_dir: str | Path, given: dict[str, Any]) -> Settings:
    unknown = sorted(set(run.settings) - {field.name for field in dataclasses.fields(kind)})
    if unknown:
        raise ValueError(f"{run_dir} has settings that {kind.__name__} has not: {', '.join(unknown)}.")
    for name, value in given.items():
        if value is None and str(run.settings.get(name)).startswith("<"):
            word = shlex.quote(str(run_dir))
            command = f", or tightrope resume {word} --data FILE" if name == "data" else ""
            raise ValueError(
                f"The {name} of {run_dir} was {run.settings[name]}, an object that no file holds. Give it "
                f"again: {name}=... in Python{command}."
            )
    return recorded(kind(**run.settings), **given)


def opened(run: Run | str | Path | None, settings: SupervisedSettings, command: str) -> Run:
    """The run that goes on, or a new one in this folder (None: named after command, model and seed)."""
    if isinstance(run, Run):
        return run
    name = f"{command}-{Path(settings.model).name.strip('<>')}-{settings.seed}"
    return Run.create(run, dataclasses.asdict(settings), name)


def announcement(
    settings: SupervisedSettings, loaded: Loaded, parameters: Sequence[nn.Parameter], data: str
) -> list[str]:
    """Two lines in words: the model and the data."""
    trained, total = parameter_counts(loaded.model, parameters)
    return [
        f"model: {settings.model}, {settings.tune}, {trained:,} of {total:,} parameters trained",
        f"data: {data}",
    ]


def finish(
    settings: SupervisedSettings, run: Run, report: Reporter, final: dict[str, float], **more: Any
) -> dict[str, Any]:
    """Write summary.json and report it; returns it."""
    summary = {
        "model": settings.model,
        "seed": settings.seed,
        **more,
        "wall_seconds": final.get("time/seconds", 0.0),
        "final": {name: value for name, value in final.items() if name != "time/seconds"},
        "run_dir": str(run.path),
    }
    run.finish(summary)
    report("finish", summary)
    return summary
