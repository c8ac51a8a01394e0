"""A checkpoint is complete or absent, loads bit for bit, and any damage is named and refused."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file

from tightrope.control.environments.faults import EnvironmentFault
from tightrope.runs import checkpoint, retention, versions
from tightrope.runs.checkpoint import CheckpointError, safetensors_bytes
from tightrope.runs.durable import TEMPORARY, CannotWrite, remove_leftovers, writing


def tensors() -> dict[str, dict[str, torch.Tensor]]:
    buffer = torch.arange(12, dtype=torch.float32)
    return {
        "policy": {"a": buffer[:4].view(2, 2), "b": buffer[2:8], "t": torch.randn(3, 5).T},  # a and b overlap
        "numbers": {
            "step": torch.tensor(7),
            "mask": torch.tensor([True, False]),
            "wide": torch.rand(2).double(),
        },
    }


STATE = {"step": 600, "rng": 2**127 + 3, "name": "Grüße", "nested": {"list": [1, 2.5, None]}}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return checkpoint.save(checkpoint.step_folder(tmp_path / "checkpoints", 600), tensors(), STATE)


def test_returns_to_the_bit(tmp_path: Path) -> None:
    wanted = tensors()
    loaded, state = checkpoint.load(checkpoint.save(tmp_path / "best", wanted, STATE))
    assert state == STATE
    assert {k: set(v) for k, v in loaded.items()} == {k: set(v) for k, v in wanted.items()}
    for stem, group in wanted.items():
        for name, tensor in group.items():
            assert loaded[stem][name].dtype == tensor.dtype
            assert torch.equal(loaded[stem][name], tensor)


def test_layout_is_as_documented(folder: Path) -> None:
    assert folder.name == "step-000000000600"
    assert checkpoint.step_of(folder) == 600
    assert {p.name for p in folder.iterdir()} == {
        "manifest.json",
        "state.json",
        "policy.safetensors",
        "numbers.safetensors",
    }
    assert [p.name for p in folder.parent.iterdir()] == [folder.name]


def test_empty_tensors_and_float_that_is_not_finite(tmp_path: Path) -> None:
    loaded, state = checkpoint.load(checkpoint.save(tmp_path / "c", {}, {"best": float("-inf")}))
    assert (loaded, state) == ({}, {"best": None})


def flip_byte(folder: Path) -> None:
    path = folder / "policy.safetensors"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(bytes(content))


def truncate(folder: Path) -> None:
    path = folder / "policy.safetensors"
    path.write_bytes(path.read_bytes()[:-1])


def rewrite_manifest(**changes: object):  # a manifest that matches the folder except for these
    def damage(folder: Path) -> None:
        path = folder / "manifest.json"
        path.write_bytes(checkpoint._manifest_text({**json.loads(path.read_text()), **changes}))

    return damage


def rewrite_plain(folder: Path, **changes: object) -> None:
    """An edited manifest with its old hash."""
    path = folder / "manifest.json"
    manifest = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({k: v for k, v in manifest.items() if v is not None}, indent=2) + "\n")


def swap_for_link(folder: Path) -> None:
    path = folder / "policy.safetensors"
    elsewhere = folder.parent.parent / "elsewhere.safetensors"
    os.rename(path, elsewhere)
    path.symlink_to(elsewhere)


def make_folder(folder: Path) -> None:
    (folder / "policy.safetensors").unlink()
    (folder / "policy.safetensors").mkdir()


def declare(name: str):
    def damage(folder: Path) -> None:
        path = folder / "manifest.json"
        manifest = json.loads(path.read_text())
        manifest["files"][name] = manifest["files"]["policy.safetensors"]
        path.write_bytes(checkpoint._manifest_text(manifest))

    return damage


DAMAGES = {
    "flipped byte": (flip_byte, "policy.safetensors", "SHA-256"),
    "truncated": (truncate, "policy.safetensors", "bytes"),
    "missing": (lambda f: (f / "policy.safetensors").unlink(), "policy.safetensors", "missing"),
    "missing state": (lambda f: (f / "state.json").unlink(), "state.json", "missing"),
    "missing manifest": (lambda f: (f / "manifest.json").unlink(), "manifest.json", "missing"),
    "undeclared": (lambda f: (f / "more.safetensors").write_bytes(b"x"), "more.safetensors", "not declared"),
    "undeclared hidden": (lambda f: (f / ".more").write_bytes(b"x"), ".more", "not declared"),
    "link": (swap_for_link, "policy.safetensors", "regular file"),
    "folder for a file": (make_folder, "policy.safetensors", "regular file"),
    "parent": (declare("../outside.safetensors"), "manifest.json", "plain NAME"),
    "backslash": (declare("a\\b.safetensors"), "manifest.json", "plain NAME"),
    "absolute": (declare("/etc/passwd"), "manifest.json", "plain NAME"),
    "another ending": (declare("weights.pt"), "manifest.json", "plain NAME"),
    "changed state": (lambda f: (f / "state.json").write_text("{}\n"), "state.json", "bytes"),
    "torn manifest": (lambda f: (f / "manifest.json").write_text('{"format":'), "manifest.json", "JSON"),
    "manifest is a list": (lambda f: (f / "manifest.json").write_text("[]"), "manifest.json", "manifest of"),
    "no files": (rewrite_manifest(files=[]), "manifest.json", "state.json"),
    "file entry is a number": (rewrite_manifest(files={"state.json": 3}), "checkpoint", ""),
    "newer version": (rewrite_manifest(version=99), "manifest.json", "99"),
    "older version": (rewrite_manifest(version=1), "manifest.json", "reads 2"),
    "another step": (rewrite_manifest(step=601), "manifest.json", "of step 601"),
    "manifest without its hash": (
        lambda f: rewrite_plain(f, sha256=None),
        "manifest.json",
        "its own SHA-256",
    ),
    "manifest with another hash": (
        lambda f: rewrite_plain(f, step=600.0),
        "manifest.json",
        "its own SHA-256",
    ),
    "manifest with a space more": (
        lambda f: (f / "manifest.json").write_text((f / "manifest.json").read_text() + " "),
        "manifest.json",
        "its own SHA-256",
    ),
    "manifest too deep": (
        lambda f: rewrite_plain(f, deep=json.loads("[" * 900 + "]" * 900)),
        "manifest.json",
        "",
    ),
    "another format": (rewrite_manifest(format="zip"), "manifest.json", "manifest of"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damage_is_refused_and_named(folder: Path, name: str) -> None:
    damage, file, reason = DAMAGES[name]
    damage(folder)
    for read in (checkpoint.load, checkpoint.verify):
        with pytest.raises(CheckpointError) as error:
            read(folder)
        assert file in str(error.value)
        assert reason in str(error.value)


def test_every_single_byte_counts(tmp_path: Path) -> None:
    folder = checkpoint.save(tmp_path / "c", {"p": {"w": torch.zeros(2)}}, {"step": 1})
    for name in ("p.safetensors", "state.json"):
        path = folder / name
        whole = path.read_bytes()
        for position in range(len(whole)):
            path.write_bytes(whole[:position] + bytes([whole[position] ^ 255]) + whole[position + 1 :])
            with pytest.raises(CheckpointError, match="SHA-256"):
                checkpoint.verify(folder)
        path.write_bytes(whole)
    checkpoint.verify(folder)


@pytest.mark.parametrize("stem", ["", "../x", "a/b", ".hidden", "a b", "x" * 65, "-"])
def test_file_stems_are_plain_names(tmp_path: Path, stem: str) -> None:
    with pytest.raises(CheckpointError, match="stem"):
        checkpoint.save(tmp_path / "c", {stem: {}}, {})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("where", ["os.write", "os.fsync", "os.rename", "os.mkdir"])
@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()])
def test_a_save_that_fails_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str, error: BaseException
) -> None:
    def fail(*_args: object, **_kwargs: object) -> None:
        raise error

    monkeypatch.setattr(where, fail)
    with pytest.raises(CannotWrite if isinstance(error, OSError) else type(error)):
        checkpoint.save(tmp_path / "c", tensors(), STATE)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("cause", "number", "advice"),
    [
        (OSError(28, "No space left on device"), 28, "Make room on the disk"),
        (OSError(30, "Read-only file system"), 30, "read-only"),
        (PermissionError(13, "Permission denied"), 13, "permission"),
        (SafetensorError("No space left on device (os error 28)"), 28, "Make room on the disk"),
    ],
)
def test_disk_errors_name_the_path_and_the_remedy(
    tmp_path: Path, cause: Exception, number: int, advice: str
) -> None:
    with pytest.raises(CannotWrite) as error, writing(tmp_path / "c"):
        raise cause
    assert isinstance(error.value, OSError) and error.value.errno == number
    assert f"{tmp_path / 'c'} cannot be written" in str(error.value)
    assert advice in str(error.value) and str(cause.args[-1]) in str(error.value)


def test_the_manifest_names_the_versions_that_wrote_it(folder: Path) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    assert set(manifest) == {
        "format", "version", "step", "files", "versions", "settings_sha256", "sha256"
    }  # fmt: skip
    for name, entry in manifest["files"].items():
        content = (folder / name).read_bytes()
        assert entry == {"size": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    assert manifest["versions"]["torch"] == torch.__version__
    assert set(manifest["versions"]) >= {"python", "tightrope", "processor", "torch"}
    own = {name: value for name, value in manifest.items() if name != "sha256"}
    text = json.dumps(own, sort_keys=True, separators=(",", ":")).encode()
    assert manifest["sha256"] == hashlib.sha256(text).hexdigest()
    assert manifest["settings_sha256"] is None  # there are none in this state


def test_the_settings_have_a_hash_of_their_own(tmp_path: Path) -> None:
    settings = {"seed": 1, "clip": 0.2, "name": "Grüße"}
    folder = checkpoint.save(tmp_path / "c", {}, {"settings": settings})
    text = json.dumps(settings, sort_keys=True, separators=(",", ":")).encode()
    wanted = hashlib.sha256(text).hexdigest()
    assert checkpoint.read_manifest(folder)["settings_sha256"] == wanted


def test_a_manifest_imports_no_library(tmp_path: Path) -> None:
    code = (
        "import sys\nfrom pathlib import Path\nfrom tightrope.runs import checkpoint, versions\n"
        f"checkpoint.save(Path({str(tmp_path / 'c')!r}), {{}}, {{}})\n"
        "assert not {'torch', 'gymnasium', 'transformers'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert set(checkpoint.read_manifest(tmp_path / "c")["versions"]) <= {
        "python",
        "tightrope",
        "processor",
        "numpy",
    }


def test_other_versions_are_reported(folder: Path) -> None:
    written = checkpoint.read_manifest(folder)["versions"]
    assert versions.version_changes(written) == ""
    assert versions.version_changes({**written, "torch": "1.0"}) == f"torch 1.0 -> {torch.__version__}"


DTYPES = [
    torch.bool, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64, torch.uint16, torch.uint32,
    torch.uint64, torch.float16, torch.bfloat16, torch.float32, torch.float64,
]  # fmt: skip


def test_every_reader_of_safetensors_reads_ours(tmp_path: Path) -> None:
    """The same tensors as the safetensors writer, for every dtype and shape, with views and empty ones."""
    random = torch.Generator().manual_seed(0)
    wanted = {}
    for dtype in DTYPES:
        name, numbers = str(dtype), torch.randint(0, 2, (3, 4), generator=random)
        values = numbers.to(dtype)
        wanted |= {f"{name} matrix": values, f"{name} view": values.T, f"{name} none": values[:0]}
        wanted |= {f"{name} scalar": values[1, 2], f"{name} column": values[:, 1]}
    (tmp_path / "x.safetensors").write_bytes(b"".join(safetensors_bytes(wanted)))
    read = load_file(tmp_path / "x.safetensors")
    assert set(read) == set(wanted)
    for name, tensor in wanted.items():
        assert read[name].dtype == tensor.dtype and read[name].shape == tensor.shape
        assert torch.equal(read[name], tensor)
    with pytest.raises(ValueError, match="z is a tensor of complex64"):
        list(safetensors_bytes({"z": torch.zeros(1, dtype=torch.complex64)}))


def test_a_failed_replacement_keeps_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = checkpoint.save(tmp_path / "best", {}, {"step": 1})
    with monkeypatch.context() as patch:
        patch.setattr(
            "tightrope.runs.checkpoint.write_file",
            lambda *_, **__: (_ for _ in ()).throw(OSError("disk full")),
        )
        with pytest.raises(OSError, match="disk full"):
            checkpoint.save(folder, {}, {"step": 2})
    assert checkpoint.load(folder)[1] == {"step": 1}
    checkpoint.save(folder, {}, {"step": 2})
    assert checkpoint.load(folder)[1] == {"step": 2}
    assert [p.name for p in tmp_path.iterdir()] == ["best"]


def test_a_crash_between_the_two_renames_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = checkpoint.save(tmp_path / "best", {}, {"step": 1})
    rename, calls = os.rename, []

    def second_fails(source: Path, target: Path) -> None:
        calls.append(source)
        if len(calls) == 2:
            raise OSError("crash")
        rename(source, target)

    with monkeypatch.context() as patch:
        patch.setattr("os.rename", second_fails)
        with pytest.raises(OSError, match="crash"):
            checkpoint.save(folder, {}, {"step": 2})
    assert checkpoint.load(folder)[1] == {"step": 1}
    checkpoint.save(folder, {}, {"step": 3})
    assert checkpoint.load(folder)[1] == {"step": 3}
    assert [p.name for p in tmp_path.iterdir()] == ["best"]


def test_newest_is_the_newest_valid_one(tmp_path: Path) -> None:
    for step in (100, 900, 1000):
        checkpoint.save(checkpoint.step_folder(tmp_path, step), tensors(), {"step": step})
    (tmp_path / f"{TEMPORARY}step-000000002000-0").mkdir()
    (tmp_path / "step-99").mkdir()
    assert retention.valid(tmp_path).folder.name == "step-000000001000"
    flip_byte(tmp_path / "step-000000001000")
    with pytest.warns(UserWarning, match=r"passed over.*step-000000001000"):
        assert retention.valid(tmp_path).folder.name == "step-000000000900"
    told: list[str] = []
    assert retention.valid(tmp_path, told.append).state == {"step": 900}
    assert len(told) == 1 and "policy.safetensors" in told[0]


def test_newest_without_a_valid_one(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no checkpoint"):
        retention.valid(tmp_path / "absent")
    folder = checkpoint.save(checkpoint.step_folder(tmp_path, 1), tensors(), {})
    flip_byte(folder)
    with (
        pytest.warns(UserWarning, match="passed over"),
        pytest.raises(CheckpointError, match="no valid.*policy"),
    ):
        retention.valid(tmp_path)


def test_leftovers_of_a_crash_go_and_nothing_else(tmp_path: Path) -> None:
    kept = checkpoint.save(checkpoint.step_folder(tmp_path, 5), {}, {})
    leftover = tmp_path / f"{TEMPORARY}step-000000000006-ab"
    leftover.mkdir()
    (leftover / "state.json").write_text("{")
    remove_leftovers(tmp_path)
    assert list(tmp_path.iterdir()) == [kept]


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"nowhere.*no such folder"):
        checkpoint.load(tmp_path / "nowhere")


@pytest.mark.parametrize("error", [KeyError("steps"), ValueError("shape"), RuntimeError("size mismatch")])
def test_a_state_that_is_not_understood_is_the_checkpoint_s_fault(tmp_path: Path, error: Exception) -> None:
    with (
        pytest.raises(CheckpointError, match="does not hold what belongs there"),
        checkpoint.understood(tmp_path),
    ):
        raise error


@pytest.mark.parametrize(
    "error", [EnvironmentFault("env 3 raised"), torch.OutOfMemoryError(), OSError("disk")]
)
def test_what_else_goes_wrong_is_not(tmp_path: Path, error: Exception) -> None:
    with pytest.raises(type(error)), checkpoint.understood(tmp_path):
        raise error
