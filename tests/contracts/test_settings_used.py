"""Every setting is read by the code that it claims to control, and every one is documented."""

from __future__ import annotations

import ast
import dataclasses

import pytest
from source_tree import SRC, name_of, sources, tree

from tightrope.algorithms.settings import UpdateSettings
from tightrope.control.settings import ALGORITHM_SETTINGS, TrainSettings

KINDS = (TrainSettings, UpdateSettings, *ALGORITHM_SETTINGS.values())
FIELDS = sorted({field.name for kind in KINDS for field in dataclasses.fields(kind)})
# where settings are declared, checked, preset or made flags: reading them there proves nothing
DECLARED_IN = {
    SRC / name
    for name in (
        "algorithms/settings.py",
        "settings/fields.py",
        "control/settings.py",
        "control/presets.py",
        "cli/options.py",
        "cli/flags.py",
    )
}


def attributes_read() -> set[str]:
    """Every ``x.name`` that the rest of the package reads and does not call."""
    found = set()
    for path in sources():
        if path in DECLARED_IN:
            continue
        called = {id(node.func) for node in ast.walk(tree(path)) if isinstance(node, ast.Call)}
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load) and id(node) not in called:
                found.add(node.attr)
    return found


READ = attributes_read()


@pytest.mark.parametrize("name", [name for name in FIELDS if not name.endswith("_schedule")])
def test_every_setting_is_read(name: str):
    assert name in READ, f"{name} is a setting that nothing reads: make it act, or take it out"


@pytest.mark.parametrize("name", [name for name in FIELDS if name.endswith("_schedule")])
def test_every_schedule_moves_its_setting(name: str):
    """Schedules are read by their suffix: half-way, a linear one has halved its setting."""
    kind = next(k for k in KINDS[1:] if name in {f.name for f in dataclasses.fields(k)})
    base = name.removesuffix("_schedule")
    settings = kind(**{name: "linear", base: 0.1})
    assert getattr(settings.at(0.5), base) == pytest.approx(0.05)


@pytest.mark.parametrize("kind", KINDS)
def test_every_setting_explains_itself(kind: type):
    """A docstring on the field: the same line is the --help."""
    for field in dataclasses.fields(kind):
        doc = field.metadata.get("doc", "")
        assert doc.endswith("."), f"{kind.__name__}.{field.name}: {doc!r}"
        assert len(doc) <= 100, f"{kind.__name__}.{field.name}: one line, not {len(doc)} characters"


@pytest.mark.parametrize("kind", KINDS)
def test_settings_are_frozen_data(kind: type):
    """Nothing fills a field at run time."""
    settings = kind()
    with pytest.raises(dataclasses.FrozenInstanceError):
        settings.gamma = 0.5


def test_declarations_are_where_we_think():
    assert not [name_of(path) for path in DECLARED_IN if not path.is_file()]
