"""How a metric is declared: `Metric`, and `metric` to write one down in a line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Good = Literal["up", "down", "inside", "any"]


@dataclass(frozen=True, kw_only=True)
class Metric:
    """One number of a run.

    ``good`` says how to read it: ``up`` and ``down`` name the better direction, ``inside`` means that it
    belongs between ``low`` and ``high``, ``any`` that it describes and does not judge. ``negative`` is True
    where values below 0 are possible. ``low`` and ``high`` bound the healthy range; None where there is no
    such bound.
    """

    name: str
    unit: str
    good: Good
    doc: str
    negative: bool = False
    low: float | None = None
    high: float | None = None

    @property
    def healthy(self) -> str:
        """The healthy range in words; an empty string where there is none."""
        if self.low is not None and self.high is not None:
            return f"{self.low:g} to {self.high:g}"
        if self.low is not None:
            return f"at least {self.low:g}"
        return f"at most {self.high:g}" if self.high is not None else ""


def metric(
    name: str,
    unit: str,
    good: Good,
    doc: str,
    negative: bool = False,
    low: float | None = None,
    high: float | None = None,
) -> Metric:
    """A `Metric` from positions, so that a table of them reads as a table."""
    return Metric(name=name, unit=unit, good=good, doc=doc, negative=negative, low=low, high=high)
