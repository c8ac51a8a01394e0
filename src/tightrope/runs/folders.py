"""Run folders by name: a new one, and the one that the user probably meant."""

from __future__ import annotations

import difflib
import time
from collections.abc import Mapping
from pathlib import Path

from tightrope.runs.lock import NAME

# the setting by which the settings.json of a command is recognised
OWN_FIELDS = {"sft": "on_completions", "reward": "demonstrations", "align": "max_new_tokens", "train": "env"}
USES = {
    "train": "tightrope evaluate, record and resume, and tightrope.load in Python",
    "sft": "tightrope resume; its model is in the folder `model`",
    "reward": "tightrope resume; its model is in the folder `model`, and align takes it as --reward",
    "align": "tightrope sample and resume; its model is in the folder `model`",
}


def command_of(settings: Mapping[str, object]) -> str | None:
    """The command whose settings these are; None when no field tells."""
    return next((name for name, field in OWN_FIELDS.items() if field in settings), None)


def require_kind(path: Path, settings: Mapping[str, object], command: str) -> None:
    """ValueError when these settings are of a run of another command; it names what can read that run."""
    found = command_of(settings) or command
    if found != command:
        raise ValueError(
            f"{path} is a run of tightrope {found}, expected one of tightrope {command}. It is whole: use "
            f"{USES[found]}."
        )


def require_free(path: Path) -> None:
    """ValueError unless a run can be created here: the path is free, or a folder with only a lock in it."""
    if path.exists() and not path.is_dir():
        raise ValueError(f"run_dir {path} is there and is not a folder. Give another --run-dir.")
    if path.is_dir() and any(entry.name != NAME for entry in path.iterdir()):
        raise ValueError(
            f"run_dir {path} exists and is not empty; a run is never overwritten. "
            f"Give another --run-dir, delete the folder, or continue with: tightrope resume {path}"
        )


def fresh(parent: Path, name: str) -> Path:
    """A new folder named after the current second; a number is added if the name is taken."""
    stem = f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"
    for number in range(1, 1000):
        path = parent / (stem if number == 1 else f"{stem}-{number}")
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            continue
        return path
    raise ValueError(f"{parent} already holds a thousand runs named {stem}. Give --run-dir.")


def why_not(path: Path) -> str:
    """Why a path is not a run folder, and which similar one is."""
    reason = "it is not a folder." if path.exists() else "there is no such folder."
    reason = "it holds no settings.json." if path.is_dir() else reason
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
