"""The public interface: sorted names, a docstring on everything public, types for importers."""

from __future__ import annotations

import ast
import tomllib

import pytest
from source_tree import ROOT, SRC, name_of, sources, tree

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


def test_every_public_name_is_there():
    for name in tightrope.__all__:
        assert getattr(tightrope, name) is not None
    with pytest.raises(AttributeError, match="it has A2C"):
        tightrope.Nothing  # noqa: B018 - the access is the test


def test_version_is_the_same_everywhere():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert tightrope.__version__ == project["version"]
    assert f"## [{tightrope.__version__}]" in (ROOT / "CHANGELOG.md").read_text()


def test_types_are_delivered():
    data = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    assert (SRC / "py.typed").is_file()
    assert "py.typed" in data["tightrope"]
