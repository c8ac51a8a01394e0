"""The examples run as a user runs them, and their assertions hold."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from source_tree import ROOT, files, name_of

EXAMPLES = files(".py", under=ROOT / "examples")


@pytest.mark.parametrize("path", EXAMPLES, ids=name_of)
def test_example(path: Path, tmp_path: Path):
    """Runs without a warning, in another folder, and leaves no files."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    command = [sys.executable, "-W", "error::UserWarning", str(path)]
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    assert result.stdout.strip(), "an example shows something"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("path", EXAMPLES, ids=name_of)
def test_examples_are_short(path: Path):
    assert len(path.read_text().splitlines()) <= 60
    assert "assert " in path.read_text(), "an example checks itself"


def test_there_are_a_few():
    assert 3 <= len(EXAMPLES) <= 6
    readme = (ROOT / "README.md").read_text()
    assert not [p.name for p in EXAMPLES if name_of(p) not in readme]
