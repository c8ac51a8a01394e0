"""How much code the package has, and how deep its imports go.

    python benchmarks/code_lines.py                                            # a table
    python benchmarks/code_lines.py --json
    python benchmarks/code_lines.py --save benchmarks/results/code_lines.json

A code line is not blank and not only a comment or docstring. Other strings count with all their lines.
Folders include their subfolders.

An import chain is a list of files, each of which imports the next one. ``anywhere`` includes lazy imports and
those for type checkers; ``at the top`` only the imports that run when a file is imported. ``from package
import name`` leads to the file of ``name`` if there is one, else to the package's ``__init__.py``. An import
cycle appears in the chain as one group of its files, sorted, and is named.
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "tightrope"
NO_CODE = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENCODING,
    tokenize.ENDMARKER,
}  # fmt: skip
CHAINS = ("control", "language", "")  # inside these folders; "": the whole package

# ------------------------------------------------------------------------------------- lines


def docstrings(tree: ast.Module) -> Iterator[ast.Constant]:
    """The docstring of the module and of every class and function that has one."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and node.body:
            first = node.body[0]
            text = first.value if isinstance(first, ast.Expr) else None
            if isinstance(text, ast.Constant) and isinstance(text.value, str):
                yield text


def code_lines(source: str) -> int:
    """The number of source lines that are not blank and not only a comment or docstring."""
    texts = [(d.lineno, d.end_lineno or d.lineno) for d in docstrings(ast.parse(source))]
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        begin, end = token.start[0], token.end[0]
        inside = token.type == tokenize.STRING and any(a <= begin and end <= b for a, b in texts)
        if token.type not in NO_CODE and not inside:
            lines.update(range(begin, end + 1))
    return len(lines)


def files(package: Path = PACKAGE) -> list[Path]:
    """The Python files of the package, sorted."""
    return sorted(path for path in package.rglob("*.py") if "__pycache__" not in path.parts)


# ------------------------------------------------------------------------------------- imports


def at_the_top(node: ast.AST) -> Iterator[ast.AST]:
    """The statements that run on import: everything except functions and code for type checkers."""
    yield node
    for child in ast.iter_child_nodes(node):
        typing = isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test)
        if not typing and not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield from at_the_top(child)


def imported(path: Path, package: Path, *, top: bool = False) -> set[Path]:
    """The files of the package that a file imports; with ``top``, only by imports that run at once."""
    found = set()
    home = [package.name, *path.relative_to(package).parts[:-1]]
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in at_the_top(tree) if top else ast.walk(tree):
        names: list[list[str]] = []
        if isinstance(node, ast.Import):
            names = [alias.name.split(".") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = home[: len(home) - node.level + 1] if node.level else []
            base = [*base, *(node.module.split(".") if node.module else [])]
            names = [[*base, alias.name] for alias in node.names]
        for name in names:
            target = file_of(name, package)
            if target is not None and target != path:
                found.add(target)
    return found


def file_of(name: list[str], package: Path) -> Path | None:
    """The file of a dotted name, or of the module that contains the name; None outside the package."""
    while name and name[0] == package.name:
        place = package.joinpath(*name[1:])
        if (place / "__init__.py").is_file():
            return place / "__init__.py"
        if name[1:] and place.with_suffix(".py").is_file():
            return place.with_suffix(".py")
        name = name[:-1]
    return None


def circles(graph: dict[Path, set[Path]]) -> dict[Path, frozenset[Path]]:
    """File -> the files that it reaches and that reach it, including itself."""

    @cache
    def reached(start: Path) -> frozenset[Path]:
        seen, ahead = {start}, [start]
        while ahead:
            fresh = graph[ahead.pop()] - seen
            seen |= fresh
            ahead += fresh
        return frozenset(seen)

    return {a: frozenset(b for b in reached(a) if a in reached(b)) for a in graph}


def longest_chain(graph: dict[Path, set[Path]]) -> list[Path]:
    """The longest chain of imports, a cycle as one group of files; of equal ones, the first by name."""
    circle = circles(graph)

    @cache
    def chain(members: frozenset[Path]) -> tuple[Path, ...]:
        ahead = {circle[b] for a in members for b in graph[a]} - {members}
        tails = sorted((chain(group) for group in ahead), key=lambda tail: (-len(tail), tail))
        return (*sorted(members), *(tails[0] if tails else ()))

    return list(min((chain(c) for c in circle.values()), key=lambda tail: (-len(tail), tail), default=()))


# ------------------------------------------------------------------------------------- the report


def measured(package: Path = PACKAGE) -> dict[str, Any]:
    """All figures of a package."""
    paths = files(package)
    code = {path: code_lines(path.read_text(encoding="utf-8")) for path in paths}
    total = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in paths}
    folders = sorted({folder for path in paths for folder in path.relative_to(package).parents})
    table = {}
    for folder in folders:
        inside = [path for path in paths if path.is_relative_to(package / folder)]
        own = [path for path in inside if path.name != "__init__.py"]
        lines = {"code": sum(code[path] for path in inside), "lines": sum(total[path] for path in inside)}
        table[folder.as_posix()] = lines | {"files": len(own)}
    longest = sorted(paths, key=lambda path: (-total[path], path))[:10]
    tops = {short(p, package): {"lines": total[p], "code": code[p]} for p in longest}
    return {
        "code": sum(code.values()), "files": sum(p.name != "__init__.py" for p in paths), "folders": table,
        "chains": chains(paths, package), "longest_files": tops,
    }  # fmt: skip


