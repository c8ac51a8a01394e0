"""The tools that measure the code, on cases with known answers: lines, imports, calls, hashes."""

from __future__ import annotations

import copy
import importlib.util
import re
import sys
import textwrap
from pathlib import Path
from typing import Any

import pytest

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


def tool(name: str) -> Any:
    """A file of benchmarks/ as a module."""
    spec = importlib.util.spec_from_file_location(f"house_{name}", BENCHMARKS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look up their module
    sys.path.insert(0, str(BENCHMARKS))
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(BENCHMARKS))  # tests have folders called language and control
    return module


lines, tracer, ruler = tool("code_lines"), tool("tracer"), tool("ruler")


def written(folder: Path, **files: str) -> Path:
    """A package called toy; ``a__b`` is the file b of its folder a."""
    package = folder / "toy"
    for name, source in {"__init__": "", **files}.items():
        path = package.joinpath(*name.split("__") if not name.startswith("_") else [name]).with_suffix(".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(textwrap.dedent(source))
    return package


# ------------------------------------------------------------------------------------- lines


SOURCE = '''"""A docstring
of two lines."""

# a comment
import os  # and another


class A:
    """One line."""

    x = """a string
    of two lines"""

    def f(self): "A docstring beside code."; return (
            1,

            2,  # 2
        )
'''


def test_code_lines_are_neither_blank_nor_comment_nor_docstring():
    """import, class, x and its second line, def, 1, 2 and the bracket: eight."""
    assert lines.code_lines(SOURCE) == 8


@pytest.mark.parametrize("source", ["", "\n\n# words\n", '"""A docstring."""\n'])
def test_nothing_is_no_code(source: str):
    assert lines.code_lines(source) == 0


def test_chains_are_counted_anywhere_and_at_the_top(tmp_path: Path):
    """a > b > c at the top; only a function reaches d, only type checkers reach e."""
    package = written(
        tmp_path,
        a="from toy import b\n",
        b="import toy.c\n",
        c="""
            from typing import TYPE_CHECKING
            if TYPE_CHECKING:
                from toy.e import x
            def f():
                from .d import y
            """,
        d="from .e import x\n",
        e="x = 1\n",
    )
    graph = {path: lines.imported(path, package) for path in lines.files(package)}
    top = {path: lines.imported(path, package, top=True) for path in graph}
    assert [path.stem for path in lines.longest_chain(graph)] == ["a", "b", "c", "d", "e"]
    assert [path.stem for path in lines.longest_chain(top)] == ["a", "b", "c"]
    found = lines.measured(package)
    assert found["files"] == 5 and found["code"] == 9
    assert found["chains"]["."]["anywhere"]["files"] == 5


def test_a_cycle_is_one_group(tmp_path: Path):
    package = written(
        tmp_path, a="import toy.b\n", b="import toy.c\n", c="import toy.b\nimport toy.d\n", d=""
    )
    graph = {path: lines.imported(path, package) for path in lines.files(package)}
    assert [path.stem for path in lines.longest_chain(graph)] == ["a", "b", "c", "d"]
    assert {path.stem for path in lines.circles(graph)[package / "c.py"]} == {"b", "c"}


# ------------------------------------------------------------------------------------- the tracer

TOY = {
    "loop": """
        from toy import work
        def run(times):
            for number in range(times):
                work.begin()
                work.act(number)
            for value in work.generated(times):
                work.act(0)
            return work.finish()
        """,
    "work": """
        from toy.deep import more, rare
        def begin(): pass
        def act(number):
            more()
            if number == 1:
                rare()
        def generated(times):
            for _ in range(times):
                yield more()
        def finish(): pass
        """,
    "deep": "def more(): pass\ndef rare(): pass\n",
}


def way(package: Path, times: int, begins: str = "begin", ends: str = "finish") -> list[str]:
    """The files of a run of the toy, without their ending."""
    sys.path.insert(0, str(package.parent))
    try:
        from toy import loop  # type: ignore[import-not-found]

        found = tracer.Tracer(
            package, lambda f: f.f_code.co_name == begins, lambda f: f.f_code.co_name == ends
        )
        found.run(lambda: loop.run(times))
    finally:
        sys.path.remove(str(package.parent))
        for name in [name for name in sys.modules if name.split(".")[0] == "toy"]:
            del sys.modules[name]
    return [name.removesuffix(".py") for name in found.files()]


def test_a_loop_is_walked_once(tmp_path: Path):
    """begin (in work), loop, act, more, act, loop, the generator, more, the generator, loop, act, more, act,
    loop; the end is reached from loop. How often the loops run changes nothing.
    """
    package = written(tmp_path, **TOY)
    assert way(package, 1) == ["work", "loop", *["work", "deep", "work", "loop"] * 3]


def test_what_only_the_second_round_does_is_added(tmp_path: Path):
    """Only the second act calls rare: from work to deep and back once more, for any number of loops."""
    package = written(tmp_path, **TOY)
    first = ["work", "loop", "work", "deep", "work", "deep", "work", "loop"]
    expected = [*first, *["work", "deep", "work", "loop"] * 2]
    assert way(package, 2) == expected
    assert way(package, 50) == expected


def test_a_trace_begins_and_ends_at_the_given_frames(tmp_path: Path):
    package = written(tmp_path, **TOY)
    assert way(package, 1, begins="act", ends="generated") == ["work", "deep", "work", "loop"]
    with pytest.raises(RuntimeError, match="waiting"):
        way(package, 1, begins="nowhere")
    with pytest.raises(RuntimeError, match="tracing"):
        way(package, 1, ends="nowhere")


# ------------------------------------------------------------------------------------- the ruler


def answer(**changes: Any) -> dict[str, Any]:
    """The results of a run, with a changed metric of a row, or a tensor's changed bytes or name."""
    tensors = {changes.get("name", "newest/policy:w"): changes.get("tensor", "1"), "newest/policy:b": "2"}
    rows = [{"step": 1, "loss": changes.get("loss", 0.5), "seconds": changes.get("seconds", 1.0)}]
    return {
        "tensors": {
            "values": ruler.digest(" ".join(sorted(tensors.values()))),
            "names": ruler.digest(str(sorted(tensors.items()))),
            "each": tensors,
        },
        "rows": {"metrics.jsonl": ruler.table(rows * changes.get("count", 1))},
    }


@pytest.mark.parametrize("changes, said", [
    ({}, []),
    ({"seconds": 9.0}, []),
    ({"tensor": "3"}, ["tensors differ: newest/policy:w"]),
    ({"name": "newest/actor:w"}, [
        "tensors have other names, and the same values: -newest/policy:w, +newest/actor:w"]),
    ({"loss": 0.5000000001}, ["metrics.jsonl differs: loss"]),
    ({"count": 2}, ["metrics.jsonl has 2 rows, had 1"]),
])  # fmt: skip
def test_the_ruler_names_what_differs(changes: dict[str, Any], said: list[str]):
    assert ruler.differences(answer(), answer(**changes)) == said


def test_other_names_may_be_accepted_and_other_values_may_not():
    assert not ruler.differences(answer(), answer(name="newest/actor:w"), renamed=True)
    assert ruler.differences(answer(), answer(tensor="3"), renamed=True)
    assert ruler.differences(answer(), {"failed": "no such flag"}) == ["failed: no such flag"]


def test_files_that_are_gone_and_broken_resumes_are_named():
    found = copy.deepcopy(answer())
    found["rows"]["samples.jsonl"] = found["rows"].pop("metrics.jsonl")
    found["resumed"] = ["tensors differ: newest/policy:w"]
    assert ruler.differences(answer(), found) == [
        "metrics.jsonl is gone",
        "samples.jsonl is new",
        "resumed: tensors differ: newest/policy:w",
    ]


def test_tensors_differ_by_bytes_shape_and_kind(tmp_path: Path):
    import torch
    from safetensors.torch import save_file

    last, old = tmp_path / "checkpoints" / "step-000000000020", tmp_path / "checkpoints" / "step-000000000010"
    for folder in (last, old):
        folder.mkdir(parents=True)
    zeros = {"a": torch.zeros(4), "b": torch.zeros(2, 2), "c": torch.zeros(4, dtype=torch.int32)}
    save_file(zeros | {"d": torch.zeros(4)}, last / "policy.safetensors")
    save_file({"e": torch.ones(1)}, old / "policy.safetensors")
    found = ruler.tensors_of(tmp_path)
    assert set(found) == {f"newest/policy:{name}" for name in "abcd"}
    assert len(set(found.values())) == 3 and found["newest/policy:a"] == found["newest/policy:d"]


def test_the_last_of_a_flag_counts():
    words = ["train", "X", "--a", "1", "--b", "--c", "2", "3", "--a", "4"]
    assert ruler.once(words) == ["train", "X", "--a", "4", "--b", "--c", "2", "3"]


def test_every_clock_of_the_metrics_is_left_out():
    """Every documented metric of time or size on disk must be in the ruler's list."""
    pages = [(BENCHMARKS.parent / "docs" / name).read_text() for name in ("control.md", "rlhf.md")]
    names = {name for page in pages for name in re.findall(r"^\| `(time/\w+)`", page, re.MULTILINE)}
    assert len(names) >= 7 and names <= ruler.CLOCKS, names - ruler.CLOCKS
