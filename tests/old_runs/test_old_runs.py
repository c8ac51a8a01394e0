"""Old runs stay readable: older run folders evaluate, load and resume to the same bits.

Each folder named after a day contains runs written by the code of that day, killed in the middle or finished.
Its `expected/` contains their results: actions, values, returns, scores, log-probabilities, samples, and
after a resume every row, weight, optimiser moment, generator and counter. `write.py` describes how they were
made.

Bits depend on the libraries and the processor. If both match the record, everything is compared bit for bit;
otherwise floats may differ by a tolerance, and nothing else may. The name of a test states which comparison
it used, its message why. No test is ever skipped.

If a change makes these tests fail on purpose: state its effect on old runs in the changelog, record their
results again (`write.py FOLDER --expected`), and write a new folder beside them. The run folders themselves
are never rewritten.
"""

from __future__ import annotations

import copy
import functools
import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from old_runs.comparison import ABSOLUTE, RELATIVE, SHOWN, How, differences, how, machine, require_same
from old_runs.outcomes import ASKED, ENVIRONMENTS
from safetensors.torch import load_file

from tightrope.cli.main import main
from tightrope.runs import checkpoint

HERE = Path(__file__).parent
DAYS = sorted(path for path in HERE.iterdir() if re.fullmatch(r"\d{4}-\d\d-\d\d", path.name))
FIRST = DAYS[0]


def read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def recorded(day: Path, name: str) -> dict[str, Any]:
    file = day / "expected" / name
    tensors = file.with_suffix(".safetensors")
    return {
        "numbers": read(file.with_suffix(".json")),
        "tensors": load_file(tensors) if tensors.exists() else {},
    }


here = functools.cache(machine)


def way_of(day: Path, name: str) -> How:
    return how(read(day / "expected" / "machine.json"), here(), language=ASKED[name][0] not in ENVIRONMENTS)


CASES = [
    pytest.param(day, name, id=f"{day.name}, {name}, {way_of(day, name).label}")
    for day in DAYS
    for name in ASKED
    if (day / "expected" / f"{name}.json").exists()
]


