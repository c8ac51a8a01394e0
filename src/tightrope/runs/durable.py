"""Files and folders that are complete or absent, also after a crash, and the error if they cannot be written.

A file or folder gets a temporary name that starts with `TEMPORARY`. It is renamed when its bytes are on the
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
BLOCK = 8 << 20  # bytes that are hashed while they are in the processor's cache, then written
_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
_FULL = "Make room on the disk"
_ADVICE = {
    errno.ENOSPC: _FULL,
    errno.EDQUOT: _FULL,
    errno.EFBIG: _FULL,
    errno.EROFS: "The disk is read-only: have it mounted for writing",
    errno.EACCES: "Give yourself the permission to write there",
    errno.ENOENT: "If it was renamed, give it its name back",
    errno.ENOTDIR: "A part of the path is a file: give another path",
    errno.EPERM: "Give yourself the permission to write there",
}


class CannotWrite(TightropeError, OSError):
    """A path that could not be written, why, and what to do. What was saved before is intact.

    ``command``: what continues the run, where there is one.
    """

    command: str | None = None

    def __init__(self, path: Path, cause: BaseException) -> None:
        number, reason = getattr(cause, "errno", None), getattr(cause, "strerror", None) or str(cause)
        if number is None and (found := re.search(r"os error (\d+)", reason)):  # the text of safetensors
            number = int(found.group(1))
        super().__init__(number, reason, str(path))
        self.what = f"{path} cannot be written ({reason}). Nothing that was saved before is lost."
        self.advice = _ADVICE.get(number or 0, "Check the disk")

    def __str__(self) -> str:
        again = f"; the run continues with: {self.command}" if self.command else "."
        return f"{self.what} {self.advice} and try again{again}"


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turns errors of the system, such as a full disk, into a CannotWrite that names ``path``."""
    from safetensors import SafetensorError

    try:
        yield
    except CannotWrite:
        raise
    except (OSError, SafetensorError) as error:
        raise CannotWrite(path, error) from error


def write_file(path: Path, parts: Iterable[bytes | memoryview], *, sync: bool = True) -> tuple[int, str]:
    """Write a new file; returns its size and SHA-256, computed while it is written. It is on the disk when
    this returns, unless ``sync`` is False.
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


def spare_standard_streams() -> None:
    """Open what user code has closed of the descriptors 0 to 2: a file that stays open must not get their
    numbers, and be closed or printed into by the next who means them.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)


def write_all(descriptor: int, content: bytes | memoryview) -> None:
    """Write every byte: one system call may write fewer than it is given."""
    rest = memoryview(content)
    while rest:
        rest = rest[os.write(descriptor, rest) :]


def replace_file(path: Path, content: bytes) -> None:
    """Write one file so that a reader sees the complete old or the complete new one, also after a crash."""
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
    """A new folder to fill. At the end it replaces ``folder``, complete and durable.

    Its files are made durable after all are written: the first fsync then writes most of the others too.
    After any error ``folder`` is as it was. Raises CannotWrite.
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
    descriptor = os.open(path, os.O_RDWR)  # Windows syncs only files that are open for writing
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def put(temporary: Path, folder: Path) -> None:
    """Rename ``temporary`` to ``folder``. A folder cannot replace one that is not empty, so the old one is
    renamed first. Until the new one is in place, `present` finds the old one.
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
    """The folder, or the name that the old one was given if a crash interrupted its replacement."""
    aside = folder.with_name(f"{ASIDE}{folder.name}")
    return aside if not folder.exists() and aside.is_dir() else folder


def remove(folder: Path) -> None:
    """Delete a folder so that no reader finds a part of it under its name."""
    pruned = folder.with_name(f"{PRUNED}{folder.name}")
    if pruned.exists():
        shutil.rmtree(pruned)
    os.rename(folder, pruned)
    sync_folder(folder.parent)
    shutil.rmtree(pruned)


def remove_leftovers(parent: Path) -> None:
    """Delete what a crash left of a save, and finish an interrupted replacement. Only for the one process
    that writes there.
    """
    for path in sorted(parent.iterdir()) if parent.is_dir() else ():
        if path.name.startswith(ASIDE) and not path.with_name(path.name.removeprefix(ASIDE)).exists():
            os.rename(path, path.with_name(path.name.removeprefix(ASIDE)))
        elif path.name.startswith((TEMPORARY, ASIDE, PRUNED)):
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def make_folders(folder: Path) -> None:
    """Create a folder and those above it, with durable names."""
    if not folder.is_dir():
        make_folders(folder.parent)
        with contextlib.suppress(FileExistsError):
            folder.mkdir()
        sync_folder(folder.parent)


def sync_folder(folder: Path) -> None:
    """Make the names in a folder durable, if the platform can (fsync of a directory)."""
    if os.name == "nt":  # Windows cannot open a folder
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
