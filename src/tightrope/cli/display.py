"""How a run is displayed: live on a terminal, as plain lines elsewhere, or not at all. The display is a
listener of the training loop (training/events.py).
"""

from __future__ import annotations

import itertools
import math
import sys
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple, TextIO, TypeGuard

from tightrope.runs.records import in_lines, printable
from tightrope.training.events import Evaluated, Event, Finished, Message, Samples, Started, Updated

if TYPE_CHECKING:
    from rich.live import Live
    from rich.panel import Panel

BARS = "▁▂▃▄▅▆▇█"
PLAIN_LINES = 20  # of a run that is not watched on a terminal
SECONDS_BETWEEN_PAINTS = 0.25
SAMPLES = 3  # responses of a table: the best score, the middle and the worst
WIDEST = 76  # characters of a line of the panel; fewer in a narrow terminal
BORDER = 4  # of the panel, left and right


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


class Column(NamedTuple):
    """One figure of the display: its heading, how its metrics are written, their names, and its width."""

    head: str
    form: Callable[..., str]
    metrics: tuple[str, ...]
    width: int = 11


class View(NamedTuple):
    """What a command displays: what it counts, and the figures; of the first one there is a curve."""

    counted: str
    columns: tuple[Column, ...]


CONTROL = View(
    "steps",
    (
        Column("return", number, ("rollout/ep_rew_mean",)),
        Column("length", number, ("rollout/ep_len_mean",), 9),
        Column("KL", "{:.4f}".format, ("train/approx_kl",), 9),
        Column("clipped", lambda share: f"{100 * share:.1f} %", ("train/clip_fraction",), 9),
        Column("steps/s", "{:,.0f}".format, ("time/fps",), 10),
        Column(
            "evaluation",
            lambda mean, deviation: f"{number(mean)} ± {number(deviation)}",
            ("eval/mean_reward", "eval/std_reward"),
            20,
        ),
    ),
)
ALIGN = View(
    "responses",
    (
        Column("score", "{:.3f}".format, ("objective/scores",)),
        Column("KL", "{:.2f}".format, ("objective/kl",)),
        Column("length", "{:.1f}".format, ("objective/response_length",)),
        Column("EOS", "{:.0%}".format, ("objective/eos_fraction",)),
        Column("distinct", "{:.2f}".format, ("objective/distinct_2",)),
        Column("clipped", "{:.1%}".format, ("train/clip_fraction",)),
        Column("explained", "{:.2f}".format, ("train/explained_variance",)),
        Column("gold", "{:.3f}".format, ("eval/gold",)),
    ),
)
SFT = View(
    "steps",
    (
        Column("loss", "{:.3f}".format, ("sft/loss",)),
        Column("held out", "{:.3f}".format, ("sft/held_out_loss",)),
    ),
)
REWARD = View(
    "steps",
    (
        Column("loss", "{:.3f}".format, ("reward/loss",)),
        Column("accuracy", "{:.1%}".format, ("reward/accuracy",)),
        Column("held out", "{:.1%}".format, ("reward/held_out_accuracy",)),
    ),
)


def can_live(stream: TextIO, environment: dict[str, str]) -> bool:
    """Whether a stream may be repainted: a tty, TERM not dumb, NO_COLOR and CI not set."""
    plain = environment.get("NO_COLOR") or environment.get("TERM", "") == "dumb" or environment.get("CI")
    return bool(stream.isatty()) and not plain


