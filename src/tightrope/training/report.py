"""What the training loops tell while they run, by ``report(event, data)``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tightrope.runs.records import printable

Reporter = Callable[[str, dict[str, Any]], None]
WARNING = "warning: "  # how a warning begins where it is text alone


def silent(event: str, data: dict[str, Any]) -> None:
    """The reporter that says nothing."""


def say(report: Reporter, text: str, *, warning: bool = False) -> None:
    """Send a text as a ``line`` event; the only place that does, so that every one says what it is."""
    report("line", {"text": text, "warning": warning})


def warn(report: Reporter, text: str) -> None:
    """Send a text, without the word "warning", as a warning."""
    say(report, text, warning=True)


def warner(report: Reporter) -> Callable[[str], None]:
    """Sends each text as a warning."""
    return lambda text: warn(report, text)


def teller(report: Reporter) -> Callable[[str], None]:
    """Sends each text made safe for a terminal, as a warning when it begins with "warning: "."""
    return lambda text: say(report, printable(text.removeprefix(WARNING)), warning=text.startswith(WARNING))


def shown(data: dict[str, Any]) -> str:
    """The text of a ``line`` event as a display prints it."""
    return f"{WARNING}{data['text']}" if data["warning"] else str(data["text"])
