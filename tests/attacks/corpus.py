"""Hostile files, made by code: attacks that somebody could put into a run, a checkpoint or a model folder.

Each attack has a name, a function that plants it in a good folder, and the words that its refusal must
contain (None: it is harmless, and the command works as if it were not there).
"""

from __future__ import annotations

import functools
import io
import json
import os
import pickle
import shutil
import struct
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

from attacks.watch import MARK, Watch, outcome

from tightrope.runs import checkpoint

CANARY = os.environ.get("TIGHTROPE_CANARY", "/nonexistent/canary")
CODE = f"open({CANARY!r}, 'w').close()  # {MARK}"


class Attack(NamedTuple):
    """``plant(folder)`` makes the folder hostile; ``words`` are in the refusal, per command or for all."""

    name: str
    plant: Callable[[Path], None]
    words: str | None


def staged(
    watch: Watch, inner: Path, good: Path, attack: Attack, command: Callable[[Path], Any]
) -> dict[str, Any]:
    """The outcome of a command on a copy of a good folder in which the attack was planted, and what became of
    the file and the names beside it.
    """
    shutil.rmtree(inner, ignore_errors=True)
    inner.mkdir()
    (inner / "victim").write_text("untouched")
    shutil.copytree(good, inner / "run")
    attack.plant(inner / "run")
    result = outcome(watch, lambda: command(inner / "run"))
    result["victim"] = (inner / "victim").read_text()
    result["beside"] = sorted(path.name for path in inner.iterdir())
    return result


class Bomb:
    """Unpickling one makes the canary."""

    def __reduce__(self) -> tuple[Any, ...]:
        return exec, (CODE,)


def pickled() -> bytes:
    """A pickle that runs code."""
    return pickle.dumps({"state_dict": Bomb()})


@functools.cache
def torch_zip() -> bytes:
    """The same as torch.save writes it."""
    import torch

    file = io.BytesIO()
    torch.save({"state_dict": Bomb()}, file)
    return file.getvalue()


HUGE = struct.pack("<Q", 10 * 2**30) + b'{"a":'  # safetensors that declares a header of 10 GB
DEEP = b"[" * 200_000
MODULE = f"import os\n{CODE}\ndef function(*_, **__): return [0.0]\nclass Model: pass\n"


def put(name: str, content: bytes | str) -> Callable[[Path], None]:
    """Write a file below the folder; ``*`` means the newest checkpoint."""

    def plant(folder: Path) -> None:
        path = found(folder, name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)

    return plant


def found(folder: Path, name: str) -> Path:
    """The file that a name means in this folder."""
    if name.startswith("*/"):
        return max(folder.glob("checkpoints/step-*")) / name[2:]
    return folder / name


def edit(name: str, **values: Any) -> Callable[[Path], None]:
    """Change keys of a JSON object in the folder; a value that is a dict is merged into the one there. Its
    own hash, which anybody can write, is taken out.
    """

    def plant(folder: Path) -> None:
        path = found(folder, name)
        path.write_text(json.dumps(merged(json.loads(path.read_text()), {"sha256": ..., **values})))

    return plant


def merged(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    """``old`` with the values of ``new``, dicts merged, ``...`` deleted."""
    result = dict(old)
    for key, value in new.items():
        before = result.get(key)
        both = isinstance(before, dict) and isinstance(value, dict)
        result[key] = merged(before, value) if both else value
    return {key: value for key, value in result.items() if value is not ...}


def forge(**values: Any) -> Callable[[Path], None]:
    """Change the state of every checkpoint, with a manifest that agrees."""

    def plant(folder: Path) -> None:
        for one in (*folder.glob("checkpoints/step-*"), *folder.glob("best")):
            tensors, state = checkpoint.load(one)
            checkpoint.save(one, tensors, merged(state, values))

    return plant


def forge_file(name: str, content: bytes) -> Callable[[Path], None]:
    """Replace a file of every checkpoint, with a manifest that agrees."""
    write_file = checkpoint.write_file

    def hostile(path: Path, parts: Iterable[Any], **how: Any) -> tuple[int, str]:
        return write_file(path, [content] if path.name == name else parts, **how)

    def plant(folder: Path) -> None:
        for one in (*folder.glob("checkpoints/step-*"), *folder.glob("best")):
            tensors, state = checkpoint.load(one)
            with mock.patch("tightrope.runs.checkpoint.write_file", hostile):
                checkpoint.save(one, tensors, state)

    return plant


def forge_tensor(stem: str, name: str | None, size: int) -> Callable[[Path], None]:
    """Give a tensor of every checkpoint (None: one of them) that shape, with a manifest that agrees."""

    def plant(folder: Path) -> None:
        for one in (*folder.glob("checkpoints/step-*"), *folder.glob("best")):
            tensors, state = checkpoint.load(one)
            known = min(tensors[stem]) if name is None else name
            tensors[stem][known] = tensors[stem][known].new_zeros(size)
            checkpoint.save(one, tensors, state)

    return plant


def declare(name: str) -> Callable[[Path], None]:
    """Manifests that name a file elsewhere, each with its own SHA-256."""

    def plant(folder: Path) -> None:
        for path in folder.glob("checkpoints/step-*/manifest.json"):
            manifest = json.loads(path.read_text())
            manifest["files"][name] = manifest["files"]["state.json"]
            path.write_bytes(checkpoint._manifest_text(manifest))

    return plant


def twice(name: str, key: str, value: str) -> Callable[[Path], None]:
    """A duplicate key with a different second value."""

    def plant(folder: Path) -> None:
        path = found(folder, name)
        text = path.read_text().rstrip()
        path.write_text(f"{text[:-1]}, {json.dumps(key)}: {value}}}")

    return plant


def link(name: str, target: str) -> Callable[[Path], None]:
    """A link instead of a file or folder, to ``target`` beside the run: the old content, or a victim."""

    def plant(folder: Path) -> None:
        path, elsewhere = found(folder, name), folder.parent / target
        if path.exists() and not elsewhere.exists():
            os.rename(path, elsewhere)
        elif path.is_file():
            path.unlink()
        path.symlink_to(elsewhere)

    return plant


def pipe(name: str) -> Callable[[Path], None]:
    """A named pipe: a reader waits for ever."""

    def plant(folder: Path) -> None:
        found(folder, name).unlink(missing_ok=True)
        os.mkfifo(found(folder, name))

    return plant


def both(*plants: Callable[[Path], None]) -> Callable[[Path], None]:
    """One after the other."""

    def plant(folder: Path) -> None:
        for one in plants:
            one(folder)

    return plant
