"""Runs the docs: every command and snippet of the README and of docs/; and compares every quotation.

The check of a fenced block depends on its language:

    python   begins with `# src/...`  must match that file, line for line, at any indentation
             contains `>>>`           is run by doctest; the results must be those on the page
             else                     is run unchanged, after the earlier blocks of the page; path/to/model
                                      is a tiny model, and 4096 episodes become 64
    sh       tightrope ...            is run; TRAINING is added to train and RESUMING to resume, so that it
                                      takes seconds
             make TARGET              the Makefile must have the target (running it would run this test again)
             python FILE              the file must exist; test_examples.py runs examples/
             pip install, venv        the named extras must exist
             anything else            fails: write a rule for it, or remove it
    console  `$ command`              is run unchanged, must exit with 2 and print the lines below it
    diff     two files                - lines are in the first, + lines in the second, others in both
    text     nothing (test_readme_tree.py checks maps)

The blocks of a page share a folder that starts with only a copy of examples/.
"""

from __future__ import annotations

import contextlib
import doctest
import importlib.util
import io
import re
import shlex
import shutil
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import pytest
from source_tree import ROOT, Block, blocks, files, name_of, pages

from tightrope.cli.main import main

TRAINING = ["--total-steps", "2048", "--evaluate-every", "0.5", "--evaluation-episodes", "2"]
RESUMING = ["--total-steps", "3072"]
LANGUAGES = {"python", "sh", "console", "diff", "text", "json"}
# a progress bar of tqdm, a log line of transformers, a Python warning
LIBRARIES = re.compile(r"it/s\]|s/it\]|\[transformers\]|^\S+:\d+: \w*Warning: ", re.MULTILINE)
QUOTED = re.compile(r"# (src/\S+\.py)\n")


def lines_of(block: Block) -> list[str]:
    """The commands of a shell block, without comments and empty lines."""
    lines = [line.partition(" #")[0].strip() for line in block.text.replace("\\\n", " ").splitlines()]
    return [line for line in lines if line and not line.startswith("#")]


def run(words: list[str]) -> tuple[int, str]:
    """Exit code and output of a tightrope command; tasks that it registers are removed afterwards."""
    printed, known = io.StringIO(), set(gymnasium.registry)
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            code = main(words)
        except SystemExit as end:  # --help
            code = int(end.code or 0)
    for name in set(gymnasium.registry) - known:
        del gymnasium.registry[name]
    return code, printed.getvalue()


def run_command(line: str) -> None:
    """One line of a shell block, by the rules above."""
    words = shlex.split(line)
    if words[0] == "tightrope":
        train_for_real = words[1] == "train" and not {"--help", "--dry-run"} & set(words)
        more = TRAINING if train_for_real else RESUMING if words[1] == "resume" else []
        code, printed = run(replaced(words[1:], more))
        assert code == 0, f"{line}\n{printed}"
        assert printed.strip(), f"{line} printed nothing"
        assert not LIBRARIES.search(printed), f"{line}: a library printed into it\n{printed}"
    elif words[0] == "make":
        targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert set(words[1:]) <= set(targets), line
    elif words[0] == "python" and words[1].endswith(".py"):
        assert (ROOT / words[1]).is_file(), f"{line}: there is no such file"
    elif words[0] in ("pip", "python", "python3", ".", "source", "git", "cd"):
        extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
        named = re.search(r"\[(.*?)\]", line)
        assert named is None or set(named.group(1).split(",")) <= set(extras), line
    else:
        raise AssertionError(f"no rule for this command: {line}")


def replaced(words: list[str], more: list[str]) -> list[str]:
    """A command with flags and values added; they replace its own."""
    own = {i for i, word in enumerate(words) if word in more[::2]}
    return [word for i, word in enumerate(words) if not {i, i - 1} & own] + more


def run_console(text: str) -> None:
    """Commands that fail as shown."""
    for part in text.split("$ ")[1:]:
        command, *expected = part.strip().splitlines()
        code, printed = run(shlex.split(command)[1:])
        assert code == 2, f"{command} gave {code}\n{printed}"
        for line in expected:
            assert line in printed, f"{command} printed\n{printed}and not\n{line}"


