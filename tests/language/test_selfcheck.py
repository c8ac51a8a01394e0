"""The doctor's checks of a language model: each can fail, in every precision."""

import pytest
import torch
from language.tiny import saved

from tightrope.language import selfcheck
from tightrope.language.model import trunk


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return saved(tmp_path_factory.mktemp("model"))


def bad(folder: str, dtype: str = "float32") -> list[str]:
    """The problems that the doctor finds."""
    return [finding.what for finding in selfcheck.check_model(folder, dtype) if not finding.good]


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_a_healthy_model_is_healthy_in_every_precision(folder, dtype):
    assert bad(folder, dtype) == []


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_a_model_that_attends_to_padding_on_the_left_is_found(folder, dtype, monkeypatch):
    """It is correct for rows padded on the right: no other check compares the two sides."""
    real = trunk._run

    def careless(base, mask, **inputs):
        return real(base, torch.ones_like(mask), **inputs)

    monkeypatch.setattr(trunk, "_run", careless)
    assert "padding on the right and on the left are one" in bad(folder, dtype)


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_a_policy_that_trains_at_another_temperature_is_found_in_every_precision(folder, dtype, monkeypatch):
    """Hidden states of the training pass are 1.5 times too large: sampling and training use two policies."""
    real, calls = trunk.Role.hidden, []

    def warmer(self, *given):
        if self.adapter == "policy":
            calls.append(1)
        return real(self, *given) * (1.5 if self.adapter == "policy" and len(calls) > 1 else 1.0)

    monkeypatch.setattr(trunk.Role, "hidden", warmer)
    assert "every ratio is 1 before the first step" in bad(folder, dtype)

    def always(self, *given):
        return real(self, *given) * (1.5 if self.adapter == "policy" else 1.0)

    monkeypatch.setattr(trunk.Role, "hidden", always)
    assert "sampling and training agree" in bad(folder, dtype)