@pytest.fixture(autouse=True)
def own_threads() -> Any:
    """Runs set the threads of torch."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture
def stand_in(tmp_path, monkeypatch) -> Any:
    """Change into a copy of the folder of a day: paths in its runs are relative to it."""

    def go(day: Path) -> None:
        copied = tmp_path / day.name
        shutil.copytree(day, copied, ignore=shutil.ignore_patterns("expected"))
        monkeypatch.chdir(copied)

    return go


@pytest.mark.parametrize(("day", "name"), CASES)
def test_an_old_run_gives_what_it_gave(stand_in, day, name):
    stand_in(day)
    run, question = ASKED[name]
    found = question(run)
    require_same(recorded(day, name), found._asdict(), way_of(day, name), name)


@pytest.mark.parametrize("day", DAYS, ids=lambda day: day.name)
def test_the_command_evaluates_an_old_run(stand_in, capsys, day):
    stand_in(day)
    assert main(["evaluate", "cartpole", "--episodes", "3", "--json"]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    name = "cartpole-evaluated"
    require_same(recorded(day, name)["numbers"]["newest"], found, way_of(day, name), name)


def test_the_first_day_is_whole():
    """No question is missing, and every file of the runs matches its checkpoint."""
    assert FIRST.name == "2026-11-22"
    assert {path.stem for path in (FIRST / "expected").iterdir()} == {*ASKED, "machine"}
    folders = [path.parent for path in FIRST.rglob("manifest.json")]
    assert len(folders) == 16
    for folder in folders:
        checkpoint.load(folder)


def test_control_runs_of_the_first_day_are_refused_with_the_version(stand_in):
    stand_in(FIRST)
    for name in ENVIRONMENTS:
        files = {path: path.read_bytes() for path in sorted(Path(name).rglob("*")) if path.is_file()}
        assert main(["resume", name, "--quiet"]) == 2
        left = {path: path.read_bytes() for path in sorted(Path(name).rglob("*")) if path.is_file()}
        assert {k: v for k, v in left.items() if k.name != "writer.lock"} == {
            k: v for k, v in files.items() if k.name != "writer.lock"
        }
        assert "tightrope 0.1.0;" in recorded(FIRST, f"{name}-resumed")["numbers"]["refused"]


def test_a_resume_has_work_to_do():
    """A killed run has rows after its newest checkpoint, which a resume must cut off and repeat."""
    for name in ("sft-killed", "reward-killed", "align-killed"):
        run = FIRST / name
        rows = (run / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
        newest = max(int(path.name[5:]) for path in (run / "checkpoints").iterdir())
        end = recorded(FIRST, f"{name.removesuffix('-killed')}-resumed")["numbers"]
        assert newest < json.loads(rows[-1])["step"] < end["metrics.jsonl"][-1]["step"], name
        assert read(run / "writer.lock")["pid"] and not (run / "summary.json").exists()


# ------------------------------------------------------------------------------- the comparison can fail


def changed(value: Any, path: list[Any], new: Any) -> Any:
    """A copy with one thing replaced."""
    whole = copy.deepcopy(value)
    inside = whole
    for key in path[:-1]:
        inside = inside[key]
    inside[path[-1]] = new(inside[path[-1]])
    return whole


def one_weight(step: float):
    """The largest weight times 1 + step, or its next float32."""

    def new(tensor: torch.Tensor) -> torch.Tensor:
        flat = tensor.flatten().clone()
        place = int(flat.abs().argmax())
        more = torch.nextafter(flat[place], flat.new_tensor(torch.inf))
        flat[place] = more if step == 0 else flat[place] * (1 + step)
        return flat.view(tensor.shape)

    return new


METRIC = ["numbers", "metrics.jsonl", -1, "train/value_loss"]
WEIGHT = ["tensors", "policy/actor.0.weight"]
ROWS = ["numbers", "metrics.jsonl"]
ALWAYS = {
    "a metric": (METRIC, lambda x: x * (1 + 10 * RELATIVE) + 10 * ABSOLUTE),
    "a metric that is NaN now": (METRIC, lambda x: None),
    "a weight": (WEIGHT, one_weight(0.01)),
    "a weight that is NaN": (WEIGHT, one_weight(float("nan"))),
    "a dtype": (WEIGHT, lambda x: x.double()),
    "a shape": (WEIGHT, lambda x: x.T),
    "a whole number": (["numbers", "state", "steps"], lambda x: x + 1),
    "a generator": (["numbers", "state", "rng", "update", "state", "state"], lambda x: x + 1),
    "a word": (["numbers", "checkpoint"], lambda x: x[:-1] + "1"),
    "the length of an episode": (["numbers", "episodes.jsonl", 0, "length"], lambda x: x + 1),
    "a truth value": (["numbers", "episodes.jsonl", 0, "terminated"], lambda x: not x),
    "a row less": (ROWS, lambda rows: rows[:-1]),
    "a row more": (ROWS, lambda rows: [*rows, rows[-1]]),
    "a metric less": ([*ROWS, -1], lambda row: {k: v for k, v in row.items() if k != "train/clip"}),
    "a tensor less": (["tensors"], lambda x: {k: v for k, v in x.items() if k != WEIGHT[1]}),
}
LAST_BITS = {
    "a metric": (METRIC, lambda x: x * (1 + 1e-9)),
    "a weight": (WEIGHT, one_weight(0)),
    "the sign of a zero": (WEIGHT, lambda x: -x),
}


@pytest.fixture(scope="module")
def end() -> dict[str, Any]:
    """The end of a run of that day, which has everything that a record may have."""
    example = HERE / "example.json"
    return {"numbers": read(example), "tensors": load_file(example.with_suffix(".safetensors"))}


@pytest.mark.parametrize("bits", [True, False], ids=["to the bit", "within"])
@pytest.mark.parametrize("what", ALWAYS)
def test_a_change_is_found_either_way(end, what, bits):
    assert not differences(end, copy.deepcopy(end), bits)
    found = differences(end, changed(end, *ALWAYS[what]), bits)
    assert len(found) == 1, found


@pytest.mark.parametrize("what", LAST_BITS)
def test_last_bits_are_found_where_bits_are_compared(end, what):
    path, new = LAST_BITS[what]
    if "zero" in what:
        end = changed(end, path, torch.zeros_like)
    other = changed(end, path, new)
    assert len(differences(end, other, bits=True)) == 1
    assert not differences(end, other, bits=False)


def test_what_is_new_is_let_pass(end):
    more = changed(end, [*ROWS, -1], lambda row: {**row, "train/new": 1.0})
    assert not differences(end, more, bits=True)


def test_another_machine_has_a_tolerance_with_a_reason(end):
    was = read(FIRST / "expected" / "machine.json")
    assert how(was, dict(was)).bits
    for name in was:
        way = how(was, {**was, name: "9.9"})
        assert not way.bits and f"{name} {was[name]} -> 9.9" in str(way)
    assert how(was, {**was, "transformers": "9.9"}, language=False).bits
    assert not how(was, {**was, "numba": "9.9"}, language=False).bits
    with pytest.raises(AssertionError, match=r"1 differences, compared within .*because torch 2.* -> 9\.9"):
        require_same(end, changed(end, *ALWAYS["a weight"]), how(was, {**was, "torch": "9.9"}), "cartpole")
    many = changed(end, ROWS, lambda rows: [{} for _ in rows])
    with pytest.raises(AssertionError, match="compared to the bit, because versions and processor are as"):
        require_same(end, many, how(was, was), "cartpole")
    assert len(differences(end, many, bits=True)) > SHOWN
