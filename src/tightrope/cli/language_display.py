"""How a run of the language story shows itself: a progress bar on a terminal, a few aligned lines
elsewhere.
"""

from __future__ import annotations

import math
import sys
import time
from types import TracebackType
from typing import Any, NamedTuple, TextIO

from tightrope.language.alignment.samples import print_samples, spread
from tightrope.training.report import shown

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
    """A `report` of the training loops, as a context around the run; ``run`` and ``step`` say where it
    stands.
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

    def __call__(self, event: str, data: dict[str, Any]) -> None:
        """Show what is due."""
        if event == "start":
            self.run, self.total = str(data["run_dir"]), int(data.get("total_steps", 0))
            self.step, self._begin = int(data.get("step", 0)), time.monotonic()
            for line in data.get("lines", ()):
                self._say(str(line))
        elif event == "line":
            (self._warn if data["warning"] else self._say)(shown(data))
        elif event == "update":
            self._update(data)
        elif event == "samples" and not self._quiet:
            rows, title = spread(data["rows"], SAMPLES), f"after {data['step']:,} responses"
            console = None if self._bar is None else self._bar.console
            print_samples(rows, self._stream, title=title, console=console)

    def _update(self, data: dict[str, Any]) -> None:
        self.step, self.total = int(data["step"]), int(data.get("total_steps", 0))
        self._seen |= {k: v for k, v in data["metrics"].items() if v is not None}
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
