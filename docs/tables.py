"""Rewrite the generated tables of docs/control.md: python docs/tables.py

A table is between `<!-- table:NAME -->` and `<!-- end -->`; a test fails if it is out of date.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tightrope.cli.flags import settings_fields
from tightrope.control.presets import BY_TASK
from tightrope.control.settings import ALGORITHM_SETTINGS, TrainSettings
from tightrope.metrics.declare import Metric
from tightrope.metrics.table import FAMILIES, of_story
from tightrope.settings.fields import range_text

PAGE = Path(__file__).with_name("control.md")


def row(*cells: str) -> str:
    """One line of a table."""
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def shown(value: Any) -> str:
    """A value as the command line takes it."""
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, tuple):
        return " ".join(map(str, value))
    return "none" if value is None else f"{value:,}" if isinstance(value, int) else str(value)


def metrics() -> list[str]:
    """Every metric of a control run, from metrics/."""
    return _metric_table(of_story("control"))


def language_metrics() -> list[str]:
    """Every metric of a language run, from metrics/."""
    table = _metric_table(of_story("language"))
    return table + [row(f"`{m.name}NAME`", m.unit, m.healthy, m.doc) for m in FAMILIES.values()]


def _metric_table(metrics: list[Metric]) -> list[str]:
    lines = [row("metric", "unit", "healthy", "meaning"), "|---|---|---|---|"]
    return lines + [row(f"`{m.name}`", m.unit, m.healthy, m.doc) for m in metrics]


def presets() -> list[str]:
    """The changes of each preset, from control/presets.py."""
    lines = [row("task", "algorithm", "what it changes"), "|---|---|---|"]
    for algorithm, tasks in BY_TASK.items():
        for task, values in tasks.items():
            changes = ", ".join(f"{name} {shown(value)}" for name, value in values.items())
            lines.append(row(task, algorithm, changes))
    return lines


def settings() -> list[str]:
    """Every setting, from the dataclasses; those of PPO last."""
    lines = [row("setting", "default", "range", "meaning"), "|---|---|---|---|"]
    for kind in (TrainSettings, ALGORITHM_SETTINGS["ppo"]):
        for name, field in settings_fields(kind).items():
            limits = range_text(field.metadata)
            lines.append(row(f"`{name}`", shown(field.default), limits, field.metadata["doc"]))
    return lines


TABLES = {"metrics": metrics, "presets": presets, "settings": settings}
LANGUAGE_TABLES = {"metrics": language_metrics}


def filled(text: str, tables: dict[str, Callable[[], list[str]]] = TABLES) -> str:
    """The text of a page with every table updated from the code. ValueError unless each has one place."""
    for name, build in tables.items():
        table = "\n".join([f"<!-- table:{name} -->", "", *build(), "", "<!-- end -->"])
        text, found = re.subn(
            rf"<!-- table:{name} -->.*?<!-- end -->", lambda _, t=table: t, text, flags=re.S
        )
        if found != 1:
            raise ValueError(f"The page has {found} places for the table {name!r}, expected one.")
    return text


PAGES = {PAGE: TABLES, PAGE.with_name("rlhf.md"): LANGUAGE_TABLES}

if __name__ == "__main__":
    for page, tables in PAGES.items():
        page.write_text(filled(page.read_text(encoding="utf-8"), tables), encoding="utf-8")
