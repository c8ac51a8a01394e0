"""Code that fits on a screen: limits for files, functions, nesting and lines of the package."""

from __future__ import annotations

import ast
from collections.abc import Callable
from typing import Any

from source_tree import name_of, sources, tree

FILE, FUNCTION, NESTING, LINE = 500, 60, 4, 110
SMELL = 350  # lines of a file: ask whether it has one reason to exist; never split it only for the number
# A ratchet: "path" or "path:function" -> (its limit, the reason). An entry that is no longer needed fails.
EXCEPTIONS: dict[str, tuple[int, str]] = {}

BLOCKS = (ast.If, ast.For, ast.While, ast.With, ast.Try, ast.Match)
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def functions(module: ast.Module) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    """Every function and method, nested ones too."""
    return [node for node in ast.walk(module) if isinstance(node, FUNCTIONS)]


def length(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function without its docstring: documentation must not count."""
    lines = (function.end_lineno or function.lineno) - function.lineno + 1
    first = function.body[0]
    if ast.get_docstring(function) is not None:
        lines -= (first.end_lineno or first.lineno) - first.lineno + 1
    return lines


def nesting(node: ast.AST) -> int:
    """The deepest nesting of blocks; ``elif`` does not count as its own block."""
    deepest = 0
    for child in ast.iter_child_nodes(node):
        if isinstance(child, (*FUNCTIONS, ast.ClassDef)):
            continue
        chained = isinstance(node, ast.If) and isinstance(child, ast.If) and node.orelse == [child]
        deepest = max(deepest, nesting(child) + (isinstance(child, BLOCKS) and not chained))
    return deepest


def measured(measure: Callable[[Any], int]) -> dict[str, int]:
    """A measure of every function, by file and name; the largest if a file has a name twice."""
    sizes: dict[str, int] = {}
    for path in sources():
        for function in functions(tree(path)):
            name = f"{name_of(path)}:{function.name}"
            sizes[name] = max(sizes.get(name, 0), measure(function))
    return sizes


def check(sizes: dict[str, int], budget: int, unit: str) -> None:
    """Fail for everything above its limit, and for exceptions that are larger than necessary."""
    too_big = [
        f"{name}: {size} {unit}, at most {budget}"
        for name, size in sizes.items()
        if size > EXCEPTIONS.get(name, (budget, ""))[0]
    ]
    assert not too_big, "\n".join(too_big)
    slack = [name for name, (size, _) in EXCEPTIONS.items() if name in sizes and sizes[name] < size]
    assert not slack, f"tighten or drop these exceptions: {slack}"


def test_files():
    sizes = {name_of(p): len(p.read_text().splitlines()) for p in sources()}
    for name in sorted(sizes, key=sizes.__getitem__, reverse=True)[:10]:
        print(f"{sizes[name]:>5} {name}{'  (smells)' if sizes[name] > SMELL else ''}")
    check(sizes, FILE, "lines")


def test_functions():
    check(measured(length), FUNCTION, "lines")


def test_nesting():
    check(measured(nesting), NESTING, "blocks")


def test_lines():
    too_long = [
        f"{name_of(p)}:{number} has {len(line)} characters"
        for p in sources()
        for number, line in enumerate(p.read_text().splitlines(), start=1)
        if len(line) > LINE
    ]
    assert not too_long, "\n".join(too_long)


def test_the_measure_counts_as_documented():
    code = 'def f():\n "Two\\\n lines."\n if a:\n  for b in c:\n   pass\n elif d:\n  pass\n'
    function = functions(ast.parse(code))[0]
    assert length(function) == 6
    assert nesting(function) == 2