def run_python(block: Block, page: Path, names: dict[str, Any]) -> None:
    """A snippet, or a doctest, in the names of its page."""
    if ">>> " in block.text:
        test = doctest.DocTestParser().get_doctest(block.text, names, page.name, str(page), block.line)
        printed = io.StringIO()
        result = doctest.DocTestRunner().run(test, out=printed.write, clear_globs=False)
        names.update(test.globs)
        assert result.failed == 0, printed.getvalue()
        return
    padding = "\n" * (block.line - 1)  # so that a traceback names the line of the page
    text = block.text
    if "path/to/model" in text:
        from language.tiny import saved, tiny_llama

        saved(Path("path/to/model"), tiny_llama())
        text = text.replace("total_episodes=4096", "total_episodes=64")  # only the length differs
    exec(compile(padding + text, str(page), "exec"), names)


def stands_in(quoted: str, text: str) -> bool:
    """Whether lines are adjacent in a text, at any indentation; a line with only `...` skips lines."""
    whole = text.splitlines()
    for chunk in re.split(r"^\s*\.\.\.\s*\n", quoted, flags=re.MULTILINE):
        lines = dedented(chunk.splitlines())
        places = range(len(whole) - len(lines) + 1)
        if not any(dedented(whole[i : i + len(lines)]) == lines for i in places):
            return False
    return True


def dedented(lines: list[str]) -> list[str]:
    """Lines without their common indentation."""
    depth = min((len(line) - len(line.lstrip()) for line in lines if line.strip()), default=0)
    return [line[depth:].rstrip() for line in lines]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with only the examples, to run a page in; modules that the page imports are removed."""
    shutil.copytree(ROOT / "examples", tmp_path / "examples", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    before, search = set(sys.modules), list(sys.path)
    yield tmp_path
    sys.path[:] = search
    for name in set(sys.modules) - before:
        if not (getattr(sys.modules[name], "__file__", None) or "").startswith(str(tmp_path)):
            continue
        del sys.modules[name]


@pytest.mark.parametrize("page", pages(), ids=name_of)
def test_commands_and_snippets_run(page: Path, folder: Path):
    names: dict[str, Any] = {"__name__": "page"}
    for block in blocks(page):
        assert block.language in LANGUAGES, f"{page.name}:{block.line} has the language {block.language!r}"
        if block.language == "sh":
            for line in lines_of(block):
                run_command(line)
        elif block.language == "console":
            run_console(block.text)
        elif block.language == "python" and not QUOTED.match(block.text):
            run_python(block, page, names)


@pytest.mark.parametrize("page", pages(), ids=name_of)
def test_quotations_are_true(page: Path):
    for block in blocks(page):
        quotation = QUOTED.match(block.text)
        if quotation:
            text = (ROOT / quotation.group(1)).read_text(encoding="utf-8")
            quoted = block.text[quotation.end() :]
            assert stands_in(quoted, text), f"{page.name}:{block.line} is not in {quotation.group(1)}"


def test_quotations_are_compared_line_by_line():
    assert stands_in("a = 1\nif b:\n    c\n", "def f():\n    a = 1\n    if b:\n        c\n")
    assert not stands_in("a = 1\nif b:\n    c\n", "def f():\n    a = 1\n    if b:\n        d\n")
    assert not stands_in("a = 1\nc\n", "a = 1\nb\nc\n")
    assert stands_in("a = 1\n...\nc\n", "a = 1\nb\nc\n")


@pytest.mark.parametrize("page", pages(), ids=name_of)
def test_diffs_are_true(page: Path):
    """Every line of a diff is in its file; a changed line is not in the other one."""
    for block in (b for b in blocks(page) if b.language == "diff"):
        first, second, *lines = block.text.splitlines()
        texts = [(ROOT / line[4:]).read_text(encoding="utf-8") for line in (first, second)]
        old, new = ({line.strip() for line in text.splitlines()} for text in texts)
        for line in lines:
            stripped = line[1:].strip()
            assert (stripped in old) == (line[0] in "- "), f"{page.name}: {line}"
            assert (stripped in new) == (line[0] in "+ "), f"{page.name}: {line}"


def load(path: Path) -> Any:
    """A script of docs/ as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_generated_tables_are_up_to_date():
    tables = load(ROOT / "docs/tables.py")
    for page, of_page in tables.PAGES.items():
        text = page.read_text(encoding="utf-8")
        assert tables.filled(text, of_page) == text, "run: python docs/tables.py"


def test_the_picture_is_what_the_mathematics_gives():
    picture = load(ROOT / "docs/images/clip.py")
    assert (ROOT / "docs/images/clip.svg").read_text() == picture.draw(), "run: python docs/images/clip.py"


def test_every_picture_is_shown_somewhere():
    text = "".join(page.read_text(encoding="utf-8") for page in pages())
    pictures = files(".svg", ".png", ".gif", under=ROOT / "docs/images")
    assert pictures and not [p.name for p in pictures if f"images/{p.name}" not in text]
