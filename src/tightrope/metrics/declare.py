"""How a metric is declared: `Metric`, and `metric`, its short form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Good = Literal["up", "down", "inside", "any"]


@dataclass(frozen=True, kw_only=True)
class Metric:
    """One number of a run.

    ``good``: which values are good. ``up`` and ``down`` name the better direction, ``inside`` means between
    ``low`` and ``high``, ``any`` that no value is better. ``negative`` is True if values below 0 are
    possible. ``low`` and ``high`` bound the healthy range; None: no such bound.
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
        """The healthy range as text; an empty string if there is none."""
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
    """A `Metric` from positional arguments, which keeps the tables short."""
    return Metric(name=name, unit=unit, good=good, doc=doc, negative=negative, low=low, high=high)
