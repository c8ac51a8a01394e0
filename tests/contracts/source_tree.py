"""The repository as data: its files, their syntax trees and imports, and the code blocks of its pages."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
SRC = ROOT / "src" / "tightrope"
# files that tools create, and files that .gitignore excludes
LEFT_OUT = {"__pycache__", "runs", "build", "dist", "node_modules"}
KEPT = {SRC / "runs", ROOT / "tests" / "runs"}


def files(*suffixes: str, under: Path = ROOT) -> list[Path]:
    """Files of the repository with one of these endings (none: all), sorted, without caches and runs."""

    def walk(folder: Path) -> Iterator[Path]:
        for path in sorted(folder.iterdir()):
            if path.is_dir():
                hidden = path.name.startswith(".") and path.name != ".ci"
                skipped = path.name in LEFT_OUT and path not in KEPT
                if not hidden and not skipped and not path.name.endswith(".egg-info"):
                    yield from walk(path)
            elif not suffixes or path.suffix in suffixes:
                yield path

    return list(walk(under))


def sources() -> list[Path]:
    """The Python files of the package."""
    return files(".py", under=SRC)


def name_of(path: Path) -> str:
    """A path as the README writes it: relative to the repository, with slashes."""
    return path.relative_to(ROOT).as_posix()


@cache
def tree(path: Path) -> ast.Module:
    """The syntax tree of a Python file."""
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def module_of(path: Path) -> str:
    """``tightrope.maths.returns`` for its file."""
    parts = path.relative_to(SRC.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(module: ast.Module, name: str, *, package: bool = False) -> Iterator[tuple[int, str]]:
    """Line and full name of every import of a module, at any depth; relative ones made absolute."""
    home = name.split(".") if package else name.split(".")[:-1]
    for node in ast.walk(module):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            base = home[: len(home) - node.level + 1] if node.level else []
            origin = ".".join([*base, *(node.module.split(".") if node.module else [])])
            for alias in node.names:
                yield node.lineno, f"{origin}.{alias.name}"


class Block(NamedTuple):
    """A fenced block of a page: its language, its text and the first line of its text."""

    language: str
    text: str
    line: int


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a Markdown page, in order. ValueError if a fence is not closed."""
    found: list[Block] = []
    language, start, lines = "", 0, None
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), start=1):
        fence = re.fullmatch(r"\s*```(\w*)\s*", line)
        if fence is None:
            if lines is not None:
                lines.append(line)
        elif lines is None:
            language, start, lines = fence.group(1), number + 1, []
        else:
            found.append(Block(language, "\n".join(lines) + "\n", start))
            lines = None
    if lines is not None:
        raise ValueError(f"{page}: the block that begins at line {start} is not closed.")
    return found


def pages() -> list[Path]:
    """README, CONTRIBUTING and everything in docs/."""
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *files(".md", under=ROOT / "docs")]
