"""What the training loops tell while they run, by ``report(event, data)``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tightrope.runs.records import printable

Reporter = Callable[[str, dict[str, Any]], None]


def teller(report: Reporter) -> Callable[[str], None]:
    """What tells the user a text through the ``line`` event of a report; a warning when it begins so."""
    return lambda text: report("line", {"text": printable(text), "warning": text.startswith("warning:")})
