"""Files and folders that are whole or absent, also after a crash, and the error when they cannot be written.

What is being written has a name that starts with `TEMPORARY`; it gets its own name when its bytes are on the
disk.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import re
import shutil
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path

from tightrope.errors import TightropeError

TEMPORARY = ".saving-"
ASIDE = ".replaced-"
PRUNED = ".pruned-"
BLOCK = 8 << 20  # hashed while it is in the processor's cache, written, then the next one
_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
_FULL = "Make room on the disk"
_ADVICE = {
    errno.ENOSPC: _FULL,
    errno.EDQUOT: _FULL,
    errno.EFBIG: _FULL,
    errno.EROFS: "The disk is read-only: have it mounted for writing",
    errno.EACCES: "Give yourself the permission to write there",
    errno.EPERM: "Give yourself the permission to write there",
}


class CannotWrite(TightropeError, OSError):
    """Something that could not be written: the path, why, and what to do. What was there before is whole."""

    def __init__(self, path: Path, cause: BaseException) -> None:
        number, reason = getattr(cause, "errno", None), getattr(cause, "strerror", None) or str(cause)
        if number is None and (found := re.search(r"os error (\d+)", reason)):  # as safetensors words it
            number = int(found.group(1))
        super().__init__(number, reason, str(path))
        self.what = f"{path} cannot be written ({reason}). Nothing that was saved before is lost."
        self.advice = _ADVICE.get(number or 0, "See to the disk")

    def __str__(self) -> str:
        return (
            f"{self.what} {self.advice} and try again; a run that has a checkpoint goes on with: "
            "tightrope resume RUN"
        )


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Inside, what the system cannot write, on a full disk for one, is a CannotWrite that names ``path``."""
    from safetensors import SafetensorError

    try:
        yield
    except CannotWrite:
        raise
    except (OSError, SafetensorError) as error:
        raise CannotWrite(path, error) from error


def write_file(path: Path, parts: Iterable[bytes | memoryview], *, sync: bool = True) -> tuple[int, str]:
    """A new file: its size and SHA-256, computed while it is written. It is on the disk when this returns,
    unless ``sync`` is False.
    """
    digest, size = hashlib.sha256(), 0
    descriptor = os.open(path, _NEW, 0o666)
    try:
        for part in parts:
            for start in range(0, len(part), BLOCK):
                block = part[start : start + BLOCK]
                digest.update(block)
                write_all(descriptor, block)
            size += len(part)
        if sync:
            os.fsync(descriptor)
    finally:
        os.close(descriptor)
    return size, digest.hexdigest()


def write_all(descriptor: int, content: bytes | memoryview) -> None:
    """Every byte: the system may take fewer than it is given."""
    rest = memoryview(content)
    while rest:
        rest = rest[os.write(descriptor, rest) :]


def replace_file(path: Path, content: bytes) -> None:
    """Write one file so that a reader sees the old one or the new one whole, also after a crash."""
    temporary = path.with_name(f"{TEMPORARY}{path.name}-{uuid.uuid4().hex[:8]}")
    try:
        write_file(temporary, [content])
        os.replace(temporary, path)
        sync_folder(path.parent)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """A new folder to fill; on leaving it takes the place of ``folder``, whole and durable.

    Files in it are made durable when all are written: the first fsync then carries most of the others.
    Whatever goes wrong, ``folder`` is as it was. Raises CannotWrite.
    """
    temporary = folder.with_name(f"{TEMPORARY}{folder.name}-{uuid.uuid4().hex[:8]}")
    with writing(folder):
        try:
            make_folders(folder.parent)
            temporary.mkdir()
            yield temporary
            sync_tree(temporary)
            put(temporary, folder)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise


def sync_tree(folder: Path) -> None:
    """Make a folder durable, its files and its names."""
    for path in sorted(folder.iterdir()):
        if path.is_dir():
            sync_tree(path)
        else:
            sync_file(path)
    sync_folder(folder)


def sync_file(path: Path) -> None:
    """Make the bytes of a file durable."""
    descriptor = os.open(path, os.O_RDWR)  # Windows makes only writable files durable
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def put(temporary: Path, folder: Path) -> None:
    """Rename into place. A folder cannot be renamed over a full one, so an old one steps aside first; until
    the new one is there, `present` finds it.
    """
    aside = folder.with_name(f"{ASIDE}{folder.name}")
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
    if folder.exists():
        if aside.exists():
            shutil.rmtree(aside)
        os.rename(folder, aside)
    try:
        os.rename(temporary, folder)
    except BaseException:
        if aside.exists() and not folder.exists():
            os.rename(aside, folder)
        raise
    sync_folder(folder.parent)
    if aside.exists():
        shutil.rmtree(aside)


def present(folder: Path) -> Path:
    """The folder, or where it stepped aside when a crash cut its replacement off."""
    aside = folder.with_name(f"{ASIDE}{folder.name}")
    return aside if not folder.exists() and aside.is_dir() else folder


def remove(folder: Path) -> None:
    """Delete a folder so that no reader finds half of it under its name."""
    pruned = folder.with_name(f"{PRUNED}{folder.name}")
    if pruned.exists():
        shutil.rmtree(pruned)
    os.rename(folder, pruned)
    sync_folder(folder.parent)
    shutil.rmtree(pruned)


def remove_leftovers(parent: Path) -> None:
    """Delete what a crash left of a save, and finish a replacement that it cut off. Only for the one process
    that writes there.
    """
    for path in sorted(parent.iterdir()) if parent.is_dir() else ():
        if path.name.startswith(ASIDE) and not path.with_name(path.name.removeprefix(ASIDE)).exists():
            os.rename(path, path.with_name(path.name.removeprefix(ASIDE)))
        elif path.name.startswith((TEMPORARY, ASIDE, PRUNED)):
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def make_folders(folder: Path) -> None:
    """Make a folder and those above it, their names durable."""
    if not folder.is_dir():
        make_folders(folder.parent)
        with contextlib.suppress(FileExistsError):
            folder.mkdir()
        sync_folder(folder.parent)


def sync_folder(folder: Path) -> None:
    """Make the names in a folder durable, where the platform knows how (fsync of a directory)."""
    if os.name == "nt":  # Windows cannot open a folder
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
