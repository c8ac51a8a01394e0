"""How a run is displayed: live on a terminal, as plain lines elsewhere, or not at all. Each display is a
listener of the training loop (training/events.py).
"""

from __future__ import annotations

import itertools
import math
import sys
import time
from collections.abc import Sequence
from types import TracebackType
from typing import Any, NamedTuple, Protocol, TextIO

from tightrope.training.events import Evaluated, Event, Finished, Message, Samples, Started, Updated

BARS = "▁▂▃▄▅▆▇█"
PLAIN_LINES = 20
SECONDS_BETWEEN_PAINTS = 0.25


class Shown(Protocol):
    """A display, as a context around the run; ``run`` is its folder, ``step`` its position."""

    run: str | None
    step: int

    def __call__(self, event: Event) -> None: ...

    def __enter__(self) -> Shown: ...

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None: ...


def choose(stream: TextIO, *, quiet: bool, live: bool) -> Shown:
    """The display of a control run: nothing when quiet, a panel when ``live``, else plain lines."""
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
        self._progress = Position()
        self._head = self._owed = False

    def __call__(self, event: Event) -> None:
        """Print what is due."""
        self._progress.take(event)
        self.run, self.step = self._progress.run, self._progress.step
        if isinstance(event, Message):
            if event.level == "warning":
                print(event, file=sys.stderr, flush=True)
            elif self._rows:
                self._print(event.text)
        elif self._rows and isinstance(event, Started):
            self._print("\n".join(event.lines))
        elif self._rows and isinstance(event, Updated):
            self._owed = True
            share = self._progress.total_steps / self._rows
            if self.step >= self._next:
                self._next = (math.floor(self.step / share) + 1) * share
                self._row()
        elif isinstance(event, Finished) and self._owed:
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
        self._progress = Position()
        self._live: Any = None
        self._painted = -math.inf

    def __call__(self, event: Event) -> None:
        """Take the event in; repaint when the last painting is old enough."""
        self._progress.take(event)
        self.run, self.step = self._progress.run, self._progress.step
        if isinstance(event, Message):
            self._live.console.print(str(event), markup=False, highlight=False)
        elif isinstance(event, Started):
            for line in event.lines:
                self._live.console.print(line, markup=False, highlight=False)
        now = time.monotonic()
        if now - self._painted >= SECONDS_BETWEEN_PAINTS or isinstance(event, Started | Finished):
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


class Position:
    """The position and newest figures of a control run, and the time left at the speed so far."""

    def __init__(self) -> None:
        self.run: str | None = None
        self.title = ""
        self.step = self.total_steps = 0
        self.metrics: dict[str, Any] = {}
        self.returns: list[float] = []
        self.length: float | None = None
        self.evaluation: tuple[float, float] | None = None
        self._start_step, self._start_time = 0, time.monotonic()

    def take(self, event: Event) -> None:
        """Remember what is displayed."""
        if isinstance(event, Started):
            settings = event.settings
            self.title = f"{settings['env']} · {settings['algorithm']} · seed {settings['seed']}"
            self.run = event.run_dir
            self.step = self._start_step = event.step
            self.total_steps = event.total_steps
            self._start_time = time.monotonic()
        elif isinstance(event, Updated):
            self.step, self.total_steps = event.step, event.total_steps
            self.metrics = event.metrics
            value = self.metrics.get("rollout/ep_rew_mean", math.nan)
            if _finite(value):
                self.returns.append(float(value))
                self.length = self.metrics.get("rollout/ep_len_mean")
        elif isinstance(event, Evaluated):
            self.evaluation = (event.metrics["eval/mean_reward"], event.metrics["eval/std_reward"])

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


# ------------------------------------------------------------------------------- runs of language models

SAMPLES = 3  # responses of a table: the best score, the middle and the worst
ROWS = 20  # lines of a run that is not watched on a terminal


class Column(NamedTuple):
    """One number of the display: its heading, its metric, how it is written."""

    head: str
    metric: str
    form: str


