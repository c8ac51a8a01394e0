"""JSON that every reader accepts: plain types, no NaN literal, files that are whole or absent, and files that
grow line by line.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import re
import stat
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tightrope.runs.durable import BLOCK, replace_file, spare_standard_streams, write_all, writing

SIGNATURE = "sha256"  # in settings.json: of the settings in it, so that a resume notices any change
# The files of a run that grow. changes.jsonl: settings that a listener has changed.
RECORDS = ("metrics.jsonl", "episodes.jsonl", "samples.jsonl", "changes.jsonl")


def plain(value: object) -> Any:
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


def figures(saved: Mapping[str, float | None]) -> dict[str, float]:
    """Numbers as they were before `plain` wrote them: null is NaN again."""
    return {name: math.nan if x is None else float(x) for name, x in saved.items()}


def dumps(value: object, indent: int | None = None) -> str:
    """One JSON text without NaN literals; on a single line unless ``indent`` is given."""
    try:
        return json.dumps(value, allow_nan=False, indent=indent, ensure_ascii=False)
    except (TypeError, ValueError):  # numbers of numpy or torch, paths, floats that are not finite
        pass
    return json.dumps(plain(value), allow_nan=False, indent=indent, ensure_ascii=False)


def canonical(value: object) -> bytes:
    """The one JSON text of a value, to be hashed: sorted names, no spaces."""
    return json.dumps(plain(value), sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def json_sha256(value: object) -> str:
    """The SHA-256 of the canonical JSON of a value."""
    return hashlib.sha256(canonical(value)).hexdigest()


def write_json(path: Path, value: object) -> None:
    """Write one JSON file so that a reader sees the old one or the new one whole, also after a crash. Raises
    CannotWrite.
    """
    with writing(path):
        replace_file(path, (dumps(value, indent=2) + "\n").encode("utf-8"))


def read_json(path: Path) -> Any:
    """The content of a JSON file. Raises ValueError naming the file if it is not JSON (NaN literals are not),
    or if an object has a key twice.
    """

    def refuse(literal: str) -> None:
        raise ValueError(f"{literal} is not JSON")

    try:
        return json.loads(
            path.read_text(encoding="utf-8"), parse_constant=refuse, object_pairs_hook=each_key_once
        )
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not readable as JSON ({error}).") from error


def signed(settings: Mapping[str, object]) -> dict[str, Any]:
    """The settings and their hash."""
    return {**settings, SIGNATURE: json_sha256(settings)}


def unsigned(found: Mapping[str, object]) -> dict[str, Any]:
    """The settings without their hash."""
    return {name: value for name, value in found.items() if name != SIGNATURE}


def require_own(file: Path, found: Mapping[str, object]) -> None:
    """ValueError if the content of ``file`` does not match its hash; a file without a hash is accepted."""
    if SIGNATURE in found and found[SIGNATURE] != json_sha256(unsigned(found)):
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


def each_key_once(pairs: Sequence[tuple[str, object]]) -> dict[str, Any]:
    """A dict of its pairs, for the json module. ValueError for a key that occurs twice: some readers take the
    first and some the last, so the value that was checked might not be the one that is used.
    """
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"the key {next(key for key in keys if keys.count(key) > 1)!r} stands twice")
    return found


def retyped(name: Any, placeholder: str) -> str:
    """A name from a file, as a word of a command to type. It stays if it is a plain id, path or
    FILE.py:function. Otherwise the placeholder is returned, so that no file can write commands for a user to
    copy.
    """
    plain = isinstance(name, str) and re.fullmatch(r"[\w.~/][\w.~/:=-]*", name)
    return name if plain and (":" in name or ":" not in placeholder) else placeholder


def in_lines(cells: Sequence[str], width: int) -> str:
    """Short texts side by side, as many in a line as fit into ``width`` characters; none is broken."""
    whole = "   ".join(cell.replace(" ", "\xa0") for cell in cells)  # where textwrap breaks no line
    return textwrap.fill(whole, max(1, width), break_on_hyphens=False).replace("\xa0", " ")


def printable(text: str) -> str:
    """A text that may contain strings from a file, without characters that control a terminal."""
    return "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in text)


def refuse_links(folder: Path) -> None:
    """ValueError for a link, a pipe or a device anywhere in a folder: reads and writes could be redirected to
    any place of the machine.
    """
    for parent, folders, names in os.walk(folder):
        for path in (Path(parent, name) for name in (*folders, *names)):
            with contextlib.suppress(FileNotFoundError):  # the writer of the run may be at work
                mode = path.lstat().st_mode
                if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                    raise ValueError(
                        f"{path} is a link or a device; expected only files and folders, because a run is "
                        "also written to. Replace it by what it points to, or delete it."
                    )


def read_lines(path: Path) -> list[dict[str, Any]]:
    """The objects of a .jsonl file; an empty list if there is no file.

    A last line that is incomplete, after a crash or while it is written, is left out. An incomplete line in
    the middle raises ValueError with its number.
    """
    try:
        return _parsed(path)
    except ValueError:  # a resumed run may have shortened the file while it was read
        return _parsed(path)


def _parsed(path: Path) -> list[dict[str, Any]]:
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
        except (ValueError, RecursionError) as error:
            if number == len(lines):  # no newline after it: the writer was stopped in the middle
                break
            raise ValueError(f"{path} line {number} is not a JSON object ({error}).") from error
        rows.append(row)
    return rows


class Recorder:
    """A .jsonl file that grows by whole lines, and knows its length and SHA-256 at any moment.

    Opening it cuts off a last line that is torn. Raises CannotWrite.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._descriptor = -1
        with writing(path):
            spare_standard_streams()
            flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
            self._descriptor = os.open(path, flags, 0o666)
            content = path.read_bytes()
        self._size = content.rfind(b"\n") + 1
        self._digest = hashlib.sha256(content[: self._size])
        self._cut()

    def append(self, text: str) -> None:
        """Add lines. What cannot be written leaves the file as it was."""
        content = text.encode("utf-8")
        with writing(self.path):
            try:
                write_all(self._descriptor, content)
            except BaseException:
                with contextlib.suppress(OSError):
                    self._cut()
                raise
        self._size += len(content)
        self._digest.update(content)

    def _cut(self) -> None:
        with writing(self.path):
            os.ftruncate(self._descriptor, self._size)
            os.lseek(self._descriptor, 0, os.SEEK_END)

    def sync(self) -> dict[str, Any]:
        """Make it durable; returns the mark of this moment, for `disagreement` and `cut_back`."""
        with writing(self.path):
            os.fsync(self._descriptor)
        return {"bytes": self._size, "sha256": self._digest.hexdigest()}

    def close(self) -> None:
        """Close the file."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def __del__(self) -> None:
        self.close()


def disagreement(path: Path, mark: dict[str, Any]) -> str:
    """Why a file does not begin with the bytes of a mark from `Recorder.sync`; empty if it does."""
    size = path.stat().st_size if path.exists() else 0
    if size < mark["bytes"]:
        return f"{path} has {size} bytes, the checkpoint counts on {mark['bytes']}"
    digest, left = hashlib.sha256(), mark["bytes"]
    with open(path, "rb") if left else contextlib.nullcontext() as file:
        while left and file is not None:
            block = file.read(min(left, BLOCK))
            digest.update(block)
            left -= len(block)
    if digest.hexdigest() != mark["sha256"]:
        return f"{path} is another file than the checkpoint counts on, or was changed"
    return ""


def cut_back(path: Path, size: int) -> None:
    """Shorten a file to its first ``size`` bytes, durably. Raises CannotWrite."""
    with writing(path):
        descriptor = os.open(path, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
        try:
            os.ftruncate(descriptor, size)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
