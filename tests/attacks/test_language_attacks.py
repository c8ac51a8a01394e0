"""Hostile model folders, adapters and language runs: none of their code runs."""

from __future__ import annotations

import pytest
from attacks import language_corpus
from attacks.test_control_attacks import check_safe, played

GROUPS = {
    "model": language_corpus.of_models(),
    "judge": language_corpus.of_judges(),
    "adapter": language_corpus.of_adapters(),
    "align": language_corpus.of_runs(),
    "sft": language_corpus.of_supervised(),
    "rewarding": language_corpus.of_supervised(),
}
CASES = {f"{group}: {attack.name}": attack for group, attacks in GROUPS.items() for attack in attacks}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict:
    return played("attacks.language_corpus", tmp_path_factory.mktemp("attacks"))["attacks"]


@pytest.mark.parametrize("group", GROUPS)
def test_without_an_attack_everything_works(results: dict, group: str):
    for result in results[f"{group}: none"].values():
        check_safe(result)
        assert result["code"] == 0, result["text"]


@pytest.mark.parametrize("name", CASES)
def test_an_attack_is_harmless_or_refused(results: dict, name: str):
    for result in results[name].values():
        check_safe(result)
    first = next(iter(results[name].values()))
    words = CASES[name].words
    if words is None:
        assert first["code"] == 0, first["text"]
    elif name != "align: pickle as samples.jsonl":
        assert words in first["text"]


def test_a_chat_template_is_run_in_a_sandbox(results: dict):
    """A template is a program; forbidden access is a data error."""
    result = results["template: template"]["chat"]
    check_safe(result)
    assert result["code"] == 2 and "the chat template refuses" in result["text"]
    assert results["template: none"]["chat"]["code"] == 0
