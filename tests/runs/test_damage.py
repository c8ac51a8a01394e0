"""Any change to the bytes of a checkpoint is detected, the file is named, and the older one is used."""

from __future__ import annotations

import os
import random
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from tightrope.runs import checkpoint, retention
from tightrope.runs.checkpoint import CheckpointError

ROUNDS = 2_000
FILES = ("manifest.json", "state.json", "policy.safetensors", "optimiser.safetensors")


@pytest.fixture
def checkpoints(tmp_path: Path) -> Iterator[Path]:
    """Two steps whose files all differ."""
    for step in (100, 200):
        tensors = {
            "policy": {"w": torch.full((3, 3), step + 0.5), "b": torch.zeros(2)},
            "optimiser": {"moment": torch.full((4,), step, dtype=torch.float64)},
        }
        state = {"step": step, "settings": {"seed": 1}, "rng": 2**100 + step}
        checkpoint.save(checkpoint.step_folder(tmp_path / "checkpoints", step), tensors, state)
    yield tmp_path / "checkpoints"


def used(checkpoints: Path) -> tuple[int, str]:
    """The step in use, and the messages about the others."""
    told: list[str] = []
    point = retention.valid(checkpoints, told.append)
    assert point.state["step"] == checkpoint.step_of(point.folder)
    return point.state["step"], " ".join(told)


def test_every_flip_and_every_cut_is_seen(checkpoints: Path) -> None:
    newest, draw = checkpoints / "step-000000000200", random.Random(5)
    whole = {name: (newest / name).read_bytes() for name in FILES}
    assert {path.name for path in newest.iterdir()} == set(FILES)
    hit = set()
    for _ in range(ROUNDS):
        name = draw.choices(FILES, [len(whole[name]) for name in FILES])[0]
        place = draw.randrange(len(whole[name]))
        path, content = newest / name, bytearray(whole[name])
        if cut := draw.random() < 0.2:
            del content[place:]
        else:
            content[place] ^= draw.randrange(1, 256)
        path.write_bytes(content)
        step, told = used(checkpoints)
        assert step == 100 and str(path) in told, (name, place, cut, told)
        path.write_bytes(whole[name])
        hit.add((name, cut))
    assert used(checkpoints) == (200, "")
    assert hit == {(name, cut) for name in FILES for cut in (True, False)}


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_is_gone_is_named(checkpoints: Path, name: str) -> None:
    path = checkpoints / "step-000000000200" / name
    path.unlink()
    step, told = used(checkpoints)
    assert step == 100 and str(path) in told and "missing" in told


@pytest.mark.parametrize("name", FILES)
def test_files_swapped_between_steps_are_seen(checkpoints: Path, name: str) -> None:
    old, new = (checkpoints / f"step-000000000{step}00" / name for step in (1, 2))
    content = old.read_bytes(), new.read_bytes()
    assert content[0] != content[1]
    new.write_bytes(content[0])
    step, told = used(checkpoints)
    assert step == 100 and str(new.parent) in told
    assert name == "manifest.json" or name in told  # a valid manifest states another step
    old.write_bytes(content[1])
    with pytest.raises(CheckpointError, match="none of 2 can be used"):
        retention.valid(checkpoints, lambda text: None)


def test_whole_folders_that_changed_places_are_seen(checkpoints: Path) -> None:
    old, new = (checkpoints / f"step-000000000{step}00" for step in (1, 2))
    shutil.copytree(old, checkpoints / "copy")  # another name is no claim
    assert checkpoint.load(checkpoints / "copy")[1]["step"] == 100
    os.rename(new, checkpoints / "x")
    os.rename(old, new)
    with pytest.raises(CheckpointError, match=r"manifest\.json is of step 100"):
        retention.valid(checkpoints, lambda text: None)
