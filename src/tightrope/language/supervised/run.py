"""A run of sft or reward: new or resumed.

Files are read again when a run is resumed; an object in Python must be given again.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from torch import nn

from tightrope.language.model.parts import parameter_counts
from tightrope.language.settings import SupervisedSettings
from tightrope.language.supervised.fit import Objective, SupervisedLearner
from tightrope.language.supervised.prepare import Loaded
from tightrope.runs.run import Run
from tightrope.training import loop
from tightrope.training.events import Listeners
from tightrope.training.resume import continue_from, newest_point
from tightrope.training.tensorboard import require_tensorboard

Settings = TypeVar("Settings", bound=SupervisedSettings)


def recorded(settings: Settings, **given: Any) -> Settings:
    """The settings that settings.json keeps of what was given in Python: paths are stored as text, objects as
    their <type>; None keeps the setting.
    """
    names: dict[str, Any] = {
        name: str(value) if isinstance(value, str | Path) else f"<{type(value).__name__}>"
        for name, value in given.items()
        if value is not None
    }
    return settings.with_values(**names)


def reopened(kind: type[Settings], run_dir: str | Path, **given: Any) -> tuple[Run, Settings]:
    """A run to continue, locked, and its settings with what is given again now.

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
    settings = kind.from_json(run.settings, run.path / "settings.json")
    for name, value in given.items():
        if value is None and str(run.settings.get(name)).startswith("<"):
            word = shlex.quote(str(run_dir))
            command = f", or tightrope resume {word} --data FILE" if name == "data" else ""
            raise ValueError(
                f"The {name} of {run_dir} was {run.settings[name]}, an object that no file holds. Give it "
                f"again: {name}=... in Python{command}."
            )
    return recorded(settings, **given)


def train_supervised(
    objective: Objective,
    parameters: Sequence[nn.Parameter],
    settings: SupervisedSettings,
    loaded: Loaded,
    place: Run | str | Path | None,
    listeners: Listeners,
    data: str,
) -> dict[str, Any]:
    """Train in the run that continues, or in a new folder ``place`` (None: named after command, model and
    seed); ``data`` describes the data. Returns the summary.
    """
    learner = SupervisedLearner(objective, parameters, settings, _lines(settings, loaded, parameters, data))
    if isinstance(place, Run):
        run = place
    else:
        require_tensorboard(settings.tensorboard)
        name = f"{objective.name}-{Path(settings.model).name.strip('<>')}-{settings.seed}"
        run = Run.create(place, settings.to_json(), name)
    with run:
        point = newest_point(run, listeners)
        if point is not None:
            learner.restore(point)
        continue_from(learner, run, point)
        return loop.train(learner, run, listeners)


def _lines(
    settings: SupervisedSettings, loaded: Loaded, parameters: Sequence[nn.Parameter], data: str
) -> list[str]:
    """Two lines in words: the model and the data."""
    trained, total = parameter_counts(loaded.model, parameters)
    return [
        f"model: {settings.model}, {settings.tune}, {trained:,} of {total:,} parameters trained",
        f"data: {data}",
    ]
