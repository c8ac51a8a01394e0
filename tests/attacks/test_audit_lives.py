"""Whole commands under an audit hook: all executed code is installed or named by the user, and all unpickling
falls under one of the two exceptions of the design.
"""

from __future__ import annotations

import pytest
from attacks.test_control_attacks import check_safe, played
from attacks.watch import MARK


@pytest.fixture(scope="module")
def control(tmp_path_factory: pytest.TempPathFactory) -> dict:
    place = tmp_path_factory.mktemp(f"{MARK}-lives")
    return {"place": str(place), **{s: played("attacks.lives", place, s) for s in ("control", "spawned")}}


@pytest.fixture(scope="module")
def language(tmp_path_factory: pytest.TempPathFactory) -> dict:
    place = tmp_path_factory.mktemp(f"{MARK}-lives")
    return {"place": str(place), **played("attacks.lives", place, "language")}


def check_lives(found: dict) -> None:
    """Every command did its work and ran nothing else; only those without a name were refused."""
    for name, result in found["commands"].items():
        check_safe(result, megabytes=4000)
        assert result["code"] == (2 if "unnamed" in name else 0), (name, result["text"])


def test_a_life_of_control_unpickles_only_compiled_code(control: dict):
    found = control["control"]
    check_lives(found)
    assert {line.partition(":")[0] for line in found["excepted"]} <= {"cache"}
    assert found["workers"] == []
    assert found["imported"] == [f"{MARK}_tasks.py"]  # --env-module


def test_a_spawned_worker_unpickles_the_factory_when_it_starts_and_nothing_later(control: dict):
    found = control["spawned"]
    check_lives(found)
    assert {line.partition(":")[0] for line in found["workers"]} == {"transport"}
    assert found["excepted"] == found["imported"] == []


def test_a_life_of_language_unpickles_nothing_and_trusts_no_remote_code(language: dict):
    check_lives(language)
    assert language["excepted"] == language["workers"] == []
    assert language["imported"] == [f"{MARK}_judge.py"]  # --reward
    calls = language["pretrained"]
    assert {call["kind"] for call in calls} == {
        "AutoConfig", "AutoTokenizer", "AutoModelForCausalLM", "AutoModelForSequenceClassification",
    }  # fmt: skip
    assert all(call["trust_remote_code"] is False for call in calls)
    assert all(call["use_safetensors"] is True for call in calls if "ModelFor" in call["kind"])


def test_user_code_must_be_named_again_and_the_command_is_printed(control: dict, language: dict):
    found, place = control["spawned"]["commands"], control["place"]
    for command in ("evaluate", "resume"):
        text = found[f"{command} unnamed"]["text"]
        assert f"tightrope {command} {place}/{MARK}-own --env-module FILE.py" in text
    found, place = language["commands"], language["place"]
    again = f"--reward {place}/{MARK}_judge.py:score"
    assert f"tightrope resume {place}/{MARK}-align {again}" in found["resume unnamed"]["text"]
    assert f"tightrope align --settings {place}/{MARK}-align {again}" in found["align unnamed"]["text"]
