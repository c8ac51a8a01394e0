"""Checkpoints: folders of ``manifest.json``, ``state.json`` and ``*.safetensors``, whole or absent, never
unpickled.

A checkpoint is written under a name that starts with a dot, made durable, and renamed into place, so a crash
at any moment leaves either no folder or a complete one. Reading trusts nothing: the manifest names every file
with its size and SHA-256, and a folder that differs from its manifest in any way is refused.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
import stat
import uuid
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tightrope.runs.records import read_json, sync_folder, write_json

if TYPE_CHECKING:
    from torch import Tensor

FORMAT = "tightrope-checkpoint"
VERSION = 1
TEMPORARY = ".saving-"
_STEM = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_STEP_FOLDER = re.compile(r"step-(\d{12})")


class CheckpointError(ValueError):
    """A checkpoint that cannot be trusted or found; the message names the file and what to do."""


def step_folder(checkpoints: Path, step: int) -> Path:
    """Where the checkpoint of a step lies: ``checkpoints/step-000000060000``."""
    return checkpoints / f"step-{step:012d}"


def step_of(folder: Path) -> int:
    """The step in a checkpoint folder's name; -1 for another name."""
    match = _STEP_FOLDER.fullmatch(folder.name)
    return int(match.group(1)) if match else -1


def save(folder: Path, tensors: dict[str, dict[str, Tensor]], state: dict[str, Any]) -> Path:
    """Write a checkpoint and return its folder; an existing one there is replaced once the new one is
    complete.

    ``tensors`` maps a file stem to its named tensors (``{"policy": {...}}`` becomes policy.safetensors);
    tensors are copied to contiguous CPU memory, dtypes kept. ``state`` is JSON; integers of any size are
    exact, a float that is not finite becomes null, so what must come back to the bit belongs into
    ``tensors``. Whatever goes wrong, no visible folder is left. Raises CheckpointError for a stem that is not
    a plain name, OSError as the system does.
    """
    folder = Path(folder)
    _refuse_to_replace(folder)
    for stem in tensors:
        if not _STEM.fullmatch(stem):
            raise CheckpointError(
                f"{stem!r} is no file stem for a checkpoint. Use letters, digits, '-' and '_'."
            )
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = folder.with_name(f"{TEMPORARY}{folder.name}-{uuid.uuid4().hex[:8]}")
    temporary.mkdir()
    try:
        with writing(folder):
            _fill(temporary, tensors, state)
        _put(temporary, folder)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    return folder


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Inside, what safetensors cannot write, on a full disk for one, is an OSError that names ``path``."""
    from safetensors import SafetensorError

    try:
        yield
    except SafetensorError as error:
        raise OSError(
            f"{path} cannot be written ({error}). Make room on the disk and try again; a run that has a "
            "checkpoint goes on with: tightrope resume RUN"
        ) from error


def _fill(temporary: Path, tensors: dict[str, dict[str, Tensor]], state: dict[str, Any]) -> None:
    from safetensors.torch import save_file

    write_json(temporary / "state.json", state)
    for stem, group in tensors.items():
        # A copy each: parameters may be views of one buffer, which safetensors refuses to write.
        copies = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in group.items()}
        save_file(copies, temporary / f"{stem}.safetensors")
    files = {}
    for path in sorted(temporary.iterdir()):
        with open(path, "rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
            os.fsync(file.fileno())
        files[path.name] = {"size": path.stat().st_size, "sha256": digest}
    write_json(temporary / "manifest.json", {"format": FORMAT, "version": VERSION, "files": files})


def _refuse_to_replace(folder: Path) -> None:
    """CheckpointError unless the folder is free, empty, or holds a checkpoint and nothing beside it."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    try:
        _declared(folder)
    except (CheckpointError, OSError) as error:
        raise CheckpointError(
            f"{folder} is there already and is no checkpoint of this library, so it is not replaced "
            f"({error}). Save under another name."
        ) from error


def _put(temporary: Path, folder: Path) -> None:
    """Rename into place. A folder cannot be renamed over a full one, so an old one steps aside first; see
    `load`.
    """
    aside = _aside(folder)
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
    if folder.exists():
        if aside.exists():
            shutil.rmtree(aside)
        os.rename(folder, aside)
    os.rename(temporary, folder)
    sync_folder(folder.parent)
    if aside.exists():
        shutil.rmtree(aside)


def _aside(folder: Path) -> Path:
    return folder.with_name(f".replaced-{folder.name}")


def remove_leftovers(parent: Path) -> None:
    """Delete the temporaries of a save that a crash cut off. Only for the one process that writes there."""
    for path in parent.glob(f"{TEMPORARY}*") if parent.is_dir() else ():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)


