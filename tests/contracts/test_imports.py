"""Imports point one way, and nothing heavy is imported before it is needed."""

from __future__ import annotations

import ast
import importlib
import os
import subprocess
import sys
from collections import Counter
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from source_tree import SRC, imports, module_of, name_of, sources, tree

# The imports that a folder may have besides itself: folders of the package, or single files. Lazy imports and
# those for types count too, because they couple files as tightly.
BASE = {"errors", "findings", "settings", "metrics", "maths"}
CORE = BASE | {"algorithms", "runs"}
MAY_IMPORT = {
    "errors": set(),
    "findings": set(),
    "settings": {"errors"},
    "metrics": {"errors"},
    "maths": set(),
    "algorithms": BASE,
    "runs": BASE,
    "training": CORE,
    "control.spaces": CORE,
    "control.environments": CORE | {"control.spaces"},
    "control.policy": CORE | {"control.spaces", "control.settings"},
    "control.engine.compiled": CORE,
    "control.engine": CORE
    | {f"control.{part}" for part in ("spaces", "policy", "engine.compiled", "settings")},
    "control.rollout": CORE
    | {f"control.{part}" for part in ("spaces", "environments", "policy", "engine", "settings")},
    "control": CORE
    | {"training"}
    | {f"control.{part}" for part in ("spaces", "environments", "policy", "engine", "rollout")},
    "language.data": CORE,
    "language.model": CORE | {"language.data"},
    "language.generation": CORE | {"language.data", "language.model"},
    "language.memory": CORE | {"language.model", "language.generation", "language.settings"},
    "language.policy": CORE
    | {"language.settings", *(f"language.{part}" for part in ("data", "model", "generation", "memory"))},
    "language.reward": CORE
    | {"language.settings", *(f"language.{part}" for part in ("data", "model", "generation", "policy"))},
    "language.supervised": CORE
    | {"training", "language.settings"}
    | {f"language.{part}" for part in ("data", "model", "generation", "memory", "reward")},
    "language.alignment": CORE
    | {"training", "language.settings"}
    | {
        f"language.{part}"
        for part in ("data", "model", "generation", "memory", "policy", "reward", "supervised")
    },
    "language": CORE
    | {"training"}
    | {
        f"language.{part}"
        for part in ("data", "model", "generation", "memory", "policy", "reward", "supervised", "alignment")
    },
    "cli": {
        "errors",
        "findings",
        "settings",
        "metrics",
        "algorithms",
        "runs",
        "training",
        "control",
        "language",
    },
}
ANYTHING_OF = {"cli": ("control.", "language.")}  # the command line may use every room of the stories
LONGEST_CHAIN = {"control.": 8, "language.": 8}
# 123rd: language/model/weights.py, because load.py, which refuses files, would exceed its own limit with it
MOST_ENTRIES, MOST_FILES = 14, 123
HEAVY = ("torch", "gymnasium", "numba", "scipy", "rich", "numpy", "safetensors", "transformers")
START_SECONDS = 0.5  # in processor time, which does not depend on other load


def short(module: str) -> str:
    """A module's name without the package's."""
    return module.removeprefix("tightrope").removeprefix(".")


def folder_of(module: str) -> str:
    """The folder of a file, ``control.policy``; a file at the top level is its own folder."""
    return module.rpartition(".")[0] or module


MODULES = {short(module_of(path)): path for path in sources()}
PACKAGES = {name for name, path in MODULES.items() if path.name == "__init__.py"}


def targets(source: str, module: str) -> list[tuple[int, str]]:
    """(line, file or folder of the package) of every import in a module's source."""
    found = []
    for line, name in imports(ast.parse(source), module):
        if name.split(".")[0] == "tightrope":
            inner = short(name)
            while inner and inner not in MODULES:
                inner = inner.rpartition(".")[0]
            found.append((line, inner))
    return found


