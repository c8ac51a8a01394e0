"""A run folder: settings, metrics, episodes, checkpoints, the best policy, videos, the summary."""

from __future__ import annotations

import contextlib
import errno
import re
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from tightrope.metrics import table as metrics
from tightrope.runs import checkpoint, durable, growing, retention, signals, versions
from tightrope.runs.checkpoint import CheckpointError
from tightrope.runs.durable import CannotWrite, sync_folder, writing
from tightrope.runs.folders import fresh, require_free, why_not
from tightrope.runs.lock import WriterLock
from tightrope.runs.records import (
    RECORDS,
    Recorder,
    cut_back,
    disagreement,
    dumps,
    plain,
    read_lines,
    read_settings,
    refuse_links,
    signed,
    write_json,
)
from tightrope.runs.retention import Checkpoint, marks_of

if TYPE_CHECKING:
    from torch import Tensor


class Run:
    """The files of one run, made by `create` or `open`.

    ``settings`` is the resolved content of settings.json. A run has at most one writer: methods that write
    take the lock first (see `lock`). Reading is possible at any time.
    """

    def __init__(self, path: Path, settings: dict[str, Any]) -> None:
        self.path = path
        self.settings = settings
        self._files: dict[str, Recorder] = {}
        self._lock: WriterLock | None = None
        self._costs: dict[str, float] = {}
        self._held: dict[str, int] = {}  # rows of tensors that grow, see growing.py, in their file
        self._large = growing.SMALL  # the size at which that file is made smaller
        self._new_name = False  # a record file was created and its name is not yet durable

    @classmethod
    def create(
        cls, run_dir: str | Path | None, settings: Mapping[str, object], name: str, home: Path | None = None
    ) -> Run:
        """A new run folder with settings.json in it.

        ``run_dir`` None: ``runs/<name>-<yyyymmdd-hhmmss>``. ``home``: where relative paths begin (None: in
        the working directory); the path is absolute from here on, whatever user code does with the directory.
        Nothing is ever overwritten: a folder that exists and is not empty raises ValueError before anything
        is written.
        """
        if run_dir == "":
            raise ValueError("run_dir is empty. Give the path of a new folder, or leave it out.")
        path = (Path.cwd() if home is None else home) / ("runs" if run_dir is None else run_dir)
        with writing(path):
            if run_dir is None:
                path = fresh(path, re.sub(r"[^\w.-]+", "-", name))
            else:
                require_free(path)
                durable.make_folders(path)
        run = cls(path, plain(settings)).lock()
        require_free(path)  # no other process took it before we had the lock
        write_json(path / "settings.json", signed(run.settings))
        return run

    @classmethod
    def open(cls, path: str | Path, *, own: bool = False) -> Run:
        """An existing run folder. Raises ValueError if there is none, naming a similar one, and for links
        inside it.

        ``own``: for a caller that continues the run. The writer's lock is taken before anything is read, so
        that no other writer changes what was read. Raises RunInUse if there is one, and ValueError if
        settings.json is not as the run wrote it.
        """
        path = Path(path)
        if not (path / "settings.json").is_file():
            raise ValueError(f"{path} is not a run folder: {why_not(path)}")
        path = path.absolute()
        refuse_links(path)
        run = cls(path, {})
        if own:
            run.lock()
        try:
            run.settings = read_settings(path / "settings.json", own=own)
        except BaseException:
            run.close()
            raise
        return run

    def lock(self) -> Run:
        """Become the only writer, until `close` or the end of the process; no effect if it already is.

        Raises RunInUse, which names the present writer.
        """
        if self._lock is None:
            self._lock = WriterLock(self.path)
        return self

    @property
    def checkpoints(self) -> Path:
        """The folder of the checkpoints, one folder per step; see `checkpoint_folder`."""
        return self.path / "checkpoints"

    @property
    def best(self) -> Path:
        """The checkpoint folder of the policy with the highest eval/mean_reward."""
        return self.path / "best"

    @property
    def videos(self) -> Path:
        """The folder of recordings; made by `record_run`."""
        return self.path / "videos"

    def checkpoint_folder(self, step: int) -> Path:
        """The folder of the checkpoint of this step: ``checkpoints/step-000000060000``."""
        return checkpoint.step_folder(self.checkpoints, step)

    def newest(self) -> Checkpoint:
        """Read the newest valid checkpoint, without the lock. Damaged ones are skipped with a
        warning. Raises CheckpointError. Where the file of tensors that grow is damaged, it has none.
        """
        point = retention.valid(self.checkpoints)
        with contextlib.suppress(CheckpointError):
            self._add_growing(point)
        return point

    def _add_growing(self, point: Checkpoint) -> None:
        """Read the tensors that grow; a checkpoint of an older version, or without any, stays as it is."""
        if wanted := point.state.get("growing"):
            with checkpoint.understood(point.folder):
                point.tensors[growing.GROUP] = growing.gathered(self.path / growing.FILE, wanted)

    def record(self, step: int, seconds: float, values: dict[str, float]) -> dict[str, float]:
        """Append the metrics of one update, and the cost of the checkpoint before it; returns both. Every
        name must be declared; floats that are not finite become null. Raises CannotWrite, like all writing
        methods.
        """
        values, self._costs = {**values, **self._costs}, {}
        metrics.check_names(values)
        self._append("metrics.jsonl", [{"step": step, "seconds": seconds, **values}])
        return values

    def record_episodes(self, rows: Iterable[Mapping[str, object]]) -> None:
        """Append finished episodes, one object each (step, return, length, ...), in one write."""
        self._append("episodes.jsonl", rows)

    def record_samples(self, rows: Iterable[Mapping[str, object]]) -> None:
        """Append responses of a language model, one object each (step, prompt, response, scores, ...)."""
        self._append("samples.jsonl", rows)

    def record_changes(self, rows: Iterable[Mapping[str, object]]) -> None:
        """Append changes of settings during the run, one object each (step, setting, value)."""
        self._append("changes.jsonl", rows)

    def _append(self, name: str, rows: Iterable[Mapping[str, object]]) -> None:
        text = "".join(dumps(row) + "\n" for row in rows)
        if text:
            self._recorder(name).append(text)

    def _recorder(self, name: str) -> Recorder:
        self.lock()
        if name not in self._files:
            self._new_name = self._new_name or not (self.path / name).exists()
            self._files[name] = Recorder(self.path / name)
        return self._files[name]

    def read_metrics(self) -> list[dict[str, Any]]:
        """The rows of metrics.jsonl so far; a line cut off by a crash is left out."""
        return read_lines(self.path / "metrics.jsonl")

    def read_episodes(self) -> list[dict[str, Any]]:
        """The rows of episodes.jsonl so far; a line cut off by a crash is left out."""
        return read_lines(self.path / "episodes.jsonl")

    def read_changes(self) -> list[dict[str, Any]]:
        """The rows of changes.jsonl so far; a line cut off by a crash is left out."""
        return read_lines(self.path / "changes.jsonl")

    def save(
        self,
        step: int,
        tensors: dict[str, dict[str, Tensor]],
        state: Mapping[str, object],
        *,
        keep: int | None,
        warn: Callable[[str], None],
        merit: float | None = None,
        final: bool = False,
    ) -> bool:
        """Save a checkpoint at ``step`` and verify it; returns whether it was written. Then all but the
        newest ``keep`` are deleted, except the one with the highest ``merit``.

        The record files are on the disk before the checkpoint is visible; it stores their lengths. If the
        disk refuses to write, a warning is sent and training continues; for the ``final`` checkpoint
        CannotWrite is raised. ``settings``, ``records`` and ``merit`` are added to ``state``. A signal takes
        effect at the end.
        """
        with signals.uninterrupted("the save under way"):
            return self._save(step, tensors, state, keep=keep, warn=warn, merit=merit, final=final)

    def _save(
        self,
        step: int,
        tensors: dict[str, dict[str, Tensor]],
        state: Mapping[str, object],
        *,
        keep: int | None,
        warn: Callable[[str], None],
        merit: float | None,
        final: bool,
    ) -> bool:
        self.lock()
        self.require_there()
        folder, clock = self.checkpoint_folder(step), time.perf_counter()
        try:
            with writing(folder):
                self._clean()
                whole = {name: group for name, group in tensors.items() if name != growing.GROUP}
                added: dict[str, Any] = {"merit": merit}
                if growing.GROUP in tensors:
                    added["growing"] = self._grow(tensors[growing.GROUP])
                added["records"] = self._sync()
                checkpoint.save(folder, whole, {"settings": self.settings, **state, **added})
                self._read_back(folder)
        except CannotWrite as error:
            if final:
                raise
            warn(f"No checkpoint at step {step:,}: {error.what} {error.advice}. Training continues.")
            return False
        try:
            retention.prune(self.checkpoints, keep)
            self._drop_rows()
        except OSError as error:
            warn(f"What is no longer needed cannot be deleted: {error}. Check {self.checkpoints}.")
        size = sum(path.stat().st_size for path in folder.iterdir())
        seconds = time.perf_counter() - clock
        self._costs = {"time/checkpoint_seconds": seconds, "time/checkpoint_megabytes": size / 1e6}
        return True

    def _grow(self, tensors: dict[str, Tensor]) -> dict[str, tuple[int, str]]:
        """Append what is new of the tensors that grow, durably; returns their marks."""
        self._append(growing.FILE, growing.lines(tensors, self._held))
        if growing.FILE in self._files:
            self._files[growing.FILE].sync()
        marks = growing.marks(tensors)
        self._held = {name: length for name, (length, _) in marks.items()}  # others do not come again
        return marks

    def _drop_rows(self) -> None:
        """Drop the rows on which no checkpoint counts any more, once their file has doubled."""
        path = self.path / growing.FILE
        if growing.FILE not in self._files or path.stat().st_size < self._large:
            return
        names = set[str]()
        for folder in retention.steps_in(self.checkpoints):
            with contextlib.suppress(CheckpointError):  # damaged: nothing will continue there
                names |= checkpoint.load_state(folder).get("growing", {}).keys()
        self._files.pop(growing.FILE).close()
        self._large = max(growing.SMALL, 2 * growing.drop_others(path, names))

    def require_there(self) -> None:
        """CannotWrite when the folder was deleted or renamed: a save would make a part of it again."""
        if not (self.path / "settings.json").is_file():
            raise CannotWrite(self.path, FileNotFoundError(errno.ENOENT, "the run folder is gone"))

    def _sync(self) -> dict[str, Any]:
        """Make all records durable; returns the marks of the files."""
        there = [name for name in RECORDS if name in self._files or (self.path / name).exists()]
        marks = {name: self._recorder(name).sync() for name in there}
        if self._new_name:
            sync_folder(self.path)
            self._new_name = False
        return marks

    def _read_back(self, folder: Path) -> None:
        try:
            checkpoint.verify(folder)
        except CheckpointError as error:
            durable.remove(folder)
            raise CannotWrite(folder, error) from error

    def _clean(self) -> None:
        for parent in (self.path, self.checkpoints):
            durable.remove_leftovers(parent)

    def resume_point(self, warn: Callable[[str], None], info: Callable[[str], None]) -> Checkpoint:
        """Where the run can continue: the newest checkpoint that is valid and needs no more rows than the
        record files hold. ``warn`` gets what was passed over and what has changed since, ``info`` who left
        the run without an end. Raises CheckpointError where there is none.
        """
        self.lock()
        assert self._lock is not None
        if self._lock.left_by:
            info(f"the run was left without an end by {self._lock.left_by}")
        self._put_aside_a_damaged_best(warn)
        point = retention.valid(self.checkpoints, warn, self._check_files)
        manifest = checkpoint.read_manifest(durable.present(point.folder))
        if changed := versions.version_changes(manifest.get("versions")):
            warn(f"{changed} since the checkpoint: the run continues, but its last bits may differ.")
        return point

    def _put_aside_a_damaged_best(self, warn: Callable[[str], None]) -> None:
        """Rename it so that it can be saved again: `checkpoint.save` replaces only valid checkpoints."""
        if not durable.present(self.best).is_dir():
            return
        try:
            checkpoint.verify(self.best)
        except CheckpointError as error:
            warn(f"The best policy is lost, its folder renamed to unusable-best: {error}")
            durable.put(durable.present(self.best), self.path / "unusable-best")

    def _check_files(self, point: Checkpoint) -> None:
        """Compare and read what it counts on outside its folder."""
        for name, mark in marks_of(point).items():
            if wrong := disagreement(self.path / name, mark):
                raise CheckpointError(
                    f"{wrong}. Restore the file. {point.folder} itself is intact: tightrope.load "
                    "and evaluate read it."
                )
        self._add_growing(point)

    def rewind(self, point: Checkpoint | None) -> None:
        """Prepare to continue from ``point`` (None: from the beginning): remove the rows recorded after it,
        and incomplete saves. Newer checkpoints, which cannot be used, get a name that begins with
        ``unusable-``.

        Otherwise a resumed run would list the updates between the checkpoint and the crash twice.
        """
        self.lock()
        self._close_files()
        grown = {} if point is None else point.state.get("growing") or {}
        self._held = {name: length for name, (length, _) in grown.items()}
        with writing(self.path):
            self._clean()
            for folder in retention.steps_in(self.checkpoints):
                if checkpoint.step_of(folder) > (-1 if point is None else checkpoint.step_of(point.folder)):
                    durable.put(folder, folder.with_name(f"unusable-{folder.name}"))
            marks = {} if point is None else marks_of(point)
            for name in RECORDS:
                if (self.path / name).exists():
                    cut_back(self.path / name, marks.get(name, {"bytes": 0})["bytes"])
            (self.path / "summary.json").unlink(missing_ok=True)
            sync_folder(self.path)

    def update_settings(self, settings: Mapping[str, object]) -> None:
        """Replace settings.json: a resumed run may have another budget."""
        self.lock()
        self.settings = plain(settings)
        write_json(self.path / "settings.json", signed(self.settings))

    def finish(self, summary: Mapping[str, object]) -> None:
        """Write summary.json, which marks a complete run, and close the files."""
        self.lock()
        write_json(self.path / "summary.json", summary)
        self.close()

    def close(self) -> None:
        """Close the files and release the lock; recording again reopens them."""
        self._close_files()
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def _close_files(self) -> None:
        for file in self._files.values():
            file.close()
        self._files.clear()

    def __enter__(self) -> Run:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
