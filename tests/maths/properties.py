"""Properties of the mathematics: each is a function of (maths, case) that raises AssertionError.

`maths` is the package, passed in so that the same checks test the real one (test_properties.py) and its
mutants (test_mutants.py). The references do not share the method of the code under test: they use loops over
Python numbers, sums over all actions, numpy, torch.distributions.
"""

from collections.abc import Callable
from types import ModuleType

import properties_divergence
import properties_returns
import properties_statistics
import properties_surrogate
from maths_cases import FIXED_CASES, Case

PROPERTIES: tuple[Callable[[ModuleType, Case], None], ...] = (
    *properties_returns.PROPERTIES,
    *properties_surrogate.PROPERTIES,
    *properties_statistics.PROPERTIES,
    *properties_divergence.PROPERTIES,
)
MODULES = ("returns", "surrogate", "values", "divergence", "statistics")


def check_all(maths: ModuleType) -> None:
    """Every property on the fixed cases; AssertionError at the first that does not hold."""
    for holds in PROPERTIES:
        for case in FIXED_CASES:
            holds(maths, case)
