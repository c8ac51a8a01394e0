"""A user's installation: the source distribution builds, and its wheel works in an empty environment.

The environment contains only the wheel and its declared dependencies, direct and indirect, linked from the
test environment. So an undeclared dependency is missing there, and no test waits for a download.
"""

from __future__ import annotations

import ast
import email
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from language.tiny import saved, tiny_llama
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ("src", "setup.py", "pyproject.toml", "README.md", "LICENSE", "MANIFEST.in")


def run(command: list[str | Path], where: Path) -> str:
    """The output of a command, run without this environment's settings. It must exit with 0."""
    clean = {"PATH": "/usr/bin:/bin", "HOME": str(where), "PYTHONDONTWRITEBYTECODE": "1"}
    clean["PIP_CONFIG_FILE"] = os.devnull  # a constraint of the machine must not interfere
    ended = subprocess.run(command, cwd=where, env=clean, capture_output=True, text=True, timeout=600)
    assert ended.returncode == 0, f"{command}\n{ended.stdout}\n{ended.stderr}"
    return ended.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the source distribution and the wheel that was built from it."""
    folder = tmp_path_factory.mktemp("project")
    for name in SOURCES:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, folder / name)
    shutil.rmtree(folder / "src" / "tightrope.egg-info", ignore_errors=True)
    run([sys.executable, "-m", "build", "--no-isolation", "--outdir", folder / "dist", folder], folder)
    return folder / "dist"


def needed(requirements: list[str], extras: set[str]) -> dict[str, metadata.Distribution]:
    """The installed distributions behind these requirements, direct and indirect."""
    found: dict[str, metadata.Distribution] = {}
    seen: set[tuple[str, frozenset[str]]] = set()
    waiting = [(line, frozenset(extras)) for line in requirements]
    while waiting:
        line, wanted = waiting.pop()
        requirement = Requirement(line)
        marker = requirement.marker
        if marker is not None and not any(marker.evaluate({"extra": extra}) for extra in wanted | {""}):
            continue
        name, more = canonicalize_name(requirement.name), frozenset(requirement.extras)
        if (name, more) not in seen:
            seen.add((name, more))
            found[name] = metadata.distribution(name)
            waiting += [(line, more) for line in found[name].requires or []]
    return found


@pytest.fixture(scope="module")
def environment(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh virtual environment into which pip has installed the wheel with its language extra."""
    folder, wheel = tmp_path_factory.mktemp("empty"), next(built.glob("*.whl"))
    run([sys.executable, "-m", "venv", "--without-pip", folder / "env"], folder)
    python = folder / "env" / "bin" / "python"
    site = Path(run([python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"], folder).strip())
    for distribution in needed(about(wheel).get_all("Requires-Dist"), {"language"}).values():
        for top in {file.parts[0] for file in distribution.files or [] if file.parts[0] != ".."}:
            link, target = site / top, Path(str(distribution.locate_file(top)))
            if not link.exists() and target.exists():
                link.symlink_to(target)
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-index"]
    run([*pip, f"tightrope[language] @ {wheel.as_uri()}"], folder)
    return folder


def about(wheel: Path) -> email.message.Message:
    """The metadata of a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        name = next(n for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
        return email.message_from_bytes(archive.read(name))


def test_wheel_and_source_hold_the_package_whole(built: Path):
    sources = {str(p.relative_to(ROOT / "src")) for p in (ROOT / "src" / "tightrope").rglob("*.py")}
    with zipfile.ZipFile(next(built.glob("*.whl"))) as wheel:
        names = set(wheel.namelist())
    assert {n for n in names if ".dist-info/" not in n} == sources | {"tightrope/py.typed"}
    assert any(n.endswith(".dist-info/licenses/LICENSE") for n in names)
    with tarfile.open(next(built.glob("*.tar.gz"))) as archive:
        packed = {name.partition("/")[2] for name in archive.getnames()}
    assert {f"src/{name}" for name in sources} | {*SOURCES[1:]} <= packed
    assert not [
        name for name in packed if name.startswith("tests/")
    ]  # a partial set would be worse than none


def test_the_index_page_shows_no_link_that_only_works_in_the_repository(built: Path):
    told = about(next(built.glob("*.whl")))
    page = str(told.get_payload())
    targets = re.findall(r"\]\(([^)\s]+)\)", page)
    assert "# tightrope" in page
    assert len(targets) > 10
    assert not [target for target in targets if not target.startswith(("https://", "#"))]
    urls = dict(line.split(", ", 1) for line in told.get_all("Project-URL"))
    assert set(urls) == {"Homepage", "Documentation", "Changelog", "Issues"}
    # every link into the repository points to an existing file or folder
    inside = re.findall(re.escape(urls["Homepage"]) + r"/(?:blob|raw)/main/([^)#\s]+)", page)
    assert len(inside) > 10
    assert f"({urls['Homepage']}/raw/main/docs/images/clip.svg)" in page
    assert not [path for path in inside if not (ROOT / path).exists()]


def test_the_wheel_trains_evaluates_and_aligns_from_an_empty_environment(environment: Path):
    python, tightrope = (environment / "env" / "bin" / name for name in ("python", "tightrope"))
    home = run([python, "-c", "import tightrope; print(tightrope.__file__)"], environment)
    assert home.startswith(str(environment))
    budget = ["--total-steps", "512", "--num-steps", "64", "--evaluate-every", "none", "--json"]
    trained = run([tightrope, "train", "CartPole-v1", "--run-dir", "pole", *budget], environment)
    assert 0 < json.loads(trained)["steps"] <= 512
    tested = run([tightrope, "evaluate", "pole", "--episodes", "2", "--json"], environment)
    assert json.loads(tested)["episodes"] == 2
    model = saved(environment / "model", tiny_llama())
    (environment / "prompts.jsonl").write_text('{"prompt": "ab"}\n{"prompt": "ba"}\n')
    small = ["--total-episodes", "8", "--batch-size", "8", "--minibatch-size", "8", "--max-new-tokens", "4"]
    more = ["--max-prompt-tokens", "8", "--reward", "length", "--run-dir", "words", "--json"]
    data = ["--model", model, "--data", "prompts.jsonl"]
    aligned = run([tightrope, "align", *data, *small, *more], environment)
    assert json.loads(aligned)["episodes"] == 8
    assert (environment / "words" / "model" / "model.safetensors").is_file()


# imported by this package, declared by another package that brings it
BROUGHT_BY = {
    "llvmlite": "numba",
    "huggingface-hub": "transformers",
    "mujoco": "gymnasium",
    "box2d": "gymnasium",
}
# used where the user has them: the error names the package (datasets, which brings pyarrow), the card of an
# adapter says "not tried" (peft)
OF_THE_USER = {"datasets", "pyarrow", "peft"}


def test_what_is_imported_is_declared_and_what_is_declared_is_imported():
    """Each third-party package is in pyproject.toml: in the core for core files, or in an extra."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    core = {canonicalize_name(Requirement(line).name) for line in project["dependencies"]}
    extras = project["optional-dependencies"]
    language = core | {canonicalize_name(Requirement(line).name) for line in extras["language"]}
    optional = ("box2d", "mujoco", "atari", "envpool", "video", "tensorboard")
    more = [Requirement(line) for name in optional for line in extras[name]]
    control = core | {canonicalize_name(line.name) for line in more if not line.extras}
    used: set[str] = set()
    for path in (ROOT / "src" / "tightrope").rglob("*.py"):
        part = path.relative_to(ROOT / "src" / "tightrope").parts[0]
        allowed = {"control": control, "language": language}.get(part, core)
        for module in third_parties(path):
            name = canonicalize_name(module)
            used.add(name)
            declared = name in OF_THE_USER or BROUGHT_BY.get(name, name) in allowed
            assert declared, f"{path}: {module} is declared nowhere that this file may count on"
    assert core <= used, f"declared and never imported: {core - used}"
    for name, parent in BROUGHT_BY.items():
        lines = [Requirement(line) for line in metadata.distribution(parent).requires or []]
        assert name in {canonicalize_name(line.name) for line in lines}


def third_parties(path: Path) -> set[str]:
    """The top-level names of third-party imports of a file, including lazy ones."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            found.add(str(node.module))
    return {name.partition(".")[0] for name in found} - {"tightrope"} - set(sys.stdlib_module_names)


def test_an_undeclared_dependency_would_be_missing(environment: Path):
    """The environment is really empty: packages that only the tests need are missing."""
    python = environment / "env" / "bin" / "python"
    probe = "import importlib.util as u; print([n for n in ('pytest', 'peft', 'mypy') if u.find_spec(n)])"
    assert run([python, "-c", probe], environment).strip() == "[]"
