"""Checkpoints: folders of ``manifest.json``, ``state.json`` and ``*.safetensors``, complete or absent, never
unpickled.

A checkpoint is written under a name that starts with a dot, made durable, and renamed into place, so a crash
at any moment leaves either no folder or a complete one. Reading trusts nothing: the manifest names every file
with its size and SHA-256, and must itself be exactly the text that is written for its content. A folder that
differs from its manifest in any way is refused.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import re
import stat
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsInt, TypeVar

from tightrope.errors import TightropeError
from tightrope.runs import versions
from tightrope.runs.durable import atomic_folder, present, write_file
from tightrope.runs.records import dumps, json_sha256, read_json

if TYPE_CHECKING:
    from torch import Tensor

_T = TypeVar("_T")
FORMAT = "tightrope-checkpoint"
VERSION = 2
READS = 5  # of a folder that is replaced while it is read
_STEM = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_STEP_FOLDER = re.compile(r"step-(\d{12})")
_ADVICE = "The checkpoint is damaged or was changed: use another one, or train again."


class CheckpointError(TightropeError, ValueError):
    """A checkpoint that is damaged or missing; the message names the file and what to do."""


def step_folder(checkpoints: Path, step: int) -> Path:
    """The folder of the checkpoint of a step: ``checkpoints/step-000000060000``."""
    return checkpoints / f"step-{step:012d}"


def step_of(folder: Path) -> int:
    """The step in a checkpoint folder's name; -1 for another name."""
    match = _STEP_FOLDER.fullmatch(folder.name)
    return int(match.group(1)) if match else -1


# ---------------------------------------------------------------------------- writing


def save(folder: Path, tensors: dict[str, dict[str, Tensor]], state: Mapping[str, object]) -> Path:
    """Write a checkpoint and return its folder; an existing one there is replaced once the new one is
    complete.

    ``tensors`` maps a file stem to its named tensors (``{"policy": {...}}`` becomes policy.safetensors),
    dtypes kept. ``state`` is JSON: integers of any size are exact, a float that is not finite becomes null.
    Store in ``tensors`` what must be restored exactly. After an error no visible folder is left. Raises
    CheckpointError for a stem that is not a plain name, CannotWrite (an OSError) for errors of the disk.
    """
    folder = Path(folder)
    _refuse_to_replace(folder)
    for stem in tensors:
        if not _STEM.fullmatch(stem):
            raise CheckpointError(
                f"{stem!r} is not a file stem for a checkpoint. Use letters, digits, '-' and '_'."
            )
    with atomic_folder(folder) as temporary:
        parts: dict[str, Any] = {"state.json": [(dumps(state, indent=2) + "\n").encode("utf-8")]}
        parts |= {f"{stem}.safetensors": safetensors_bytes(group) for stem, group in tensors.items()}
        files = {}
        for name, content in parts.items():
            size, digest = write_file(temporary / name, content, sync=False)
            files[name] = {"size": size, "sha256": digest}
        manifest = {
            "format": FORMAT,
            "version": VERSION,
            "step": step_of(folder) if step_of(folder) >= 0 else None,
            "files": files,
            "versions": versions.known(),
            "settings_sha256": json_sha256(state["settings"]) if "settings" in state else None,
        }
        write_file(temporary / "manifest.json", [_manifest_text(manifest)], sync=False)
    return folder


def _manifest_text(manifest: Mapping[str, object]) -> bytes:
    """The only valid text of a manifest, which includes the hash of its content."""
    bare = {name: value for name, value in manifest.items() if name != "sha256"}
    return (dumps({**bare, "sha256": json_sha256(bare)}, indent=2) + "\n").encode("utf-8")


