"""A disk that records its operations and can crash after any of them.

`Disk` follows every file operation below a folder and repeats it in memory under the rules of POSIX for a
crash: bytes are safe after fsync of their file, names after fsync of their folder, everything else may be
lost. `states` are the folders that a crash after any operation may leave.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

LOSSES = ("nothing", "bytes", "half of the bytes", "names")


class File:
    """Bytes, and the number of safe ones."""

    def __init__(self, content: bytes = b"") -> None:
        self.content, self.safe = content, content

    def after(self, lost: str) -> bytes:
        """The content after a crash; a file that was cut back and not synced may still have its old end."""
        if lost == "nothing":
            return self.content
        if lost == "half of the bytes":
            return self.content[: (len(self.safe) + len(self.content)) // 2]
        return self.safe


class Folder:
    """Names, and the safe ones."""

    def __init__(self) -> None:
        self.names: dict[str, File | Folder] = {}
        self.safe: dict[str, File | Folder] = {}


class Disk:
    """From now on, records the operations below ``root`` in ``log``."""

    def __init__(self, patch: pytest.MonkeyPatch, root: Path) -> None:
        self.root, self.log, self._open, self._deaf = root, list[tuple[Any, ...]](), dict[int, Path](), False
        self.start = _scan(root)
        for name in ("open", "write", "fsync", "close", "mkdir", "rename", "unlink", "rmdir", "ftruncate"):
            patch.setattr(os, name, self._follow(name, getattr(os, name)))
        patch.setattr(os, "replace", self._follow("rename", os.replace))
        patch.setattr(shutil, "rmtree", self._follow("rmtree", shutil.rmtree))

    def _follow(self, name: str, real: Any) -> Any:
        def call(*args: Any, **more: Any) -> Any:
            if self._deaf:
                return real(*args, **more)
            self._deaf = name == "rmtree"  # its parts are listed before it
            inside = list(self._parts(args[0])) if name == "rmtree" else []
            try:
                result = real(*args, **more)
            finally:
                self._deaf = False
            self.log += inside
            self._note(name, args, result)
            return result

        return call

    def _parts(self, folder: Any) -> Iterator[tuple[Any, ...]]:
        for path in sorted(Path(folder).rglob("*"), reverse=True):
            yield ("remove", path)
        yield ("remove", Path(folder))

    def _note(self, name: str, args: tuple[Any, ...], result: Any) -> None:
        if name == "open":
            path = Path(args[0])
            if path.is_relative_to(self.root):
                self._open[result] = path
                self.log += [("create", path)] if len(args) > 1 and args[1] & os.O_CREAT else []
        elif name == "close":
            self._open.pop(args[0], None)
        elif name in ("write", "fsync", "ftruncate"):
            if args[0] in self._open:
                more = bytes(args[1][:result]) if name == "write" else args[1:]
                self.log.append((name, self._open[args[0]], more))
        elif name == "rename":
            self.log.append((name, Path(args[0]), Path(args[1])))
        elif name != "rmtree":
            self.log.append(("mkdir" if name == "mkdir" else "remove", Path(args[0])))

    def states(self, place: Path) -> Iterator[tuple[int, str, Path]]:
        """Every folder that a crash may leave: the operations before it, the losses and its path."""
        tree = self.start
        for count in range(len(self.log) + 1):
            for lost in LOSSES:
                target = place / f"{count}-{lost.replace(' ', '-')}"
                _write(tree, target, lost)
                yield count, lost, target
                shutil.rmtree(target)
            if count < len(self.log):
                self._apply(tree, *self.log[count])

    def _apply(self, tree: Folder, kind: str, path: Path, more: Any = None) -> None:
        parent, name = self._find(tree, path.parent), path.name
        if kind == "create":
            parent.names.setdefault(name, File())
        elif kind == "mkdir":
            parent.names[name] = Folder()
        elif kind == "remove":
            del parent.names[name]
        elif kind == "rename":
            self._find(tree, more.parent).names[more.name] = parent.names.pop(name)
        else:
            self._change(parent.names[name] if path != self.root else tree, kind, more)

    def _change(self, node: File | Folder, kind: str, more: Any) -> None:
        if isinstance(node, Folder):
            node.safe = dict(node.names)
        elif kind == "write":
            node.content += more
        elif kind == "ftruncate":
            node.content = node.content[: more[0]]
        else:
            node.safe = node.content

    def _find(self, tree: Folder, path: Path) -> Folder:
        for name in path.relative_to(self.root).parts if path != self.root.parent else ():
            found = tree.names[name]
            assert isinstance(found, Folder)
            tree = found
        return tree


def _scan(path: Path) -> Folder:
    folder = Folder()
    for entry in path.iterdir():
        folder.names[entry.name] = _scan(entry) if entry.is_dir() else File(entry.read_bytes())
    folder.safe = dict(folder.names)
    return folder


def _write(node: File | Folder, path: Path, lost: str) -> None:
    if isinstance(node, File):
        path.write_bytes(node.after(lost))
        return
    path.mkdir(parents=True)
    for name, inside in (node.safe if lost == "names" else node.names).items():
        _write(inside, path / name, lost)
