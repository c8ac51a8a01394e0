"""The training loop: update -> evaluate -> record -> report -> save, until the budget is spent; and where a
run continues, at its newest checkpoint, with the changes of settings that were made before it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import shlex
import time
from collections.abc import Iterator
from typing import Any

from tightrope.runs import signals
from tightrope.runs.checkpoint import understood
from tightrope.runs.durable import CannotWrite
from tightrope.runs.retention import Checkpoint, steps_in
from tightrope.runs.run import Run
from tightrope.training.events import Change, Evaluated, Finished, Listeners, Samples, Started, Updated
from tightrope.training.learner import Learner, Update, change, update_of
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


@contextlib.contextmanager
def _naming_the_position(learner: Learner) -> Iterator[None]:
    """A signal, also a second one, tells what the run had done by then."""
    try:
        yield
    except signals.Stopped as stop:
        stop.position = learner.position
        raise


class _Loop:
    """A learner, its run folder and its listeners."""

    def __init__(self, learner: Learner, run: Run, listeners: Listeners) -> None:
        self.learner = learner
        self.run = run
        self.listeners = listeners
        self.saved, self.saved_at = learner.position, time.monotonic()  # the position that a resume begins at
        self.told_of_handlers = False

    def train(self) -> dict[str, Any]:
        if self.learner.settings.tensorboard:
            self.listeners.add(TensorBoard())
        with signals.stoppable(), _naming_the_command(self.run), _naming_the_position(self.learner):
            self._keep_handlers()
            try:
                summary = self._train()
            except KeyboardInterrupt as stop:
                self._save_and_leave(stop)
                raise
        self.listeners(Finished(summary))
        return summary

    def _train(self) -> dict[str, Any]:
        learner, run = self.learner, self.run
        self._start()
        updates, stop = self._updates(), self._requests()
        while not stop:
            with signals.uninterrupted():
                learner.pending = next(updates, None)
            if learner.pending is None:
                break
            update = learner.pending
            self._keep_handlers()
            self._record(update)
            # before the save, so that a resumed run knows the changes made before its checkpoint
            stop = self._requests()
            if not (stop or learner.complete) and (update.on_grid or self._clock_says_so()):
                self._save()  # the end has its own
        self._conclude()
        self._save(final=True)
        summary = learner.finish(run)
        run.finish(summary)
        return summary

    def _start(self) -> None:
        learner, run = self.learner, self.run
        lines = tuple(learner.begin())
        self.listeners(Started(str(run.path), run.settings, learner.position, learner.total, lines))
        if not learner.position and (first := learner.evaluate(None)):
            run.record(0, 0.0, first)
            self._evaluated(0, first)

    def _updates(self) -> Iterator[Update]:
        """The learner's updates, timed; after a NaN or an infinity, those from the newest checkpoint on.
        First the one that was not yet recorded there.
        """
        learner = self.learner
        while True:
            if learner.pending is not None:
                yield learner.pending
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
        restore_rows(learner, run, point)
        self.saved = learner.position
        reason = str(error).splitlines()[0]
        self.listeners.warn(
            f"{reason} Going back to the checkpoint of step {learner.position}, "
            f"{learner.rollbacks} of {limit} times at most (max_rollbacks), with other random numbers from "
            "there."
        )

    def _record(self, update: Update) -> None:
        """Evaluate if it is due, write the rows, send the events. A run that is stopped in the evaluation
        saves the update as pending, and its resume records it.
        """
        learner, run, step = self.learner, self.run, update.step
        metrics = update.metrics
        if learner.rollbacks:
            metrics["train/rollbacks"] = float(learner.rollbacks)
        metrics["time/seconds"] = learner.seconds
        found = learner.evaluate(update)
        self._keep_handlers()
        self._evaluated(step, found)
        with signals.uninterrupted():
            run.record_episodes(
                {"step": step, "return": r, "length": n, "terminated": t, "seed": seed}
                | ({"after": after} if after else {})
                for (r, n, t), (seed, after) in zip(update.episodes, update.seeds, strict=True)
            )
            recorded = run.record(step, learner.seconds, metrics | found)
            run.record_samples(update.samples)
            learner.pending = None
        self.listeners(Updated(step, learner.total, learner.seconds, recorded))
        if update.on_grid and update.samples:
            self.listeners(Samples(step, update.samples))

    def _conclude(self) -> None:
        """The final figures. They are also a row of the metrics, after those of updates, which have a time; a
        run that was finished when it was resumed has it already.
        """
        learner, found = self.learner, self.learner.conclude()
        rows = self.run.read_metrics() if found else []
        if rows and "time/seconds" in rows[-1]:
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

    def _clock_says_so(self) -> bool:
        minutes = self.learner.settings.checkpoint_minutes
        return minutes is not None and time.monotonic() - self.saved_at >= 60 * minutes

    def _save(self, *, final: bool = False) -> None:
        """A checkpoint of the present state; CannotWrite where ``final`` and the disk refuses it."""
        learner = self.learner
        with signals.uninterrupted():
            tensors, state = learner.snapshot()
            if learner.pending is not None:
                state["pending"] = dataclasses.asdict(learner.pending)
            saved = self.run.save(
                learner.position,
                tensors,
                state,
                keep=learner.settings.keep_checkpoints,
                warn=self.listeners.warn,
                merit=learner.merit,
                final=final,
            )
            self.saved, self.saved_at = learner.position if saved else self.saved, time.monotonic()

    def _save_and_leave(self, stop: KeyboardInterrupt) -> None:
        """After a signal the learner is as it was after its newest update: save that, unless a checkpoint
        holds it. A second signal leaves at once.
        """
        step = self.learner.position
        if not signals.answer() or step == self.saved:
            return
        try:
            self._save(final=True)
        except CannotWrite as error:
            self.listeners.warn(f"Step {step:,} is not saved: {error.what} {error.advice}.")
        else:
            stop.add_note(f"Saved at step {step:,} in {self.run.path}, which can be resumed.")

    def _keep_handlers(self) -> None:
        """Code of the user's may replace the handlers of signals; then no signal would save any more."""
        replaced = signals.take_back()
        if replaced and not self.told_of_handlers:
            self.told_of_handlers = True
            self.listeners.warn(
                f"An environment, a reward function or a library has replaced the handler of "
                f"{' and '.join(replaced)}. It was put back, so that a signal still saves the run."
            )


def newest_point(run: Run, listeners: Listeners) -> Checkpoint | None:
    """The newest usable checkpoint; None if the run has saved nothing yet."""
    if steps_in(run.checkpoints):
        return run.resume_point(listeners.warn, listeners.info)
    if run.read_metrics():
        listeners.warn(f"{run.path} has rows and no checkpoint; it begins at step 0 again.")
    return None


def continue_from(learner: Learner, run: Run, point: Checkpoint | None) -> None:
    """Bring the run folder to the position of the learner, ``point`` (None: the beginning). Later rows are
    removed, and settings.json gets the present settings.
    """
    run.rewind(point)
    run.update_settings(learner.settings.to_json())
    restore_rows(learner, run, point)


def restore_rows(learner: Learner, run: Run, point: Checkpoint | None) -> None:
    """Apply exactly the changes of settings that the run has recorded; and the update of ``point`` that it
    had not recorded yet is pending again.
    """
    learner.changes.clear()
    with understood(run.path):
        for row in run.read_changes():
            change(learner, row["setting"], row["value"])
    pending = None if point is None else point.state.get("pending")
    with understood(run.path if point is None else point.folder):
        learner.pending = None if pending is None else update_of(pending)
