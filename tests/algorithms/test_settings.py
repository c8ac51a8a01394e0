"""Settings are checked when they are created, and fall along their schedules."""

import dataclasses

import pytest

from tightrope.algorithms.settings import A2CSettings, PPOSettings, ReinforceSettings
from tightrope.settings.fields import scheduled


@pytest.mark.parametrize("kind", [PPOSettings, A2CSettings, ReinforceSettings])
def test_every_field_has_a_doc(kind):
    for field in dataclasses.fields(kind):
        assert len(field.metadata["doc"]) > 20, field.name


@pytest.mark.parametrize(
    "values",
    [
        {"clip": 0.0},
        {"gamma": 1.01},
        {"gamma": float("nan")},
        {"num_epochs": 0},
        {"dual_clip": 1.0},
        {"learning_rate_schedule": "step"},
        {"max_grad_norm": -1.0},
    ],
)
def test_values_out_of_range_are_named(values):
    (name,) = values
    with pytest.raises(ValueError, match=rf"{name} is .*expected"):
        PPOSettings(**values)


def test_optional_settings_may_be_none():
    assert PPOSettings(max_grad_norm=None, target_kl=None).max_grad_norm is None


def test_schedules():
    assert scheduled(2.0, "constant", 0.7) == 2.0
    assert scheduled(2.0, "linear", 0.75) == 0.5
    assert scheduled(2.0, "cosine", 0.5) == pytest.approx(1.0)
    assert scheduled(2.0, "cosine", 1.0) == pytest.approx(0.0)
    assert scheduled(None, "linear", 0.5) is None


def test_at_moves_only_what_has_a_schedule():
    settings = PPOSettings(
        learning_rate=1.0, critic_learning_rate=2.0, clip=0.2, clip_schedule="linear", entropy_weight=0.1
    )
    present = settings.at(0.5)
    assert (present.learning_rate, present.critic_learning_rate, present.clip) == (0.5, 1.0, 0.1)
    assert present.entropy_weight == 0.1
    assert settings.at(1.0).learning_rate == 0.0