def chains(paths: list[Path], package: Path) -> dict[str, Any]:
    """Folder -> its longest import chains, anywhere and at the top, and the circles."""
    found: dict[str, Any] = {}
    for folder in CHAINS:
        found[folder or "."] = {}
        for name, top in (("anywhere", False), ("at the top", True)):
            inside = [path for path in paths if within(path, package / folder)]
            graph = {path: imported(path, package, top=top) & {*inside} for path in inside}
            chain = [short(path, package) for path in longest_chain(graph)]
            rings = {tuple(short(p, package) for p in sorted(c)) for c in circles(graph).values()}
            rings = {ring for ring in rings if len(ring) > 1}
            found[folder or "."][name] = {"files": len(chain), "chain": chain, "circles": sorted(rings)}
    return found


def within(path: Path, folder: Path) -> bool:
    """Whether a file is in a folder or below it."""
    return path.is_relative_to(folder)


def short(path: Path, package: Path) -> str:
    """A path inside the package, with slashes."""
    return path.relative_to(package).as_posix()


def text(found: dict[str, Any]) -> str:
    """The figures as readable text."""
    lines = [f"{found['code']:,} code lines in {found['files']} files (without __init__.py)", ""]
    lines += [f"{'folder':20} {'code':>7} {'lines':>7} {'files':>6}"]
    for name, row in found["folders"].items():
        lines.append(f"{name:20} {row['code']:7,} {row['lines']:7,} {row['files']:6}")
    for folder, kinds in found["chains"].items():
        for kind, row in kinds.items():
            lines += ["", f"longest import chain in {folder}, {kind}: {row['files']} files"]
            lines += ["  " + " > ".join(row["chain"])]
            lines += [f"  a circle: {', '.join(ring)}" for ring in row["circles"]]
    lines += ["", "the ten longest files: lines, code"]
    lines += [f"{row['lines']:5} {row['code']:5}  {name}" for name, row in found["longest_files"].items()]
    return "\n".join(lines)


def commit() -> str:
    """The newest commit that changed the package; a trailing + marks uncommitted changes."""
    git = ["git", "-C", str(ROOT)]
    told = {"capture_output": True, "text": True, "check": True}
    try:
        name = subprocess.run([*git, "log", "-1", "--format=%H", "--", "src"], **told).stdout.strip()
        changed = subprocess.run([*git, "status", "--porcelain", "src"], **told).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return name + ("+" if changed else "")


def main(words: list[str] | None = None) -> int:
    """Count, and print or save."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--save", type=Path, metavar="FILE", help="JSON to write")
    given = parser.parse_args(words)
    command = " ".join(["python", "benchmarks/code_lines.py", *(sys.argv[1:] if words is None else words)])
    found = {"command": command, "commit": commit(), **measured()}
    print(json.dumps(found, indent=1) if given.json else text(found))
    if given.save:
        given.save.write_text(json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
