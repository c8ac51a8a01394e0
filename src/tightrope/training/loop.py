"""The training loop: update -> evaluate -> record -> report -> save, until the budget is spent."""

from __future__ import annotations

import contextlib
import shlex
import time
from collections.abc import Iterator
from typing import Any

from tightrope.runs import signals
from tightrope.runs.durable import CannotWrite
from tightrope.runs.run import Run
from tightrope.training.events import Change, Evaluated, Finished, Listeners, Samples, Started, Updated
from tightrope.training.learner import Learner, Update, change
from tightrope.training.resume import restore_changes
from tightrope.training.tensorboard import TensorBoard


def train(learner: Learner, run: Run, listeners: Listeners) -> dict[str, Any]:
    """Train from the present position to the end; returns the summary that is also in summary.json."""
    return _Loop(learner, run, listeners).train()


@contextlib.contextmanager
def _naming_the_command(run: Run) -> Iterator[None]:
    """An error of the disk names the command that continues this run."""
    try:
        yield
    except CannotWrite as error:
        error.command = shlex.join(["tightrope", "resume", str(run.path)])
        raise


class _Loop:
    """A learner, its run folder and its listeners."""

    def __init__(self, learner: Learner, run: Run, listeners: Listeners) -> None:
        self.learner = learner
        self.run = run
        self.listeners = listeners

    def train(self) -> dict[str, Any]:
        learner, run = self.learner, self.run
        if learner.settings.tensorboard:
            self.listeners.add(TensorBoard())
        with signals.stoppable(), _naming_the_command(run):
            self._start()
            stop, updated = self._requests(), False
            for update in () if stop else self._updates():
                updated = True
                signals.raise_if_stopped()
                self._record(update)
                # before the save, so that a resumed run knows the changes made before its checkpoint
                if self._requests():
                    break
                if update.on_grid and not learner.complete:  # the end has its own save
                    self._save()
            self._conclude(row=updated)
            self._save(final=True)
            summary = learner.finish(run)
            run.finish(summary)
        self.listeners(Finished(summary))
        return summary

    def _start(self) -> None:
        learner, run = self.learner, self.run
        lines = tuple(learner.begin())
        self.listeners(Started(str(run.path), run.settings, learner.position, learner.total, lines))
        if not learner.position and (first := learner.evaluate(None)):
            run.record(0, 0.0, first)
            self._evaluated(0, first)

    def _updates(self) -> Iterator[Update]:
        """The learner's updates, timed; after a NaN or an infinity, those from the newest checkpoint on."""
        learner = self.learner
        while True:
            try:
                clock = time.perf_counter()
                for update in learner.iterate():
                    learner.seconds += time.perf_counter() - clock - update.pause
                    yield update
                    clock = time.perf_counter()
                return
            except FloatingPointError as error:
                self._roll_back(error)

    def _roll_back(self, error: FloatingPointError) -> None:
        """Go back to the newest checkpoint, at most max_rollbacks times in a run; else raise ``error``."""
        learner, run, limit = self.learner, self.run, self.learner.settings.max_rollbacks
        if learner.rollbacks >= limit:
            raise error
        seconds = learner.seconds
        try:
            point = run.resume_point(self.listeners.warn, self.listeners.info)
            run.rewind(point)
            learner.roll_back(point)
        except ValueError as missing:
            raise type(error)(f"{error} There is no checkpoint to go back to: {missing}") from error
        learner.seconds = seconds
        restore_changes(learner, run)
        reason = str(error).splitlines()[0]
        self.listeners.warn(
            f"{reason} Going back to the checkpoint of step {learner.position}, "
            f"{learner.rollbacks} of {limit} times at most (max_rollbacks), with other random numbers from "
            "there."
        )

    def _record(self, update: Update) -> None:
        """Evaluate if it is due, write the rows, send the events."""
        learner, run, step = self.learner, self.run, update.step
        metrics = update.metrics
        if learner.rollbacks:
            metrics["train/rollbacks"] = float(learner.rollbacks)
        metrics["time/seconds"] = learner.seconds
        found = learner.evaluate(update)
        metrics |= found
        self._evaluated(step, found)
        run.record_episodes(
            {"step": step, "return": r, "length": n, "terminated": t} for r, n, t in update.episodes
        )
        recorded = run.record(step, learner.seconds, metrics)
        run.record_samples(update.samples)
        self.listeners(Updated(step, learner.total, learner.seconds, recorded))
        if update.on_grid and update.samples:
            self.listeners(Samples(step, update.samples))

    def _conclude(self, *, row: bool) -> None:
        """The final figures; ``row``: they are also a row of the metrics, which a run that was complete when
        it was resumed has already.
        """
        learner, found = self.learner, self.learner.conclude()
        if found and row:
            self.run.record(learner.position, learner.seconds, found)
        self._evaluated(learner.position, found)

    def _evaluated(self, step: int, found: dict[str, float]) -> None:
        if found:
            self.listeners(Evaluated(step, found))

    def _requests(self) -> bool:
        """Carry out the requests of the listeners; returns whether one of them asked to stop."""
        asked, self.listeners.requests = self.listeners.requests, []
        stop = False
        for request in asked:
            if isinstance(request, Change):
                change(self.learner, request.setting, request.value)
                row = {"step": self.learner.position, "setting": request.setting, "value": request.value}
                self.run.record_changes([row])
            else:
                stop = True
                reason = f": {request.reason}" if request.reason else ""
                self.listeners.info(f"stopped by a listener at step {self.learner.position:,}{reason}")
        return stop

    def _save(self, *, final: bool = False) -> None:
        learner = self.learner
        tensors, state = learner.snapshot()
        self.run.save(
            learner.position,
            tensors,
            state,
            keep=learner.settings.keep_checkpoints,
            warn=self.listeners.warn,
            merit=learner.merit,
            final=final,
        )
