"""Rewrite the generated tables of docs/: python docs/tables.py

A table is between `<!-- table:NAME -->` and `<!-- end -->`; a test fails if it is out of date.
"""

from __future__ import annotations

import json
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
MEASURED = PAGE.parents[1] / "benchmarks/results/language/families.json"


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


def families() -> list[str]:
    """The family table, from what benchmarks/families.py measured; refusals are sentences below it."""
    found = json.loads(MEASURED.read_text(encoding="utf-8"))
    versions = ", ".join(f"{name} {version}" for name, version in found["versions"].items())
    lines = [
        f"{found['date']}, {versions}; a cell is the largest difference, at most {found['tolerance']:g}.",
        "",
    ]
    columns = ("doctor", "sft", "reload", "peft", "reward", "align_lora", "align_full")
    lines += [row("family", *(name.replace("_", " ") for name in columns)), "|---" * (len(columns) + 1) + "|"]
    reasons: dict[str, list[str]] = {}
    for kind, cells in found["rows"].items():
        if "not_built" in cells:
            reasons.setdefault(f"No tiny model: {cells['not_built']}", []).append(kind)
            continue
        lines.append(row(kind, *(_verdict(cells.get(name, {})) for name in columns)))
        for name in columns:
            if cells.get(name, {}).get("verdict") == "refused" and not cells[name]["text"].startswith("as "):
                text = re.sub(r"\S*/", "", cells[name]["text"])
                text = text.replace(cells["class"], "(class)").replace(f"model type {kind}", "model type")
                reasons.setdefault(text, []).append(kind)
    lines += ["", row("said of", "sentence"), "|---|---|"]
    return lines + [row(", ".join(dict.fromkeys(kinds)), text) for text, kinds in reasons.items()]


def _verdict(cell: dict[str, Any]) -> str:
    if cell.get("verdict") == "ok":
        return f"{cell['value']:.0e}" if cell["value"] else "ok"
    return str(cell.get("verdict", ""))


TABLES = {"metrics": metrics, "presets": presets, "settings": settings}
LANGUAGE_TABLES = {"metrics": language_metrics}
FAMILY_TABLES = {"families": families}


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
PAGES[PAGE.with_name("families.md")] = FAMILY_TABLES

if __name__ == "__main__":
    for page, tables in PAGES.items():
        page.write_text(filled(page.read_text(encoding="utf-8"), tables), encoding="utf-8")
