"""One name, one meaning: a public name is defined in one file, or belongs to an interface."""

from __future__ import annotations

import ast
from collections import defaultdict

from source_tree import SRC, sources, tree

# The same thing for different owners, on purpose.
INTERFACES = {
    "load": "read what was saved: an agent, a prepared model, a checkpoint",
    "resume": "continue a run",
    "train": "train a run: the command, the control story, the loop",
    "update": "one update of the policy by an update rule",
}
# Left to rename. Take a name out when it is gone; never add one.
LEFT: set[str] = set()


def defined(module: ast.Module) -> set[str]:
    """The functions, classes and constants at the top of a module whose name has no underscore in front."""
    names: set[str] = set()
    for node in module.body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign):
            names |= {target.id for target in node.targets if isinstance(target, ast.Name)}
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            names.add(node.target.id)
    return {name for name in names if not name.startswith("_")}


def homonyms() -> dict[str, list[str]]:
    """Public top-level names that more than one file defines, and the files."""
    homes = defaultdict(list)
    for path in sources():
        for name in defined(tree(path)):
            homes[name].append(path.relative_to(SRC).as_posix())
    return {name: files for name, files in sorted(homes.items()) if len(files) > 1}


def test_a_public_name_means_one_thing():
    found = {name: files for name, files in homonyms().items() if name not in INTERFACES.keys() | LEFT}
    assert not found, f"rename all but one of each: {found}"


def test_the_lists_hold_nothing_that_is_gone():
    gone = (INTERFACES.keys() | LEFT) - homonyms().keys()
    assert not gone, f"take these out of INTERFACES or LEFT: {sorted(gone)}"
    assert not INTERFACES.keys() & LEFT


def test_the_check_sees_every_kind_of_name():
    source = "def f(): ...\nclass C: ...\nA = 1\nB: int = 2\n_private = 3\nif True:\n    inside = 4"
    assert defined(ast.parse(source)) == {"f", "C", "A", "B"}
