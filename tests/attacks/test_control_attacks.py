"""Hostile run folders: none of their code runs, nothing is written elsewhere, and errors name the problem."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from attacks import control_corpus, corpus
from attacks.language_corpus import TEMPLATE
from attacks.watch import MARK

TYPED = ("ValueError", "CheckpointError")
ATTACKS = {attack.name: attack for attack in control_corpus.attacks()}


def played(module: str, place: Path, *words: str) -> dict:
    """The outcomes of a corpus or of lives, in a separate process: an audit hook cannot be removed."""
    (place / "cwd").mkdir(exist_ok=True)
    canary = str(place / "canary")
    source = corpus.MODULE.replace(repr(corpus.CANARY), repr(canary))
    (place / "cwd" / f"{MARK}.py").write_text(source)  # on the path: an import by name would succeed
    tests = Path(__file__).parents[1]
    path = os.pathsep.join(map(str, (tests, tests.parent / "src")))
    more = {"PYTHONPATH": path, "TIGHTROPE_CANARY": canary, "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
    ran = subprocess.run(
        [sys.executable, "-m", module, str(place), *words],
        cwd=place / "cwd", env={**os.environ, **more}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr[-3000:]
    return json.loads((place / "results.json").read_text())


def check_safe(result: dict, *, megabytes: float = 200) -> None:
    """No code ran, nothing was written elsewhere, and the end was a success or one clean error.

    ``megabytes``: those of attacks are small files, of which one declares 10 GB.
    """
    assert not result["canary"] and not result["events"], result["events"]
    assert result.get("victim", "untouched") == "untouched"
    assert set(result.get("beside", [])) <= {"run", "victim", "elsewhere"}
    assert result["code"] in (0, 1, 2) or result["kind"] in TYPED, result["trace"]
    assert result["kind"] or "Traceback" not in result["text"], result["text"]
    assert "\x1b" not in result["text"] and "\x9b" not in result["text"]  # nothing rules the terminal
    assert result["megabytes"] < megabytes


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict:
    return played("attacks.control_corpus", tmp_path_factory.mktemp("attacks"))["attacks"]


def test_without_an_attack_everything_works(results: dict):
    for result in results["none"].values():
        check_safe(result)
        assert result["code"] == 0, result["text"]


@pytest.mark.parametrize("name", ATTACKS)
def test_an_attack_is_harmless_or_refused(results: dict, name: str):
    for result in results[name].values():
        check_safe(result)
    if ATTACKS[name].words is None:
        assert all(result["code"] == 0 for result in results[name].values()), results[name]
    else:
        assert ATTACKS[name].words in results[name]["resume"]["text"]


def test_a_module_named_by_a_file_is_asked_for_with_the_command_to_type(results: dict):
    for command in ("evaluate", "resume"):
        text = results["id with a module"][command]["text"]
        assert f"tightrope {command} " in text and f"/case/run --env {MARK}:Env-v0" in text
        text = results["own environment"][command]["text"]
        assert "name it again in Python:" in text and "--env CartPole-v1" not in text
    text = results["id with a module"]["settings"]["text"]
    assert re.search(rf"tightrope train --settings \S+ {MARK}:Env-v0", text), text


ALARMS = {
    "unpickling": ("import pickle; pickle.loads(corpus.pickled())", "find_class"),
    "torch.load": (
        "import io, torch; torch.load(io.BytesIO(corpus.torch_zip()), weights_only=False)",
        "find_class",
    ),
    "import": (f"import importlib; importlib.import_module({MARK!r})", f"{MARK}.py"),
    "exec": ("exec(corpus.CODE)", "compile"),
    "trust": (
        "from transformers import AutoConfig; AutoConfig.from_pretrained('model', trust_remote_code=True)",
        f"{MARK}.py",
    ),
    "numpy": (
        "import io, numpy; numpy.load(io.BytesIO(corpus.pickled()), allow_pickle=True)",
        "find_class",
    ),
}
HEARD_ALONE = {  # they make no canary
    "program": ("import subprocess; subprocess.run(['true'])", "Popen"),
    "template": (f"import jinja2; jinja2.Template({TEMPLATE!r}).render()", "os.system"),
    "text": ("pass", "probe by <string>"),
}  # fmt: skip

PROBE = """
import json, os, sys
from pathlib import Path
from attacks import corpus
from attacks.watch import Watch, outcome
watch, found = Watch(Path("elsewhere"), strict=True), {}
import torch
for name, code in json.loads(sys.argv[1]).items():
    Path(corpus.CANARY).unlink(missing_ok=True)
    body = compile(code, "probe", "exec")
    found[name] = outcome(watch, lambda: exec(body, {"corpus": corpus}))
with watch.forbid_pickle():
    import pickle
    found["plain"] = outcome(watch, lambda: pickle.loads(pickle.dumps(1)))
print(json.dumps(found))
"""


def test_payloads_fire_in_careless_code_and_the_watch_detects_them(tmp_path: Path):
    """The corpus can fail."""
    tests = Path(__file__).parents[1]
    path = os.pathsep.join(map(str, (tests, tests.parent / "src")))
    more = {"TIGHTROPE_CANARY": str(tmp_path / "canary"), "PYTHONPATH": path, "HF_HOME": str(tmp_path / "hf")}
    more["HF_HUB_OFFLINE"] = "1"
    source = corpus.MODULE.replace(repr(corpus.CANARY), repr(more["TIGHTROPE_CANARY"]))
    (tmp_path / "model").mkdir()
    for folder in (tmp_path, tmp_path / "model"):
        (folder / f"{MARK}.py").write_text(source)
    mapped = {"model_type": MARK, "auto_map": {"AutoConfig": f"{MARK}.Model"}}
    (tmp_path / "model" / "config.json").write_text(json.dumps(mapped))
    codes = json.dumps({name: code for name, (code, _) in {**ALARMS, **HEARD_ALONE}.items()})
    ran = subprocess.run(
        [sys.executable, "-c", PROBE, codes],
        cwd=tmp_path, env={**os.environ, **more}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    found = json.loads(ran.stdout)
    for name, (_, word) in {**ALARMS, **HEARD_ALONE}.items():
        assert any(word in event for event in found[name]["events"]), (name, found[name])
    assert [name for name in ALARMS if not found[name]["canary"]] == []
    assert found["plain"]["events"] == ["pickle.loads was called"]
