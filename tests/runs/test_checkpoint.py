"""A checkpoint is whole or absent, comes back to the bit, and any damage is named and refused."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
import torch
from safetensors import SafetensorError

from tightrope.runs import checkpoint
from tightrope.runs.checkpoint import CheckpointError


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


def rewrite_manifest(**changes: object):  # a manifest that agrees with the folder in everything but these
    def damage(folder: Path) -> None:
        path = folder / "manifest.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))

    return damage


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
        path.write_text(json.dumps(manifest))

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


@pytest.mark.parametrize("where", ["safetensors.torch.save_file", "os.fsync", "os.rename"])
@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()])
def test_a_save_that_fails_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str, error: BaseException
) -> None:
    def fail(*_args: object, **_kwargs: object) -> None:
        raise error

    monkeypatch.setattr(where, fail)
    with pytest.raises(type(error)):
        checkpoint.save(tmp_path / "c", tensors(), STATE)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_an_error_of_the_system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_args: object, **_kwargs: object) -> None:
        raise SafetensorError("No space left on device (os error 28)")

    monkeypatch.setattr("safetensors.torch.save_file", fail)
    with pytest.raises(OSError, match=r"c cannot be written \(No space left.* Make room on the disk"):
        checkpoint.save(tmp_path / "c", tensors(), STATE)
    assert list(tmp_path.iterdir()) == []


def test_a_failed_replacement_keeps_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = checkpoint.save(tmp_path / "best", {}, {"step": 1})
    with monkeypatch.context() as patch:
        patch.setattr(
            "tightrope.runs.checkpoint.write_json", lambda *_: (_ for _ in ()).throw(OSError("disk full"))
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
    (tmp_path / f"{checkpoint.TEMPORARY}step-000000002000-0").mkdir()
    (tmp_path / "step-99").mkdir()
    assert checkpoint.newest(tmp_path).name == "step-000000001000"
    flip_byte(tmp_path / "step-000000001000")
    with pytest.warns(UserWarning, match=r"passed over.*step-000000001000"):
        assert checkpoint.newest(tmp_path).name == "step-000000000900"


def test_newest_without_a_valid_one(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no checkpoint"):
        checkpoint.newest(tmp_path / "absent")
    folder = checkpoint.save(checkpoint.step_folder(tmp_path, 1), tensors(), {})
    flip_byte(folder)
    with pytest.warns(UserWarning, match="passed over"), pytest.raises(CheckpointError, match="damaged"):
        checkpoint.newest(tmp_path)


def test_leftovers_of_a_crash_go_and_nothing_else(tmp_path: Path) -> None:
    kept = checkpoint.save(checkpoint.step_folder(tmp_path, 5), {}, {})
    leftover = tmp_path / f"{checkpoint.TEMPORARY}step-000000000006-ab"
    leftover.mkdir()
    (leftover / "state.json").write_text("{")
    checkpoint.remove_leftovers(tmp_path)
    assert list(tmp_path.iterdir()) == [kept]


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"nowhere.*no such folder"):
        checkpoint.load(tmp_path / "nowhere")
