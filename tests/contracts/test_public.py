"""The public interface: sorted names, a docstring on everything public, types for importers."""

from __future__ import annotations

import ast
import importlib
import tomllib

import pytest
from source_tree import ROOT, SRC, imports, module_of, name_of, sources, tree

import tightrope

DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)


def without_docstring(node: ast.Module | ast.ClassDef, prefix: str = "") -> list[str]:
    """Public functions, classes and methods without a docstring; stubs of overloads need none."""
    found = []
    for child in node.body:
        if not isinstance(child, DEFINITIONS) or child.name.startswith("_"):
            continue
        if ast.get_docstring(child) is None:
            found.append(prefix + child.name)
        if isinstance(child, ast.ClassDef):
            found += without_docstring(child, f"{prefix}{child.name}.")
    return found


def test_everything_public_has_a_docstring():
    found = [f"{name_of(p)}: {name}" for p in sources() for name in without_docstring(tree(p))]
    assert not found, "\n".join(found)


def test_every_module_has_a_docstring():
    assert not [name_of(p) for p in sources() if ast.get_docstring(tree(p)) is None]


def test_names_are_sorted():
    for path in sources():
        for node in tree(path).body:
            if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
                names = ast.literal_eval(node.value)
                assert names == sorted(names), name_of(path)


def test_packages_list_their_public_names():
    for path in sources():
        if path.name == "__init__.py":
            package = importlib.import_module(module_of(path))
            for name in package.__all__:
                there = (path.parent / f"{name}.py").is_file() or getattr(package, name) is not None
                assert there, f"{module_of(path)} has no {name}"


def test_the_rooms_of_a_story_are_entered_through_what_they_list():
    """`tightrope.control.engine` lists `base` and `choose`: no file outside the folder imports another."""
    rooms = {
        module_of(p): importlib.import_module(module_of(p)).__all__
        for p in sources()
        if p.name == "__init__.py" and module_of(p).count(".") >= 2
    }
    assert len(rooms) >= 12
    modules = {module_of(p) for p in sources()}
    entered = {room: set() for room in rooms}
    for path in sources():
        for line, target in imports(tree(path), module_of(path), package=path.name == "__init__.py"):
            module = target if target in modules else target.rpartition(".")[0]
            room, _, name = module.rpartition(".")
            if room in rooms and not (module_of(path) + ".").startswith(room + "."):
                assert name in rooms[room], f"{name_of(path)}:{line}: {room} does not list {name}"
                entered[room].add(name)
    assert {room: sorted(names) for room, names in entered.items()} == rooms


def test_every_public_name_is_there():
    for name in tightrope.__all__:
        assert getattr(tightrope, name) is not None
    with pytest.raises(AttributeError, match="it has A2C"):
        tightrope.Nothing  # noqa: B018 - the access is the test


# no errors: they end a run or a call from outside, and `except Exception` must not catch them
STOP_SIGNALS = {"tightrope.runs.signals.Stopped", "tightrope.control.environments.faults.EnvironmentTimeout"}


def exceptions() -> dict[str, type[BaseException]]:
    """Every exception class of the package by its full name."""
    found = {}
    for path in sources():
        names = [node.name for node in ast.walk(tree(path)) if isinstance(node, ast.ClassDef) and node.bases]
        module = importlib.import_module(module_of(path)) if names and path.stem != "__main__" else None
        for name in names:
            kind = getattr(module, name, None)
            if isinstance(kind, type) and issubclass(kind, BaseException):
                found[f"{kind.__module__}.{name}"] = kind
    return found


def test_every_exception_has_the_one_base():
    """errors.py names each of them; stop signals are no errors."""
    found = exceptions()
    outside = {name for name, kind in found.items() if not issubclass(kind, tightrope.TightropeError)}
    assert outside == STOP_SIGNALS
    assert not any(issubclass(found[name], Exception) for name in STOP_SIGNALS)
    drawn = tightrope.errors.__doc__
    for name, kind in found.items():
        assert kind.__name__ in drawn, name
        other = kind.__bases__[1].__name__ if len(kind.__bases__) > 1 else kind.__name__
        assert other in drawn, f"{name} inherits {other}"


def test_version_is_the_same_everywhere():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert tightrope.__version__ == project["version"]
    assert f"## [{tightrope.__version__}]" in (ROOT / "CHANGELOG.md").read_text()


def test_types_are_delivered():
    data = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    assert (SRC / "py.typed").is_file()
    assert "py.typed" in data["tightrope"]