class Display:
    """The display of a run, a listener and a context around the run. ``run`` is its folder, ``step`` its
    position.

    ``live``: a small panel, repainted in place at most four times a second and only when something happened;
    until the run begins it shows ``title`` and that models and data are loaded. Otherwise about twenty
    aligned lines a run; ``quiet``: only warnings, on stderr.
    """

    def __init__(
        self, view: View, stream: TextIO, *, quiet: bool = False, live: bool = False, title: str = ""
    ) -> None:
        self.run: str | None = None
        self.step = self.total = 0
        self._view, self._stream, self._quiet = view, stream, quiet
        self._panel: Live | None = self._live() if live and not quiet else None
        self._title = title
        self._seen: dict[str, float] = {}  # the newest finite value of each metric
        self._curve: list[float] = []
        self._first, self._begin = 0, time.monotonic()
        self._painted = self._next = -math.inf
        self._head = self._owed = False

    def _live(self) -> Live:
        from rich.console import Console
        from rich.live import Live

        return Live("", console=Console(file=self._stream), auto_refresh=False)

    def __enter__(self) -> Display:
        if self._panel is not None:
            self._panel.start()
            self._panel.update(self._paint(), refresh=True)  # before torch is imported, which takes seconds
        return self

    def __exit__(self, *_error: object) -> None:
        if self._panel is not None:
            self._panel.stop()

    def __call__(self, event: Event) -> None:
        """Take the event in and show what is due."""
        self._take(event)
        try:
            self._show(event)
        except BrokenPipeError:  # `tightrope train ... | head`: the reader left, the run continues
            self._quiet = True

    def _take(self, event: Event) -> None:
        if isinstance(event, Started):
            named = [event.settings.get(name) for name in ("env", "model", "algorithm")]
            words = [*map(str, filter(None, named)), f"seed {event.settings.get('seed')}"]
            self._title = printable(" · ".join(words))
            self.run, self.step, self.total = event.run_dir, event.step, event.total_steps
            self._first, self._begin = event.step, time.monotonic()
        elif isinstance(event, Updated):
            self.step, self.total = event.step, event.total_steps
            first = event.metrics.get(self._view.columns[0].metrics[0])
            if _finite(first):
                self._curve.append(first)
        if isinstance(event, Updated | Evaluated):
            self._seen |= {name: value for name, value in event.metrics.items() if _finite(value)}

    def _show(self, event: Event) -> None:
        if isinstance(event, Started):
            for line in event.lines:
                self._print(line)
        elif isinstance(event, Message):
            self._print(str(event), warning=event.level == "warning")
        elif isinstance(event, Samples) and not self._quiet:
            from tightrope.language.alignment.samples import print_samples, spread

            rows, title = spread(event.rows, SAMPLES), f"after {event.step:,} responses"
            console = None if self._panel is None else self._panel.console
            print_samples(rows, self._stream, title=title, console=console)
        if self._panel is not None:
            now = time.monotonic()
            if now - self._painted >= SECONDS_BETWEEN_PAINTS or isinstance(event, Started | Finished):
                self._painted = now
                self._panel.update(self._paint(), refresh=True)
        elif isinstance(event, Updated):
            self._owed = True
            if self.step >= self._next:
                share = self.total / PLAIN_LINES
                self._next = (math.floor(self.step / share) + 1) * share
                self._row()
        elif isinstance(event, Finished) and self._owed:
            self._row()

    def _row(self) -> None:
        """Print the figures as one line of the table, below the headings where they are missing."""
        columns = self._view.columns
        if not self._head:
            heads = "".join(f"{column.head:>{column.width}}" for column in columns)
            self._print(f"{self._view.counted:>12}{'%':>6}{heads}{'left':>9}")
        cells = "".join(f"{self._cell(column):>{column.width}}" for column in columns)
        self._print(f"{self.step:>12,}{self._share():>6.0f}{cells}{clock(self.seconds_left()):>9}")
        self._head, self._owed = True, False

    def _print(self, text: str, *, warning: bool = False) -> None:
        if self._panel is not None:
            style = "yellow" if warning else None
            self._panel.console.print(text, markup=False, highlight=False, style=style)
        elif warning:
            print(text, file=sys.stderr, flush=True)
        elif not self._quiet:
            print(text, file=self._stream, flush=True)

    def _paint(self) -> Panel:
        from rich import box
        from rich.panel import Panel
        from rich.text import Text

        assert self._panel is not None
        width = max(8, min(WIDEST, self._panel.console.width - BORDER))
        body = Text("loading ..." if self.run is None else "", style="" if self.run else "dim")
        if self.run is not None:
            full = round(width * self.step / max(1, self.total))
            body.append("━" * full, style="green")
            body.append("━" * (width - full), style="dim")
            reached = [f"{self.step:,} of {self.total:,} {self._view.counted}", f"{self._share():.0f} %"]
            body.append("\n" + in_lines([*reached, f"left {clock(self.seconds_left())}"], width))
            first, *others = self._view.columns
            body.append(f"\n{first.head} ").append(self._cell(first), style="bold green")
            room = width - len(first.head) - len(self._cell(first)) - 4
            body.append("   " + sparkline(self._curve, max(1, room)), style="green")
            cells = [(column.head, self._cell(column)) for column in others]
            figures = [f"{cell} {head}" if "/" in head else f"{head} {cell}" for head, cell in cells]
            body.append("\n" + in_lines(figures, width))
        title = Text(self._title, overflow="ellipsis", no_wrap=True)
        return Panel(body, title=title, title_align="left", box=box.ROUNDED, expand=False)

    def _cell(self, column: Column) -> str:
        found = all(name in self._seen for name in column.metrics)
        return column.form(*(self._seen[name] for name in column.metrics)) if found else "-"

    def _share(self) -> float:
        return 100 * self.step / max(1, self.total)

    def seconds_left(self) -> float:
        """At the average speed so far, evaluations and saving included; NaN before the first step."""
        steps, seconds = self.step - self._first, time.monotonic() - self._begin
        return seconds * (self.total - self.step) / steps if steps > 0 else math.nan


def _finite(value: float | None) -> TypeGuard[float]:
    return value is not None and math.isfinite(value)


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
