"""A run folder: settings, metrics, episodes, checkpoints, the best policy, videos, the summary."""

from __future__ import annotations

import difflib
import math
import os
import re
import time
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from tightrope.runs import checkpoint, metrics
from tightrope.runs.records import dumps, plain, read_json, read_lines, write_json


class Run:
    """The files of one run. Made by `create` or `open`; nothing is written before something is recorded.

    ``settings`` is the resolved content of settings.json. Of a run there is one writer; readers may come at
    any time.
    """

    def __init__(self, path: Path, settings: dict[str, Any], tensorboard: Any = None) -> None:
        self.path = path
        self.settings = settings
        self._tensorboard = tensorboard
        self._files: dict[str, IO[str]] = {}

    @classmethod
    def create(
        cls, run_dir: str | Path | None, settings: dict[str, Any], name: str, *, tensorboard: bool = False
    ) -> Run:
        """A fresh run folder with settings.json in it.

        ``run_dir`` None: ``runs/<name>-<yyyymmdd-hhmmss>``. Nothing is ever overwritten: a folder that is
        there and not empty raises ValueError, and so does ``tensorboard`` without its package, before
        anything is written.
        """
        writer_class = _summary_writer() if tensorboard else None
        if run_dir is None:
            path = _fresh(Path("runs"), re.sub(r"[^\w.-]+", "-", name))
        else:
            path = Path(run_dir)
            _make(path)
        settings = plain(settings)
        write_json(path / "settings.json", settings)
        return cls(path, settings, writer_class(str(path / "tensorboard")) if writer_class else None)

    @classmethod
    def open(cls, path: str | Path, *, tensorboard: bool = False) -> Run:
        """An existing run folder. Raises ValueError where there is none, naming a near one."""
        path = Path(path)
        if not (path / "settings.json").is_file():
            raise ValueError(f"{path} is not a run folder: {_why_not(path)}")
        settings = read_json(path / "settings.json")
        if not isinstance(settings, dict):
            raise ValueError(f"{path / 'settings.json'} holds {type(settings).__name__}, expected an object.")
        return cls(path, settings, _summary_writer()(str(path / "tensorboard")) if tensorboard else None)

    @property
    def checkpoints(self) -> Path:
        """Where the checkpoints lie, one folder a step; see `checkpoint_folder`."""
        return self.path / "checkpoints"

    @property
    def best(self) -> Path:
        """The checkpoint folder of the policy with the highest eval/mean_reward."""
        return self.path / "best"

    @property
    def videos(self) -> Path:
        """Where recordings lie; made by whoever records."""
        return self.path / "videos"

    def checkpoint_folder(self, step: int) -> Path:
        """Where the checkpoint of this step belongs: ``checkpoints/step-000000060000``."""
        return checkpoint.step_folder(self.checkpoints, step)

    def newest_checkpoint(self) -> Path:
        """The newest valid checkpoint, damaged ones passed over with a warning. Raises CheckpointError."""
        return checkpoint.newest(self.checkpoints)

    def record(self, step: int, seconds: float, values: dict[str, float]) -> None:
        """Append the metrics of one update: every name must be declared, floats that are not finite become
        null.
        """
        metrics.check_names(values)
        self._append("metrics.jsonl", [{"step": step, "seconds": seconds, **values}])
        if self._tensorboard is None:
            return
        for name, value in values.items():
            if value is not None and math.isfinite(value):
                self._tensorboard.add_scalar(name, float(value), step)
        self._tensorboard.flush()

    def record_episodes(self, rows: Iterable[dict[str, Any]]) -> None:
        """Append finished episodes, one object each (step, return, length, ...), in one write."""
        self._append("episodes.jsonl", rows)

    def record_samples(self, rows: Iterable[dict[str, Any]]) -> None:
        """Append responses of a language model, one object each (step, prompt, response, scores, ...)."""
        self._append("samples.jsonl", rows)

    def _append(self, name: str, rows: Iterable[dict[str, Any]]) -> None:
        text = "".join(dumps(row) + "\n" for row in rows)
        if not text:
            return
        if name not in self._files:
            file = open(self.path / name, "a", encoding="utf-8")  # noqa: SIM115 - closed in close()
            self._files[name] = file
        self._files[name].write(text)
        self._files[name].flush()

    def read_metrics(self) -> list[dict[str, Any]]:
        """The rows of metrics.jsonl so far; a line torn by a crash is left out."""
        return read_lines(self.path / "metrics.jsonl")

    def read_episodes(self) -> list[dict[str, Any]]:
        """The rows of episodes.jsonl so far; a line torn by a crash is left out."""
        return read_lines(self.path / "episodes.jsonl")

    def rewind(self, step: int) -> None:
        """Before going on from the checkpoint of ``step``: forget what was recorded after it, and half-
        written saves.

        Without this a resumed run would list the updates between checkpoint and crash twice.
        """
        self._close_files()
        for name in ("metrics.jsonl", "episodes.jsonl", "samples.jsonl"):
            path = self.path / name
            if not path.exists():
                continue
            kept = [row for row in read_lines(path) if row.get("step", 0) <= step]
            temporary = path.with_name(f".{name}")
            with open(temporary, "w", encoding="utf-8") as file:
                file.writelines(dumps(row) + "\n" for row in kept)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        (self.path / "summary.json").unlink(missing_ok=True)
        for parent in (self.path, self.checkpoints):
            checkpoint.remove_leftovers(parent)

    def update_settings(self, settings: dict[str, Any]) -> None:
        """Replace settings.json: a resumed run may go on under another budget."""
        self.settings = plain(settings)
        write_json(self.path / "settings.json", self.settings)

    def finish(self, summary: dict[str, Any]) -> None:
        """Write summary.json, the sign of a run that came to its end, and close the files."""
        write_json(self.path / "summary.json", summary)
        self.close()

    def close(self) -> None:
        """Close what is open; recording again opens it again."""
        self._close_files()
        if self._tensorboard is not None:
            self._tensorboard.close()

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


def _make(path: Path) -> None:
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise ValueError(
            f"run_dir {path} exists and is not empty; a run is never overwritten. "
            f"Give another --run-dir, delete the folder, or go on with: tightrope resume {path}"
        )
    path.mkdir(parents=True, exist_ok=True)


def _fresh(parent: Path, name: str) -> Path:
    """A new folder named after the present second; a number is added when it is taken."""
    stem = f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"
    for number in range(1, 1000):
        path = parent / (stem if number == 1 else f"{stem}-{number}")
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            continue
        return path
    raise ValueError(f"{parent} already holds a thousand runs named {stem}. Give --run-dir.")


def _why_not(path: Path) -> str:
    reason = "it holds no settings.json." if path.is_dir() else "there is no such folder."
    inside = _runs_in(path)
    if inside:
        return f"{reason} Its newest run is {inside[-1]}."
    near = difflib.get_close_matches(path.name, [p.name for p in _runs_in(path.parent)], n=1, cutoff=0.6)
    if near:
        return f"{reason} Did you mean {path.parent / near[0]}?"
    return f"{reason} Give a folder that tightrope train wrote."


def _runs_in(folder: Path) -> list[Path]:
    """The run folders directly in a folder, the newest last."""
    found = [p for p in folder.iterdir() if (p / "settings.json").is_file()] if folder.is_dir() else []
    return sorted(found, key=lambda p: (p / "settings.json").stat().st_mtime)


def _summary_writer() -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise ValueError(
            "TensorBoard files are asked for, and the package tensorboard is not installed. "
            "Install it with: pip install 'tightrope[tensorboard]', or leave --tensorboard away."
        ) from error
    return SummaryWriter