def _refuse_to_replace(folder: Path) -> None:
    """CheckpointError unless the folder is missing, empty, or holds a checkpoint and nothing else."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    try:
        read_manifest(folder)
    except (CheckpointError, OSError) as error:
        raise CheckpointError(
            f"{folder} exists and is not a checkpoint of this library, so it is not replaced "
            f"({error}). Save under another name."
        ) from error


# ---------------------------------------------------------------------------- reading


def load(folder: Path) -> tuple[dict[str, dict[str, Tensor]], dict[str, Any]]:
    """Tensors (on the CPU) and state of a checkpoint, verified. Raises CheckpointError naming the file at
    fault.

    After a crash between the two renames of a replacement, the old checkpoint is found under its temporary
    name. A checkpoint that is replaced while it is read is read again.
    """
    return _steadily(Path(folder), _load)


def _load(folder: Path) -> tuple[dict[str, dict[str, Tensor]], dict[str, Any]]:
    from safetensors import SafetensorError
    from safetensors.torch import load as parse

    tensors: dict[str, dict[str, Tensor]] = {}
    for name, entry in read_manifest(folder)["files"].items():
        if name == "state.json":
            continue
        # The hashed bytes are parsed, so that a file cannot change in between.
        content = _verified(folder / name, entry)
        try:
            tensors[name.removesuffix(".safetensors")] = parse(content)
        except (SafetensorError, ValueError) as error:
            raise CheckpointError(
                f"{folder / name} is not a safetensors file ({error}). {_ADVICE}"
            ) from error
    return tensors, _load_state(folder)


def load_state(folder: Path) -> dict[str, Any]:
    """The verified ``state.json`` of a checkpoint, without its tensors: fast, and without torch."""
    return _steadily(Path(folder), _load_state)


def _load_state(folder: Path) -> dict[str, Any]:
    path = folder / "state.json"
    _verified(path, read_manifest(folder)["files"]["state.json"])
    try:
        state = read_json(path)
    except ValueError as error:
        raise CheckpointError(f"{error} {_ADVICE}") from error
    if not isinstance(state, dict):
        raise CheckpointError(f"{path} holds {type(state).__name__}, expected an object. {_ADVICE}")
    return state


def verify(folder: Path) -> None:
    """Raise CheckpointError unless the folder holds exactly what its manifest declares."""

    def check(folder: Path) -> None:
        for name, entry in read_manifest(folder)["files"].items():
            _verified(folder / name, entry, read=False)

    _steadily(Path(folder), check)


def counted(value: SupportsInt) -> int:
    """A count in a saved state. ValueError for what is none, or does not fit 64 bits."""
    number = int(value)
    if not 0 <= number < 2**63:
        raise ValueError(f"{str(number)[:30]} is no count")
    return number


@contextlib.contextmanager
def understood(folder: Path) -> Iterator[None]:
    """Turns errors about a wrong state or wrong tensors into a CheckpointError: a manifest protects against
    damage, but not against a file that someone wrote on purpose.
    """
    try:
        yield
    except (LookupError, TypeError, AttributeError, ValueError, ArithmeticError, RuntimeError) as error:
        kind = type(error)
        if isinstance(error, TightropeError) or kind.__name__ == "OutOfMemoryError":
            raise  # a fault of an environment, or too little memory: not of the checkpoint
        reason = (str(error).strip().splitlines() or [""])[0]
        raise CheckpointError(
            f"{folder} does not hold what belongs there ({kind.__name__}: {reason}). {_ADVICE}"
        ) from error


def _steadily(folder: Path, read: Callable[[Path], _T]) -> _T:
    """The result of ``read`` for a folder; tried again if another folder replaced it meanwhile."""
    for left in reversed(range(READS)):
        before = _identity(folder)
        try:
            if before is None:
                raise CheckpointError(f"{folder} is not a checkpoint folder: no such folder. Check the path.")
            return read(present(folder))
        except (CheckpointError, FileNotFoundError) as error:
            if not left or _identity(folder) == before:
                if isinstance(error, CheckpointError):
                    raise
                raise CheckpointError(f"{folder} was deleted while it was read.") from error
    raise AssertionError("unreachable")


def _identity(folder: Path) -> tuple[Path, int, int] | None:
    place = present(folder)
    try:
        found = place.stat()
    except FileNotFoundError:
        return None
    return (place, found.st_dev, found.st_ino) if stat.S_ISDIR(found.st_mode) else None


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest, after checking it against itself, and that the folder holds its files and nothing else.

    Keys: format, version, step, files (size and sha256 by name), versions (of libraries), settings_sha256.
    """
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
    try:
        expected = _manifest_text(manifest)
    except RecursionError:
        expected = b""
    if path.read_bytes() != expected:
        raise CheckpointError(f"{path} does not match its own SHA-256. {_ADVICE}")
    if step_of(folder) >= 0 and manifest.get("step") not in (None, step_of(folder)):
        raise CheckpointError(f"{path} is of step {manifest['step']}, its folder of another. {_ADVICE}")
    _check_names(folder, manifest.get("files"))
    return manifest


