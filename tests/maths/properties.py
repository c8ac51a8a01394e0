"""What the mathematics must fulfil, each property a function of (maths, case) that raises AssertionError.

`maths` is the package, handed in, so that the same checks judge the real one (test_properties.py) and its
mutants (test_mutants.py). The references are written another way than the code under test: loops over Python
numbers, sums over all actions, numpy, torch.distributions.
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
