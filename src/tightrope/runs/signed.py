"""settings.json contains the SHA-256 of the settings in it, so that a resume notices any change."""

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
    """The settings without their hash."""
    return {name: value for name, value in found.items() if name != KEY}


def require_own(file: Path, found: dict[str, Any]) -> None:
    """ValueError if the content of ``file`` does not match its hash; a file without a hash is accepted."""
    if KEY in found and found[KEY] != json_sha256(unsigned(found)):
        raise ValueError(
            f"{file} is not as the run wrote it: its sha256 belongs to other settings, so the "
            f"result would be that of another run. Restore it, or start a new run: --settings {file}"
        )


def read_settings(path: Path, *, own: bool) -> dict[str, Any]:
    """The settings in a file, without their hash. ValueError if they are not an object, and with ``own`` if
    they are not as the run wrote them.
    """
    settings = read_json(path)
    if not isinstance(settings, dict):
        raise ValueError(f"{path} holds {type(settings).__name__}, expected an object.")
    if own:
        require_own(path, settings)
    return unsigned(settings)