def _check_names(folder: Path, files: object) -> None:
    path = folder / "manifest.json"
    if not isinstance(files, dict) or "state.json" not in files:
        raise CheckpointError(f"{path} does not declare state.json. {_ADVICE}")
    for name in files:
        stem = name.removesuffix(".safetensors")
        if name != "state.json" and (stem == name or not _STEM.fullmatch(stem)):
            raise CheckpointError(f"{path} declares {name!r}, which is no plain NAME.safetensors. {_ADVICE}")
    inside = {p.name for p in folder.iterdir()} - {"manifest.json"}
    for name in sorted(inside - set(files)):
        raise CheckpointError(f"{folder / name} is not declared in manifest.json. {_ADVICE}")
    for name in sorted(set(files) - inside):
        raise CheckpointError(f"{folder / name} is missing, manifest.json declares it. {_ADVICE}")


def _regular(path: Path) -> None:
    """Refuse links, folders and devices: they could point the reader anywhere."""
    try:
        mode = path.lstat().st_mode
    except OSError as error:
        raise CheckpointError(f"{path} is missing ({error.strerror}). {_ADVICE}") from error
    if not stat.S_ISREG(mode):
        raise CheckpointError(f"{path} is not a regular file. {_ADVICE}")


def _verified(path: Path, entry: object, *, read: bool = True) -> bytes:
    """The bytes of a file whose size and SHA-256 are the declared ones; unless ``read``, none, and no memory
    for them.
    """
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
    content = path.read_bytes() if read else b""
    with contextlib.nullcontext(io.BytesIO(content)) if read else open(path, "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if digest != entry.get("sha256"):
        raise CheckpointError(f"{path} does not match the SHA-256 in manifest.json. {_ADVICE}")
    return content


_NAMES = {
    "bool": "BOOL",
    "uint8": "U8",
    "int8": "I8",
    "uint16": "U16",
    "int16": "I16",
    "float16": "F16",
    "bfloat16": "BF16",
    "uint32": "U32",
    "int32": "I32",
    "float32": "F32",
    "uint64": "U64",
    "int64": "I64",
    "float64": "F64",
}


def safetensors_bytes(tensors: dict[str, Tensor]) -> Iterator[bytes | memoryview]:
    """The bytes of a safetensors file of these tensors. ValueError for a dtype without a name there."""
    import torch

    ordered = sorted(tensors, key=lambda name: (-tensors[name].itemsize, name))  # so that each is aligned
    header, end = {}, 0
    for name in ordered:
        tensor, begin = tensors[name], end
        kind = str(tensor.dtype).removeprefix("torch.")
        if kind not in _NAMES:
            raise ValueError(f"{name} is a tensor of {kind}; a checkpoint holds {', '.join(_NAMES)}.")
        end = begin + tensor.numel() * tensor.itemsize
        header[name] = {"dtype": _NAMES[kind], "shape": list(tensor.shape), "data_offsets": [begin, end]}
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    yield len(text).to_bytes(8, "little") + text
    for name in ordered:
        plain = tensors[name].detach().cpu().contiguous().reshape(-1)
        yield plain.view(torch.uint8).numpy().data
