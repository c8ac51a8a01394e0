"""How a run shows itself: a live panel on a terminal, plain lines elsewhere, or nothing. All three are
`report` calls.

The training loops call ``report(event, data)``. These are the events and the keys of their data:

- ``line``: ``text``, and ``warning``: True for one, printed also when quiet, and with "warning: " before it.
- ``start``: ``settings``, ``run_dir``, ``step`` (where the run stands), ``total_steps``, ``lines`` to print.
- ``update``: ``step``, ``total_steps``, ``seconds`` of training so far, ``metrics`` as in metrics.jsonl.
- ``evaluation`` (control): ``step``, ``eval/mean_reward``, ``eval/std_reward``, ``eval/mean_length``,
  ``eval/episodes``.
- ``samples`` (align): ``step``, ``rows`` as in samples.jsonl.
- ``finish``: the keys of summary.json.

Steps are environment steps, responses (align), or optimiser steps (sft, reward).
"""

from __future__ import annotations

import itertools
import math
import sys
import time
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Protocol, TextIO

from tightrope.training.report import shown

BARS = "▁▂▃▄▅▆▇█"
PLAIN_LINES = 20
SECONDS_BETWEEN_PAINTS = 0.25


class Report(Protocol):
    """What the training loops call, as a context around the run."""

    run: str | None
    step: int

    def __call__(self, event: str, data: dict[str, Any]) -> None: ...

    def __enter__(self) -> Report: ...

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None: ...


def choose(stream: TextIO, *, quiet: bool, live: bool) -> Report:
    """The report for a stream: nothing when quiet, a panel when ``live``, else plain lines."""
    if quiet:
        return Lines(stream, rows=0)
    return Panel(stream) if live else Lines(stream)


def can_live(stream: TextIO, environment: dict[str, str]) -> bool:
    """Whether a stream may be repainted: a tty, TERM not dumb, NO_COLOR and CI not set."""
    plain = environment.get("NO_COLOR") or environment.get("TERM", "") == "dumb" or environment.get("CI")
    return bool(stream.isatty()) and not plain


class Lines:
    """Plain text, about ``rows`` aligned lines a run; with ``rows`` 0 warnings alone (on stderr)."""

    def __init__(self, stream: TextIO, rows: int = PLAIN_LINES) -> None:
        self.run: str | None = None
        self.step = 0
        self._stream, self._rows, self._next = stream, rows, 0.0
        self._progress = Progress()
        self._head = self._owed = False

    def __call__(self, event: str, data: dict[str, Any]) -> None:
        """Print what is due."""
        self._progress.take(event, data)
        self.run, self.step = self._progress.run, self._progress.step
        if event == "line":
            if data["warning"]:
                print(shown(data), file=sys.stderr, flush=True)
            elif self._rows:
                self._print(shown(data))
        elif self._rows and event == "start":
            self._print("\n".join(str(line) for line in data.get("lines", ())))
        elif self._rows and event == "update":
            self._owed = True
            share = self._progress.total_steps / self._rows
            if self.step >= self._next:
                self._next = (math.floor(self.step / share) + 1) * share
                self._row()
        elif event == "finish" and self._owed:
            self._row()

    def _row(self) -> None:
        self._owed = False
        cells = zip(self._progress.row(), _COLUMNS, strict=True)
        text = "".join(f"{cell:>{width}}" for cell, (_, width) in cells)
        if not self._head:
            text = "".join(f"{name:>{width}}" for name, width in _COLUMNS) + "\n" + text
            self._head = True
        self._print(text)

    def _print(self, text: str) -> None:
        try:
            print(text, file=self._stream, flush=True)
        except BrokenPipeError:  # `tightrope train ... | head`: the reader left, the run goes on
            self._rows = 0

    def __enter__(self) -> Lines:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None


_COLUMNS = (
    ("steps", 12),
    ("%", 6),
    ("return", 11),
    ("length", 9),
    ("KL", 9),
    ("clipped", 9),
    ("steps/s", 10),
    ("evaluation", 20),
    ("left", 9),
)


class Panel:
    """A small panel, repainted in place at most four times a second and only when something happened."""

    def __init__(self, stream: TextIO) -> None:
        self.run: str | None = None
        self.step = 0
        self._stream = stream
        self._progress = Progress()
        self._live: Any = None
        self._painted = -math.inf

    def __call__(self, event: str, data: dict[str, Any]) -> None:
        """Take the event in; repaint when the last painting is old enough."""
        self._progress.take(event, data)
        self.run, self.step = self._progress.run, self._progress.step
        if event == "line":
            self._live.console.print(shown(data), markup=False, highlight=False)
        elif event == "start":
            for line in data.get("lines", ()):
                self._live.console.print(str(line), markup=False, highlight=False)
        now = time.monotonic()
        if now - self._painted >= SECONDS_BETWEEN_PAINTS or event in ("start", "finish"):
            self._painted = now
            self._live.update(self._paint(), refresh=True)

    def _paint(self) -> Any:
        from rich import box
        from rich.panel import Panel as Frame
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        p = self._progress
        _, share, returned, length, kl, clipped, speed, evaluation, left = p.row()
        bar = Table.grid(padding=(0, 2))
        bar.add_row(
            ProgressBar(total=max(1, p.total_steps), completed=p.step, width=34),
            Text(f"{p.step:,} of {p.total_steps:,} steps"),
            Text(f"{share} %"),
            Text(f"left {left}", style="bold"),
        )
        learned = Table.grid(padding=(0, 2))
        learned.add_row(
            "return", Text(returned, style="bold green"), Text(sparkline(p.returns, 30), style="green")
        )
        numbers = Text(f"KL {kl}   clipped {clipped}   length {length}   {speed} steps/s")
        tested = Text(f"evaluation {evaluation}" if p.evaluation else "evaluation not yet", style="cyan")
        body = Table.grid()
        for row in (bar, learned, tested, numbers):
            body.add_row(row)
        return Frame(body, title=Text(p.title), title_align="left", box=box.ROUNDED, expand=False)

    def __enter__(self) -> Panel:
        from rich.console import Console
        from rich.live import Live
        from rich.text import Text

        console = Console(file=self._stream)
        self._live = Live(Text(""), console=console, auto_refresh=False, transient=False)
        self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.stop()


