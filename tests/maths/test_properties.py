"""The identities of the mathematics, in float64, on rollouts that hypothesis draws."""

import importlib
from collections.abc import Callable
from types import ModuleType

import pytest
from hypothesis import given
from maths_cases import CASES, PROPERTY, Case
from properties import MODULES, PROPERTIES

import tightrope.maths

for name in MODULES:
    importlib.import_module(f"tightrope.maths.{name}")


@pytest.mark.parametrize("holds", PROPERTIES, ids=lambda holds: holds.__name__)
@PROPERTY
@given(case=CASES)
def test_property(holds: Callable[[ModuleType, Case], None], case: Case) -> None:
    holds(tightrope.maths, case)
