"""The same words everywhere, and no ambiguous ones."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

import pytest
from source_tree import ROOT, files, name_of, sources, tree

from tightrope.cli.flags import PEER_NAMES

# `done` hides whether an episode terminated or was truncated: the most expensive confusion in this field.
NEVER = {"done", "dones", "is_done", "all_done"}
# peers' words that also have an everyday meaning and may name something else
EVERYDAY = {"epochs", "horizon", "epsilon", "discount", "cuda", "lambda", "normalize", "gae"}
EVERYDAY |= {"batch_size", "whiten_rewards"}  # language: responses an iteration; rewards over their deviation
UNFINISHED = re.compile("|".join(["TO" + "DO", "FIX" + "ME", "XX" + "X", r"\bHA" + r"CK\b"]))


def identifiers(module: ast.Module) -> Iterator[tuple[int, str]]:
    """Every name that the code assigns: variables, attributes, arguments, functions, keywords."""
    for node in ast.walk(module):
        line = getattr(node, "lineno", 0)
        if isinstance(node, ast.Name):
            yield line, node.id
        elif isinstance(node, ast.Attribute):
            yield line, node.attr
        elif isinstance(node, ast.arg):
            yield line, node.arg
        elif isinstance(node, ast.keyword) and node.arg:
            yield node.value.lineno, node.arg
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield line, node.name
        elif isinstance(node, ast.alias) and node.asname:
            yield line, node.asname


def test_done_is_no_identifier():
    paths = files(".py")
    found = [f"{name_of(p)}:{n} {word}" for p in paths for n, word in identifiers(tree(p)) if word in NEVER]
    assert not found, "say terminated, truncated or ended:\n" + "\n".join(found)


def test_no_setting_has_a_second_name():
    """The names of stable-baselines3, CleanRL and TRL for our settings are not identifiers in the package."""
    banned = set(PEER_NAMES) - EVERYDAY
    assert {"n_steps", "clip_range", "ent_coef", "vf_coef", "cliprange", "kl_coef"} <= banned
    found = [
        f"{name_of(p)}:{n} {word}, here: {PEER_NAMES[word]}"
        for p in sources()
        for n, word in identifiers(tree(p))
        if word in banned
    ]
    assert not found, "\n".join(found)


def test_every_peer_name_leads_to_a_setting():
    """The table of the peers' names points to existing settings."""
    from tightrope.cli.flags import settings_fields
    from tightrope.control.settings import ALGORITHM_SETTINGS, TrainSettings

    kinds = (TrainSettings, *ALGORITHM_SETTINGS.values())
    known = {name for kind in kinds for name in settings_fields(kind)}
    wrong = {peer: ours for peer, ours in PEER_NAMES.items() if ours.split()[0] not in known}
    assert not wrong


def test_no_drawer_for_everything():
    names = {"utils.py", "util.py", "helpers.py", "misc.py", "common.py"}
    assert not [name_of(p) for p in files(".py") if p.name in names]


@pytest.mark.parametrize("folder", ["src", "tests", "examples", "benchmarks", "docs"])
def test_nothing_is_left_unfinished(folder: str):
    found = []
    for path in files(".py", ".md", under=ROOT / folder):
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            if UNFINISHED.search(line):
                found.append(f"{name_of(path)}:{number} {line.strip()}")
    assert not found, "\n".join(found)