class Progress:
    """Where a run stands: what the events said, and the time left at the speed so far."""

    def __init__(self) -> None:
        self.run: str | None = None
        self.title = ""
        self.step = self.total_steps = 0
        self.metrics: dict[str, Any] = {}
        self.returns: list[float] = []
        self.length: float | None = None
        self.evaluation: tuple[float, float] | None = None
        self._start_step, self._start_time = 0, time.monotonic()

    def take(self, event: str, data: dict[str, Any]) -> None:
        """Remember what an event says."""
        if event == "start":
            settings = data["settings"]
            self.title = f"{settings['env']} · {settings['algorithm']} · seed {settings['seed']}"
            self.run = str(data["run_dir"])
            self.step = self._start_step = data["step"]
            self.total_steps = data["total_steps"]
            self._start_time = time.monotonic()
        elif event == "update":
            self.step, self.total_steps = data["step"], data["total_steps"]
            self.metrics = data["metrics"]
            value = self.metrics.get("rollout/ep_rew_mean", math.nan)
            if _finite(value):
                self.returns.append(float(value))
                self.length = self.metrics.get("rollout/ep_len_mean")
        elif event == "evaluation":
            self.evaluation = (data["eval/mean_reward"], data["eval/std_reward"])

    def seconds_left(self) -> float:
        """At the average speed so far, evaluations and saving included; NaN before the first step."""
        steps, seconds = self.step - self._start_step, time.monotonic() - self._start_time
        return seconds * (self.total_steps - self.step) / steps if steps > 0 else math.nan

    def row(self) -> tuple[str, ...]:
        """The cells of one line, in the order of the columns."""
        values = self.metrics
        return_ = self.returns[-1] if self.returns else None
        share = 100 * self.step / self.total_steps if self.total_steps else 0
        clipped = values.get("train/clip_fraction")
        return (
            f"{self.step:,}",
            f"{share:.0f}",
            number(return_),
            number(self.length),
            f"{values['train/approx_kl']:.4f}" if _finite(values.get("train/approx_kl")) else "-",
            f"{100 * clipped:.1f} %" if clipped is not None and _finite(clipped) else "-",
            f"{values['time/fps']:,.0f}" if _finite(values.get("time/fps")) else "-",
            f"{number(self.evaluation[0])} ± {number(self.evaluation[1])}" if self.evaluation else "-",
            clock(self.seconds_left()),
        )


def _finite(value: Any) -> bool:
    return value is not None and math.isfinite(value)


def number(value: float | None) -> str:
    """A figure in few characters: 1,234.5, 12.34, 0.0123, ``-`` for nothing."""
    if value is None or not math.isfinite(value):
        return "-"
    size = abs(value)
    return f"{value:,.1f}" if size >= 100 else f"{value:.2f}" if size >= 0.1 or size == 0 else f"{value:.4f}"


def clock(seconds: float) -> str:
    """``0:42``, ``12:05``, ``3:07:00``; ``-`` for NaN."""
    if not math.isfinite(seconds):
        return "-"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _means(values: Sequence[float], width: int) -> list[float]:
    """``values`` as at most ``width`` means of equal stretches."""
    count = min(width, len(values))
    edges = [round(i * len(values) / count) for i in range(count + 1)]
    return [sum(values[a:b]) / (b - a) for a, b in itertools.pairwise(edges)]


def sparkline(values: Sequence[float], width: int) -> str:
    """A curve in one line of bars, the lowest value the lowest bar."""
    if not values:
        return ""
    means = _means(values, width)
    low, high = min(means), max(means)
    scale = (len(BARS) - 1) / (high - low) if high > low else 0.0
    return "".join(BARS[round((value - low) * scale)] for value in means)


def curve(points: Sequence[tuple[int, float]], width: int = 60, height: int = 8) -> list[str]:
    """A text plot of (step, return) pairs, steps to the right: lines to print, none for fewer than two
    points.
    """
    points = [(step, value) for step, value in points if _finite(value)]
    if len(points) < 2:
        return []
    means = _means([value for _, value in points], width)
    low, high = min(means), max(means)
    levels = height * (len(BARS)) - 1
    filled = [round((value - low) / (high - low) * levels) if high > low else 0 for value in means]
    labels = {0: number(high), height - 1: number(low)}
    margin = max(len(text) for text in labels.values())
    lines = []
    for row in range(height):
        base = (height - 1 - row) * len(BARS)
        cells = "".join(" " if level < base else BARS[min(level - base, len(BARS) - 1)] for level in filled)
        lines.append(f"{labels.get(row, ''):>{margin}} │{cells}".rstrip())
    first, last = f"{points[0][0]:,}", f"{points[-1][0]:,} steps"
    lines.append(" " * (margin + 2) + first + last.rjust(max(len(last) + 1, len(means) - len(first))))
    return lines
