"""settings.json carries the SHA-256 of the rest of it: a resume with another digit is another run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tightrope.runs.checkpoint import json_sha256
from tightrope.runs.records import read_json

KEY = "sha256"


def signed(settings: dict[str, Any]) -> dict[str, Any]:
    """The settings and their hash."""
    return {**settings, KEY: json_sha256(settings)}


def unsigned(found: dict[str, Any]) -> dict[str, Any]:
    """The settings alone."""
    return {name: value for name, value in found.items() if name != KEY}


def require_own(file: Path, found: dict[str, Any]) -> None:
    """ValueError when what was read from ``file`` is not as it was signed; what bears no hash is let pass."""
    if KEY in found and found[KEY] != json_sha256(unsigned(found)):
        raise ValueError(
            f"{file} is not as the run wrote it: its sha256 is that of other settings, and the end would be "
            f"another run's. Put it back, or begin a new run of these settings: --settings {file}"
        )


def read_settings(path: Path, *, own: bool) -> dict[str, Any]:
    """The settings that a file holds, without their hash. ValueError when they are no object, and with
    ``own`` when they are not as the run wrote them.
    """
    settings = read_json(path)
    if not isinstance(settings, dict):
        raise ValueError(f"{path} holds {type(settings).__name__}, expected an object.")
    if own:
        require_own(path, settings)
    return unsigned(settings)
