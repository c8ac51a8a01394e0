"""What a run reports while it trains, and what a listener can request.

A listener is a callable that takes one event. A run has a list of them: the terminal display and TensorBoard
are two. Steps are environment steps (control), responses (align) or optimiser steps (sft, reward).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Literal

from tightrope.runs.records import printable

__all__ = [
    "Change", "Evaluated", "Event", "Finished", "Level", "Listener", "Listeners", "Message", "Request",
    "Samples", "Started", "Stop", "Updated",
]  # fmt: skip

Level = Literal["info", "warning"]


@dataclass(frozen=True)
class Started:
    """The run begins, or continues at ``step``; ``lines`` describe it."""

    run_dir: str
    settings: dict[str, Any]
    step: int
    total_steps: int
    lines: tuple[str, ...]


@dataclass(frozen=True)
class Updated:
    """One update is done and recorded: ``metrics`` as in metrics.jsonl, ``seconds`` of training so far."""

    step: int
    total_steps: int
    seconds: float
    metrics: dict[str, float]


@dataclass(frozen=True)
class Evaluated:
    """The model was evaluated on other episodes or held-out examples."""

    step: int
    metrics: dict[str, float]


@dataclass(frozen=True)
class Samples:
    """Responses of the newest iteration of align: ``rows`` as in samples.jsonl."""

    step: int
    rows: list[dict[str, Any]]


@dataclass(frozen=True)
class Message:
    """A line for people. The text of a warning does not begin with the word."""

    text: str
    level: Level = "info"

    def __str__(self) -> str:
        return f"warning: {self.text}" if self.level == "warning" else self.text


@dataclass(frozen=True)
class Finished:
    """The run is complete; ``summary`` as in summary.json."""

    summary: dict[str, Any]


@dataclass(frozen=True)
class Stop:
    """Asks the loop to end the run after this update: it is saved and summarised as at its end."""

    reason: str = ""


@dataclass(frozen=True)
class Change:
    """Asks the loop to use another value of a setting from the next update on; see `learner.CHANGEABLE`."""

    setting: str
    value: float | None


Event = Started | Updated | Evaluated | Samples | Message | Finished
Request = Stop | Change
Listener = Callable[[Event], Request | None]


class Listeners:
    """Passes each event to every listener, in order, and collects what they ask for in ``requests``."""

    def __init__(self, listeners: Iterable[Listener] = ()) -> None:
        self._listeners = list(listeners)
        self.requests: list[Request] = []

    def add(self, listener: Listener) -> None:
        """One more listener."""
        self._listeners.append(listener)

    def __call__(self, event: Event) -> None:
        for listener in self._listeners:
            asked = listener(event)
            if asked is None:
                continue
            if not isinstance(asked, Stop | Change):
                raise TypeError(f"A listener returned {asked!r}; expected None, Stop(...) or Change(...).")
            self.requests.append(asked)

    def info(self, text: str) -> None:
        """Send a line, made safe for a terminal."""
        self(Message(printable(text)))

    def warn(self, text: str) -> None:
        """Send a warning, made safe for a terminal; ``text`` without the word."""
        self(Message(printable(text), "warning"))
