"""A run of sft or reward: new or resumed.

Files are read again when a run is resumed; an object in Python must be given again.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tightrope.language.model.architecture import parameter_counts
from tightrope.language.model.load import quiet_libraries
from tightrope.language.settings import SupervisedSettings, recorded
from tightrope.language.supervised.fit import Objective, SupervisedLearner
from tightrope.language.supervised.prepare import Loaded, prepared
from tightrope.runs.folders import require_kind
from tightrope.runs.run import Run
from tightrope.training import loop
from tightrope.training.events import Listener, Listeners
from tightrope.training.loop import continue_from, newest_point
from tightrope.training.tensorboard import require_tensorboard


class Stage(NamedTuple):
    """A supervised stage: its ``name``, which is also its adapter's; the class of its settings; and
    ``objective``, which reads the data from what was given, or from the files that the settings name.
    """

    name: str
    kind: type[SupervisedSettings]
    objective: Callable[[Any, Loaded, dict[str, Any], Listeners], Objective]


@quiet_libraries()
def train_stage(
    stage: Stage,
    settings: SupervisedSettings,
    given: dict[str, Any],
    model: tuple[Any, Any] | None,
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
    given: dict[str, Any],
    model: tuple[Any, Any] | None,
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
        objects = {**given, "model": model and model[0]}
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
