"""Imports point one way, and nothing heavy is imported before it is needed."""

from __future__ import annotations

import ast
import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest
from source_tree import SRC, imports, module_of, name_of, sources, tree

# what each part of the package may import from the package
MAY_IMPORT = {
    "maths": {"maths"},
    "algorithms": {"maths", "algorithms"},
    "runs": {"runs"},
    "control": {"maths", "algorithms", "runs", "control"},
    "language": {"maths", "algorithms", "runs", "language"},
}
HEAVY = ("torch", "gymnasium", "numba", "scipy", "rich", "numpy", "safetensors", "transformers")
START_SECONDS = 0.5  # of the processor's time: a busy machine does not change it


def wrong_imports(source: str, module: str) -> list[str]:
    """The imports of a module's source that point the wrong way."""
    part = module.split(".")[1] if module.count(".") else ""
    if part not in MAY_IMPORT:
        return []
    found = []
    for line, name in imports(ast.parse(source), module):
        names = name.split(".")
        if names[0] == "tightrope" and (len(names) < 2 or names[1] not in MAY_IMPORT[part]):
            found.append(f"{module}:{line} imports {name}")
    return found


def test_imports_point_one_way():
    """maths <- algorithms <- {control, language} <- cli; runs stands aside."""
    found = [wrong for path in sources() for wrong in wrong_imports(path.read_text(), module_of(path))]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("line", "module"),
    [
        ("from tightrope.control import agent", "tightrope.maths.values"),
        ("from ..control import agent", "tightrope.maths.values"),
        ("from ..algorithms.ppo import update", "tightrope.runs.run"),
        ("def f():\n    import tightrope.cli.main", "tightrope.control.train"),
        ("from tightrope.language import align", "tightrope.control.train"),
        ("import tightrope", "tightrope.algorithms.ppo"),
    ],
)
def test_the_check_sees_a_wrong_direction(line: str, module: str):
    assert wrong_imports(line, module)


def test_every_part_has_a_rule():
    """A new folder in the package must be placed among the directions."""
    folders = {path.name for path in SRC.iterdir() if path.is_dir() and list(path.glob("*.py"))}
    assert folders <= set(MAY_IMPORT), folders - set(MAY_IMPORT)


@pytest.mark.parametrize("package", ["tightrope", "tightrope.language"])
def test_no_module_has_the_name_of_something_public(package: str):
    """Once imported, the module would stand in its place."""
    module = importlib.import_module(package)
    modules = {path.stem for path in Path(str(module.__file__)).parent.iterdir()}
    assert modules and not modules & set(module.__all__)


def test_maths_imports_torch_alone():
    allowed = {"torch", "tightrope", "__future__", "math", "dataclasses", "collections", "typing"}
    for path in (p for p in sources() if p.is_relative_to(SRC / "maths")):
        for line, name in imports(tree(path), module_of(path)):
            assert name.split(".")[0] in allowed, f"{name_of(path)}:{line} imports {name}"


@pytest.mark.parametrize(
    "code",
    [
        "import tightrope",
        "from tightrope.cli.main import main; main(['--help'])",
        "from tightrope.cli.main import main; main(['train', '--help'])",
    ],
)
def test_start_is_light(code: str):
    """`import tightrope` and every --help: under half a second, without torch and the like."""
    program = (
        "import sys, time\n"
        "try:\n"
        f"    {code}\n"
        "except SystemExit:\n"
        "    pass\n"
        f"print(); print(*[name for name in {HEAVY} if name in sys.modules], time.process_time())"
    )
    environment = {**os.environ, "PYTHONPATH": str(SRC.parent)}
    result = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    *heavy, seconds = result.stdout.splitlines()[-1].split()
    assert not heavy, f"{code} imports {heavy}"
    assert float(seconds) < START_SECONDS
