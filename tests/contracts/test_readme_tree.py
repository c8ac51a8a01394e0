"""The README's map matches the disk: everything listed exists, every folder of the package is listed."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
from source_tree import ROOT, blocks, files, name_of, pages, sources, tree


def listed(text: str) -> dict[str, str]:
    """Path and description of every line of a map whose folders end in a slash and are indented by two."""
    found: dict[str, str] = {}
    folders: list[tuple[int, str]] = []
    for line in text.splitlines():
        match = re.fullmatch(r"( *)(\S+)(?:\s{2,}(\S.*))?", line)
        assert match is not None, f"not a line of a map: {line!r}"
        depth = len(match.group(1))
        folders = [(d, name) for d, name in folders if d < depth]
        path = "".join(name for _, name in folders) + match.group(2)
        if path.endswith("/"):
            folders.append((depth, match.group(2)))
        found[path.rstrip("/")] = match.group(3) or ""
    return found


MAP = listed(next(b for b in blocks(ROOT / "README.md") if "src/tightrope/\n" in b.text).text)


def test_everything_listed_is_there():
    assert not [path for path in MAP if not (ROOT / path).exists()]


def test_every_folder_is_listed():
    parts = {name_of(p.parent) for p in sources()}
    tops = {name_of(p).split("/")[0] for p in files() if "/" in name_of(p)} - {".ci", "src"}
    assert parts | tops <= set(MAP), (parts | tops) - set(MAP)


def test_the_map_fits_on_a_screen():
    assert len(MAP) <= 40


def test_every_line_explains():
    assert not [path for path, words in MAP.items() if path != "src/tightrope" and len(words) < 8]


def lines_to_read(text: str) -> int:
    """Lines of the files that a reading order links to; only of the functions that it names in brackets."""
    total = 0
    for target, names in re.findall(r"\]\((src/[^)]+)\)(?: \(([^)]+)\))?", text):
        wanted = re.findall(r"`(\w+)`", names)
        found = {n.name: n for n in ast.walk(tree(ROOT / target)) if isinstance(n, ast.FunctionDef)}
        parts = [found[name] for name in wanted]
        whole = len((ROOT / target).read_text(encoding="utf-8").splitlines())
        total += sum((n.end_lineno or 0) - n.lineno + 1 for n in parts) if parts else whole
    return total


def test_the_reading_order_of_a_story_is_about_1500_lines():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    control, _, language = text.split("**Reading order**")[1].split("The examples:")[0].partition("Language:")
    control = control.split("The compiled engine")[0]
    for story in (control, language):
        assert 1_200 <= lines_to_read(story) <= 1_900


@pytest.mark.parametrize("page", pages(), ids=name_of)
def test_links_lead_somewhere(page: Path):
    """The files and headings that a page links to exist."""
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if target.startswith(("http://", "https://")):
            continue
        name, _, heading = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        assert path.exists(), f"{target} is not there"
        if heading:
            titles = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
            anchors = {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}
            assert heading in anchors, f"{target}: {name_of(path)} has no such heading"