def wrong_imports(source: str, module: str) -> list[str]:
    """The imports of a module's source that point the wrong way."""
    folder = folder_of(short(module))
    allowed = MAY_IMPORT.get(folder)
    if allowed is None:  # the package's public interface, and python -m
        return []
    found = []
    for line, name in targets(source, module):
        place = name if name in PACKAGES else folder_of(name)
        if place == folder or {name, place} & allowed or name.startswith(ANYTHING_OF.get(folder, ("?",))):
            continue
        found.append(f"{module}:{line} imports {name or 'tightrope'}")
    return found


def test_imports_point_one_way():
    found = [
        wrong
        for path in sources()
        if path.name != "__init__.py"  # the __init__.py of a folder imports from that folder
        for wrong in wrong_imports(path.read_text(), module_of(path))
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("line", "module"),
    [
        ("from tightrope.control import agent", "tightrope.maths.values"),
        ("from ..control import agent", "tightrope.maths.values"),
        ("from ..algorithms.ppo import update", "tightrope.runs.run"),
        ("def f():\n    import tightrope.cli", "tightrope.control.train"),
        ("from tightrope.language import align", "tightrope.control.train"),
        ("import tightrope", "tightrope.algorithms.ppo"),
        ("from tightrope.control import agent", "tightrope.control.policy.policy"),
        (
            "if TYPE_CHECKING:\n    from tightrope.control.rollout import collector",
            "tightrope.control.engine.x",
        ),
        ("from tightrope.language.alignment import kl", "tightrope.language.reward.judge"),
    ],
)
def test_the_check_sees_a_wrong_direction(line: str, module: str):
    assert wrong_imports(line, module)


def graph() -> dict[str, set[str]]:
    """File -> the files of the package that it imports, without the __init__.py of folders."""
    files = set(MODULES) - PACKAGES
    return {
        name: {target for _, target in targets(MODULES[name].read_text(), module_of(MODULES[name]))}
        & files - {name}
        for name in files
    }


def longest_chain(edges: dict[str, set[str]], inside: str) -> list[str]:
    """The longest import chain in a folder, the importing file first. CycleError for a cycle."""
    best: dict[str, list[str]] = {}
    own = {
        name: {t for t in found if t.startswith(inside)}
        for name, found in edges.items()
        if name.startswith(inside)
    }
    for name in TopologicalSorter(own).static_order():
        best[name] = [name, *max((best[target] for target in own[name]), key=len, default=[])]
    return max(best.values(), key=len)


def test_no_file_imports_itself_by_way_of_others():
    tuple(TopologicalSorter(graph()).static_order())


def test_the_check_sees_a_circle():
    with pytest.raises(CycleError):
        longest_chain({"control.a": {"control.b"}, "control.b": {"control.a"}}, "control.")


@pytest.mark.parametrize("story", ["control.", "language."])
def test_chains_are_short(story: str):
    chain = longest_chain(graph(), story)
    print(f"longest chain in {story[:-1]}: {' > '.join(chain)}")
    assert len(chain) <= LONGEST_CHAIN[story], " > ".join(chain)


def test_folders_are_small_and_files_are_few():
    inside = Counter(path.parent for path in sources() if path.name != "__init__.py")
    for name in PACKAGES:
        inside[MODULES[name].parent.parent] += name != ""
    full = {name_of(folder): count for folder, count in inside.items() if count > MOST_ENTRIES}
    assert not full, full
    assert len(MODULES) - len(PACKAGES) <= MOST_FILES


def test_every_folder_has_a_rule():
    """A new folder in the package must be placed among the directions."""
    assert PACKAGES - {""} == set(MAY_IMPORT) - {n for n in MAY_IMPORT if n not in PACKAGES}


@pytest.mark.parametrize("package", ["tightrope", "tightrope.language"])
def test_no_module_has_the_name_of_something_public(package: str):
    """After an import, the module would hide it."""
    module = importlib.import_module(package)
    modules = {path.stem for path in Path(str(module.__file__)).parent.iterdir()}
    assert modules and not modules & set(module.__all__)


def test_maths_imports_only_torch():
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
