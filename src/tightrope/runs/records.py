"""JSON that every reader accepts: plain types, no NaN literal, files that are whole or absent."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any


def plain(value: Any) -> Any:
    """``value`` in JSON's own types.

    Numbers and arrays of numpy and torch become Python's, paths and other objects text, and a float that is
    not finite becomes None: NaN and Infinity are not JSON, and many readers refuse a file that holds one.
    """
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    return str(value)


def dumps(value: Any, indent: int | None = None) -> str:
    """One JSON text without NaN literals; on a single line unless ``indent`` is given."""
    try:
        return json.dumps(value, allow_nan=False, indent=indent, ensure_ascii=False)
    except (TypeError, ValueError):  # numbers of numpy or torch, paths, floats that are not finite
        pass
    return json.dumps(plain(value), allow_nan=False, indent=indent, ensure_ascii=False)


def write_json(path: Path, value: Any) -> None:
    """Write one JSON file so that a reader sees the old one or the new one whole, also after a crash."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with open(temporary, "w", encoding="utf-8") as file:
            file.write(dumps(value, indent=2) + "\n")
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def read_json(path: Path) -> Any:
    """The content of a JSON file. Raises ValueError naming the file where it is not JSON (NaN literals are
    not).
    """

    def refuse(literal: str) -> None:
        raise ValueError(f"{literal} is not JSON")

    try:
        return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not readable as JSON ({error}).") from error


def read_lines(path: Path) -> list[dict[str, Any]]:
    """The objects of a .jsonl file, an empty list where there is no file.

    A last line that was torn by a crash is left out; a torn line in the middle raises ValueError with its
    number.
    """
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8", errors="replace").split("\n")
    rows = []
    for number, line in enumerate(lines, start=1):
        if not line:
            continue
        try:
            row = json.loads(line)
            if not isinstance(row, dict):
                raise ValueError("not an object")
        except ValueError as error:
            if number == len(lines):  # no newline behind it: the writer was stopped in the middle
                break
            raise ValueError(f"{path} line {number} is not a JSON object ({error}).") from error
        rows.append(row)
    return rows


def sync_folder(folder: Path) -> None:
    """Make the names in a folder durable, where the platform knows how (fsync of a directory)."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:  # Windows cannot open a folder
        return
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