ALIGN = (
    Column("score", "objective/scores", "{:.3f}"),
    Column("KL", "objective/kl", "{:.2f}"),
    Column("length", "objective/response_length", "{:.1f}"),
    Column("EOS", "objective/eos_fraction", "{:.0%}"),
    Column("distinct", "objective/distinct_2", "{:.2f}"),
    Column("clipped", "train/clip_fraction", "{:.1%}"),
    Column("explained", "train/explained_variance", "{:.2f}"),
    Column("gold", "eval/gold", "{:.3f}"),
)
SFT = (Column("loss", "sft/loss", "{:.3f}"), Column("held out", "sft/held_out_loss", "{:.3f}"))
REWARD = (
    Column("loss", "reward/loss", "{:.3f}"),
    Column("accuracy", "reward/accuracy", "{:.1%}"),
    Column("held out", "reward/held_out_accuracy", "{:.1%}"),
)


class Display:
    """The display of a language run, a listener and a context around the run: a progress bar on a terminal,
    a few aligned lines elsewhere. ``run`` is its folder, ``step`` its position.
    """

    def __init__(
        self,
        columns: tuple[Column, ...],
        what: str,
        stream: TextIO,
        *,
        quiet: bool = False,
        live: bool = False,
    ) -> None:
        self.run: str | None = None
        self.step = self.total = 0
        self._columns, self._what, self._stream, self._quiet = columns, what, stream, quiet
        self._live, self._task = live and not quiet, None
        self._bar: Any = None
        self._next, self._begin, self._head = 0.0, time.monotonic(), False
        self._seen: dict[str, float] = {}

    def __call__(self, event: Event) -> None:
        """Show what is due."""
        if isinstance(event, Started):
            self.run, self.total = event.run_dir, event.total_steps
            self.step, self._begin = event.step, time.monotonic()
            for line in event.lines:
                self._say(line)
        elif isinstance(event, Message):
            (self._warn if event.level == "warning" else self._say)(str(event))
        elif isinstance(event, Updated):
            self._update(event)
        elif isinstance(event, Samples) and not self._quiet:
            from tightrope.language.alignment.samples import print_samples, spread

            rows, title = spread(event.rows, SAMPLES), f"after {event.step:,} responses"
            console = None if self._bar is None else self._bar.console
            print_samples(rows, self._stream, title=title, console=console)

    def _update(self, event: Updated) -> None:
        self.step, self.total = event.step, event.total_steps
        self._seen |= {k: v for k, v in event.metrics.items() if v is not None}
        if self._bar is not None:
            self._bar.update(self._task, completed=self.step, total=self.total, text=self._numbers("  "))
        elif not self._quiet and (self.step >= self._next or self.step >= self.total):
            self._next = self.step + self.total / ROWS
            if not self._head:
                heads = "".join(f"{column.head:>11}" for column in self._columns)
                self._say(f"{self._what:>10}{'%':>6}{heads}{'left':>8}")
                self._head = True
            cells = "".join(f"{self._cell(column):>11}" for column in self._columns)
            share = 100 * self.step / max(1, self.total)
            self._say(f"{self.step:>10,}{share:>6.0f}{cells}{self._left():>8}")

    def _cell(self, column: Column) -> str:
        value = self._seen.get(column.metric)
        return "-" if value is None or not math.isfinite(value) else column.form.format(value)

    def _numbers(self, gap: str) -> str:
        found = [(column.head, self._cell(column)) for column in self._columns]
        return gap.join(f"{head} {cell}" for head, cell in found if cell != "-")

    def _left(self) -> str:
        if not self.step:
            return "-"
        seconds = (time.monotonic() - self._begin) * (self.total - self.step) / self.step
        return f"{int(seconds // 60)}:{int(seconds % 60):02d}"

    def _say(self, text: str) -> None:
        if self._quiet:
            return
        if self._bar is not None:
            self._bar.console.print(text, markup=False, highlight=False)
        else:
            print(text, file=self._stream, flush=True)

    def _warn(self, text: str) -> None:
        if self._bar is not None:
            self._bar.console.print(text, markup=False, highlight=False, style="yellow")
        else:
            print(text, file=sys.stderr, flush=True)

    def __enter__(self) -> Display:
        if self._live:
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

            columns = (
                BarColumn(24),
                MofNCompleteColumn(),
                TimeRemainingColumn(),
                TextColumn("{task.fields[text]}"),
            )
            self._bar = Progress(*columns, console=Console(file=self._stream))
            self._task = self._bar.add_task(self._what, total=None, text="")
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()
