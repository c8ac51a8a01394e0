"""The family table of docs/families.md: each third family runs, or is refused in one sentence of our own."""

import importlib.util
import json
import sys

import pytest
from contracts.source_tree import ROOT

SPEC = importlib.util.spec_from_file_location("family_table", ROOT / "benchmarks/families.py")
assert SPEC is not None and SPEC.loader is not None
table = importlib.util.module_from_spec(SPEC)
sys.modules[SPEC.name] = table
SPEC.loader.exec_module(table)

MEASURED = json.loads((ROOT / "benchmarks/results/language/families.json").read_text(encoding="utf-8"))
COLUMNS = ("sft", "align_lora")  # the rest of a row takes several times as long
FAST = 8.0  # seconds of a processor for a whole row, where the table was measured


def third() -> list[str]:
    """Each third of the measured families that can be built and are fast, and that this version has."""
    fast = [kind for kind, row in MEASURED["rows"].items() if row.get("seconds", FAST) < FAST]
    return [kind for kind in fast[::3] if kind in table.families()]


@pytest.mark.filterwarnings(
    "ignore:.*adapter. PEFT:UserWarning"
)  # what PEFT cannot open is told, not refused
@pytest.mark.parametrize("kind", third())
def test_a_family_is_right_or_refused_in_a_sentence(kind, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    row = table.tried(kind, COLUMNS)
    assert "not_built" not in row, row
    wrong = {name: row[name] for name in COLUMNS if row[name]["verdict"] not in ("ok", "refused")}
    assert not wrong


def test_an_error_of_a_library_is_no_refusal():
    try:
        raise ValueError("of this test, not of the package")
    except ValueError as error:
        assert not table.is_refusal(error)
    with pytest.raises(ValueError, match="held_out") as found:
        from tightrope.language import SFTSettings

        SFTSettings(held_out=2.0)
    assert table.is_refusal(found.value)


def test_the_small_rule_makes_numbers_small_and_every_dropout_positive():
    config = table.small_config("opt")
    assert config.vocab_size == 64
    assert config.num_hidden_layers == 4
    assert config.layerdrop == config.dropout == table.DROPOUT
    with pytest.raises(table.CannotBuild, match="parts beside its text model"):
        table.small_config("gemma3")