def load(folder: Path) -> tuple[dict[str, dict[str, Tensor]], dict[str, Any]]:
    """Tensors (on the CPU) and state of a checkpoint, verified. Raises CheckpointError naming the file at
    fault.

    A crash between the two renames of a replacement leaves the old checkpoint set aside; it is found and
    used.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load as parse

    folder = _present(Path(folder))
    tensors: dict[str, dict[str, Tensor]] = {}
    for name, entry in _declared(folder).items():
        if name == "state.json":
            continue
        # Hashed and parsed are the same bytes: a file changed in between cannot slip in.
        content = _verified(folder / name, entry)
        try:
            tensors[name.removesuffix(".safetensors")] = parse(content)
        except (SafetensorError, ValueError) as error:
            raise CheckpointError(
                f"{folder / name} is not a safetensors file ({error}). {_ADVICE}"
            ) from error
    return tensors, load_state(folder)


def load_state(folder: Path) -> dict[str, Any]:
    """The verified ``state.json`` of a checkpoint alone: cheap, and without importing torch."""
    folder = _present(Path(folder))
    path = folder / "state.json"
    _verified(path, _declared(folder)["state.json"])
    try:
        state = read_json(path)
    except ValueError as error:
        raise CheckpointError(f"{error} {_ADVICE}") from error
    if not isinstance(state, dict):
        raise CheckpointError(f"{path} holds {type(state).__name__}, expected an object. {_ADVICE}")
    return state


def verify(folder: Path) -> None:
    """Raise CheckpointError unless the folder holds exactly what its manifest declares."""
    folder = _present(Path(folder))
    for name, entry in _declared(folder).items():
        _verified(folder / name, entry)


def newest(checkpoints: Path) -> Path:
    """The newest valid checkpoint in a folder of them.

    A damaged one is passed over with a warning that names it; CheckpointError when none is left.
    """
    checkpoints = Path(checkpoints)
    found = [p for p in checkpoints.iterdir() if step_of(p) >= 0] if checkpoints.is_dir() else []
    for folder in sorted(found, key=step_of, reverse=True):
        try:
            verify(folder)
        except CheckpointError as error:
            warnings.warn(f"Checkpoint passed over: {error}", stacklevel=2)
        else:
            return folder
    if found:
        raise CheckpointError(
            f"{checkpoints} holds no valid checkpoint, all {len(found)} are damaged. Train again."
        )
    raise CheckpointError(
        f"{checkpoints} holds no checkpoint: the run stopped before its first. Train again."
    )


_ADVICE = "The checkpoint is damaged or was changed: use another one, or train again."


def _present(folder: Path) -> Path:
    if not folder.exists() and _aside(folder).is_dir():
        return _aside(folder)
    if not folder.is_dir():
        raise CheckpointError(f"{folder} is not a checkpoint folder: no such folder. Check the path.")
    return folder


def _declared(folder: Path) -> dict[str, dict[str, Any]]:
    """The manifest's files, after checking that the folder holds them and nothing else."""
    path = folder / "manifest.json"
    _regular(path)
    try:
        manifest = read_json(path)
    except ValueError as error:
        raise CheckpointError(f"{error} {_ADVICE}") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise CheckpointError(f"{path} is not the manifest of a {FORMAT}. Check the path. {_ADVICE}")
    if manifest.get("version") != VERSION:
        raise CheckpointError(
            f"{path} has version {manifest.get('version')!r}, this tightrope reads {VERSION}. "
            "Use the tightrope that wrote it, or upgrade this one."
        )
    files = manifest.get("files")
    if not isinstance(files, dict) or "state.json" not in files:
        raise CheckpointError(f"{path} does not declare state.json. {_ADVICE}")
    for name in files:
        stem = name.removesuffix(".safetensors")
        if name != "state.json" and (stem == name or not _STEM.fullmatch(stem)):
            raise CheckpointError(f"{path} declares {name!r}, which is no plain NAME.safetensors. {_ADVICE}")
    present = {p.name for p in folder.iterdir()} - {"manifest.json"}
    for name in sorted(present - set(files)):
        raise CheckpointError(f"{folder / name} is not declared in manifest.json. {_ADVICE}")
    for name in sorted(set(files) - present):
        raise CheckpointError(f"{folder / name} is missing, manifest.json declares it. {_ADVICE}")
    return files


def _regular(path: Path) -> None:
    """Refuse links, folders and devices: they could point the reader anywhere."""
    try:
        mode = path.lstat().st_mode
    except OSError as error:
        raise CheckpointError(f"{path} is missing ({error.strerror}). {_ADVICE}") from error
    if not stat.S_ISREG(mode):
        raise CheckpointError(f"{path} is not a regular file. {_ADVICE}")


def _verified(path: Path, entry: Any) -> bytes:
    """The bytes of a file whose size and SHA-256 are the declared ones."""
    _regular(path)
    if not isinstance(entry, dict):
        raise CheckpointError(
            f"{path.with_name('manifest.json')} has no size and sha256 of {path.name}. {_ADVICE}"
        )
    size = path.stat().st_size
    if size != entry.get("size"):
        raise CheckpointError(
            f"{path} has {size} bytes, manifest.json declares {entry.get('size')}. {_ADVICE}"
        )
    content = path.read_bytes()
    if hashlib.sha256(content).hexdigest() != entry.get("sha256"):
        raise CheckpointError(f"{path} does not match the SHA-256 in manifest.json. {_ADVICE}")
    return content
