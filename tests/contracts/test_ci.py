"""A change must pass the commands of the README, on packages that are pinned where it matters."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tomllib

import pytest
from source_tree import ROOT, blocks

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CORE = {"torch", "numpy", "scipy", "threadpoolctl", "gymnasium", "numba", "safetensors", "rich"}
EXTRAS = {"box2d", "mujoco", "atari", "envpool", "video", "tensorboard", "language", "dev", "all"}
TEST_COMMAND = "make test"


def package(requirement: str) -> str:
    """The name in ``numpy>=1.26``."""
    return re.split(r"[\[<>=!~; ]", requirement, maxsplit=1)[0]


def test_ci_runs_the_readme_test_command_and_nothing_else():
    lines = (ROOT / ".ci/run").read_text().splitlines()
    scaffolding = ("#", "set -", "cd ")
    commands = [line.strip() for line in lines if line.strip() and not line.startswith(scaffolding)]
    assert commands == [TEST_COMMAND]
    assert os.access(ROOT / ".ci/run", os.X_OK), ".ci/run is not executable"


def test_the_readme_begins_with_two_commands():
    first = next(block for block in blocks(ROOT / "README.md") if block.language in ("sh", "bash"))
    commands = [line.partition("#")[0].strip() for line in first.text.splitlines()]
    assert [c for c in commands if c.startswith("make")] == ["make demo", TEST_COMMAND]
    assert first.line < 45, "the two commands are not on the first screen"


def test_core_dependencies_stay_few():
    assert {package(line) for line in PROJECT["dependencies"]} == CORE


def test_extras_are_those_that_are_promised():
    extras = PROJECT["optional-dependencies"]
    assert set(extras) == EXTRAS
    own = {package(line) for name in EXTRAS - {"language", "dev", "all"} for line in extras[name]}
    assert not own & {package(line) for line in extras["language"]}, (
        "control users pay for nothing of language"
    )
    everything = next(line for line in extras["all"] if line.startswith("tightrope["))
    assert set(re.findall(r"\w+", everything)[1:]) == EXTRAS - {"dev", "all"}


def test_the_readme_lists_the_extras():
    readme = (ROOT / "README.md").read_text()
    listed = set(re.findall(r"^\| `\[(\w+)\]` \|", readme, re.MULTILINE))
    assert listed == EXTRAS


def test_the_test_target_runs_every_test():
    makefile = (ROOT / "Makefile").read_text()
    recipe = re.search(r"^test:.*\n\t(.*)$", makefile, re.MULTILINE)
    assert recipe is not None
    words = recipe.group(1).split()
    assert words[1:3] == ["-m", "pytest"]
    deselecting = ("-k", "-m", "--ignore", "--deselect", "tests/")
    assert not [word for word in words[3:] if word.startswith(deselecting)]


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
@pytest.mark.parametrize(
    "target",
    [
        "demo",
        "demo-language",
        "test",
        "test-newest",
        "test-oldest",
        "learn",
        "check",
        "bench",
        "dist",
        "lock",
        "clean",
    ],
)
def test_every_target_is_understood(target: str):
    """A dry run: make can follow every target's recipe to its end."""
    result = subprocess.run(["make", "--dry-run", target], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_warnings_are_errors():
    options = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pytest"]["ini_options"]
    assert options["filterwarnings"][0] == "error"
