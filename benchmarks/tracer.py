"""The path of one update through the files of the package: how often it changes file, and how many it enters.

    python benchmarks/tracer.py                                # figures and files of both stories
    python benchmarks/tracer.py control --list                 # and the sequence itself
    python benchmarks/tracer.py --save benchmarks/results/tracer.json

Each story is traced at its smallest, in this process, on one thread:

    control   PPO on a task of this script: torch engine, serial, one environment, two steps, one epoch, one
              minibatch; the second update, because the first one also warms up the statistics. From the
              first ``step`` of the environment to the optimiser's first ``step``
    language  ``align`` on the packaged glassllm: one prompt, two new tokens, a head as critic, a function as
              reward, one epoch, one minibatch. From the first ``forward`` of the model after the run has
              reported its start (the prompt enters) to the optimiser's first ``step``

Everything runs once before it is traced, so that imports do not count. Definitions:

    a file     the file of the innermost running function of the package. Work in torch, numpy or transformers
               belongs to the file that called them
    a call     counts once per call site: a function called again by the same caller at the same place, as in
               a loop, is the same call. New calls that it makes the second time are added to it, so every
               loop body is traversed once
    a change   a call into another file, or a return to another file; calls within a file do not count

Other versions of Python may make other calls (from 3.12 on a comprehension is not a call): compare on one
version.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "tightrope"
OPTIMISER = str(Path("torch", "optim", "adam.py"))
MODELS = str(Path("transformers", "models"))

# ------------------------------------------------------------------------------------- the tracer


@dataclass
class Call:
    """A call of a function of the package; ``inner``: its own calls, by place and function."""

    file: str
    name: str = ""
    inner: dict[tuple[int, CodeType], Call] = field(default_factory=dict)


class Tracer:
    """Records calls between files below ``package``, from the frame where ``begins`` holds to ``ends``."""

    def __init__(
        self, package: Path, begins: Callable[[FrameType], bool], ends: Callable[[FrameType], bool]
    ) -> None:
        self.package, self.begins, self.ends = str(package.resolve()) + "/", begins, ends
        self.root = Call("")
        self.first: list[Call] = []  # the calls that were active at the beginning, the outermost first
        self.last: list[Call] = []  # and at the end
        self._stack: list[tuple[FrameType, Call]] = []
        self._names: dict[CodeType, str | None] = {}
        self.state = "waiting"

    def run(self, action: Callable[[], Any]) -> None:
        """Trace one action. RuntimeError if the beginning or the end was not reached."""
        sys.setprofile(self._see)
        try:
            action()
        finally:
            sys.setprofile(None)
        if self.state != "ended":
            raise RuntimeError(f"the tracer is {self.state}: its beginning or its end was not met")

    def _see(self, frame: FrameType, event: str, _: Any) -> None:
        if self.state == "ended" or event not in ("call", "return"):
            return
        if self.state == "waiting":
            if event == "call" and self.begins(frame):
                self._begin(frame)
            return
        if event == "call" and self.ends(frame):
            self.state, self.last = "ended", [call for _, call in self._stack]
            sys.setprofile(None)
        elif self._file(frame) is not None:
            if event == "call":
                self._enter(frame)
            elif self._stack and self._stack[-1][0] is frame:
                self._stack.pop()

    def _begin(self, frame: FrameType) -> None:
        frames, outer = [], frame.f_back
        while outer is not None:
            if self._file(outer) is not None:
                frames.append(outer)
            outer = outer.f_back
        if self._file(frame) is not None:
            frames.insert(0, frame)
        for known in reversed(frames):
            self._enter(known)
        self.state, self.first = "tracing", [call for _, call in self._stack]

    def _enter(self, frame: FrameType) -> None:
        caller, call = self._stack[-1] if self._stack else (None, self.root)
        key = (-1 if caller is None else caller.f_lasti, frame.f_code)
        file = self._file(frame) or ""
        self._stack.append((frame, call.inner.setdefault(key, Call(file, frame.f_code.co_qualname))))

    def _file(self, frame: FrameType) -> str | None:
        """The file of a frame, relative to the package; None outside it."""
        code = frame.f_code
        if code not in self._names:
            path = code.co_filename
            inside = path.startswith(self.package) and code.co_name != "<module>"
            self._names[code] = path[len(self.package) :] if inside else None
        return self._names[code]

    # --------------------------------------------------------------------------------- what was seen

    def visits(self) -> list[tuple[str, str]]:
        """(file, function) of every call and every return, in order, from the beginning to the end."""
        begun = {id(call) for call in self.first}
        open_ = {id(call) for call in self.last}
        return list(self._walk(self.root, begun, open_))

    def _walk(self, call: Call, begun: set[int], open_: set[int]) -> Iterator[tuple[str, str]]:
        inner = list(call.inner.values())
        begins_here = self.first and call is self.first[-1]
        if call is not self.root and (begins_here or id(call) not in begun):
            yield call.file, call.name
        for place, child in enumerate(inner):
            yield from self._walk(child, begun, open_)
            if call is not self.root and not (id(child) in open_ and place == len(inner) - 1):
                yield call.file, call.name

    def files(self) -> list[str]:
        """The executed files, in order; no two neighbours are the same."""
        return collapsed([file for file, _ in self.visits()])


def collapsed(names: list[str]) -> list[str]:
    """Names without consecutive repeats."""
    return [name for place, name in enumerate(names) if not place or names[place - 1] != name]


# ------------------------------------------------------------------------------------- the stories


def optimiser_steps(frame: FrameType) -> bool:
    """Whether torch's Adam begins its step."""
    return frame.f_code.co_name == "step" and frame.f_code.co_filename.endswith(OPTIMISER)


def control() -> Tracer:
    """One update of PPO on a task of this script."""
    import gymnasium
    import numpy as np

    import tightrope

    class Walk(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        action_space = gymnasium.spaces.Discrete(2)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return np.zeros(2, np.float32), {}

        def step(self, action):
            return np.full(2, 0.1 * action, np.float32), float(action), False, False, {}

    def update() -> Callable[[], Any]:
        agent = tightrope.PPO(
            Walk, seed=1, engine="torch", vector_backend="serial", num_envs=1, num_steps=2, num_epochs=1,
            minibatch_size=2, threads=1, notify=lambda text: None,
        )  # fmt: skip
        updates = agent.iterate(8)
        next(updates)  # the first one also gives observations their statistics, once a run
        return lambda: next(updates)

    def steps(frame: FrameType) -> bool:
        return frame.f_code is Walk.step.__code__

    update()()
    tracer = Tracer(PACKAGE, steps, optimiser_steps)
    tracer.run(update())
    return tracer


def language() -> Tracer:
    """One update of `align` on the packaged model."""
    import warnings

    import transformers

    from tightrope.language import align
    from tightrope.training.events import Event, Started

    def reward(prompts: list[str], completions: list[str], **columns: Any) -> list[float]:
        return [float(len(text)) for text in completions]

    started = []

    def listen(event: Event) -> None:
        if isinstance(event, Started):
            started.append(event)

    def update() -> None:
        started.clear()
        with tempfile.TemporaryDirectory(prefix="tracer-") as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            align(
                model="glassllm", prompts=["the film was"], reward=reward, total_episodes=1, batch_size=1,
                minibatch_size=1, num_epochs=1, max_new_tokens=2, critic="head", reward_timeout=None, seed=1,
                threads=1, checkpoint_every=None, run_dir=Path(folder) / "run", listeners=[listen],
            )  # fmt: skip

    def prompt_enters(frame: FrameType) -> bool:
        code = frame.f_code
        return bool(started) and code.co_name == "forward" and MODELS in code.co_filename

    transformers.utils.logging.disable_progress_bar()
    update()
    tracer = Tracer(PACKAGE, prompt_enters, optimiser_steps)
    started.clear()
    tracer.run(update)
    return tracer


STORIES = {"control": control, "language": language}


# ------------------------------------------------------------------------------------- the report


def figures(tracer: Tracer) -> dict[str, Any]:
    """The figures of a traced update: changes of file, files entered with their sizes, and the sequence."""
    from code_lines import code_lines

    sequence = tracer.files()
    sizes = {}
    for name in dict.fromkeys(sequence):
        source = (PACKAGE / name).read_text(encoding="utf-8")
        sizes[name] = {"lines": len(source.splitlines()), "code": code_lines(source)}
        sizes[name]["visits"] = sequence.count(name)
    return {
        "changes": len(sequence) - 1, "files": len(sizes), "lines": sum(x["lines"] for x in sizes.values()),
        "code": sum(x["code"] for x in sizes.values()), "entered": sizes, "sequence": sequence,
    }  # fmt: skip


def text(story: str, found: dict[str, Any], listed: bool) -> str:
    """The figures as readable text."""
    lines = [
        f"{story}: {found['changes']} changes of file, {found['files']} files entered, "
        f"{found['lines']:,} lines ({found['code']:,} of code)"
    ]
    lines += [f"  {'lines':>5} {'code':>5} {'visits':>6}  file"]
    for name, row in found["entered"].items():
        lines.append(f"  {row['lines']:5} {row['code']:5} {row['visits']:6}  {name}")
    if listed:
        lines += ["  the sequence:", *(f"  {place:5} {n}" for place, n in enumerate(found["sequence"]))]
    return "\n".join(lines)


def main(words: list[str] | None = None) -> int:
    """Trace the requested stories."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("stories", nargs="*", metavar="STORY", help="control, language; none: both")
    parser.add_argument("--list", action="store_true", help="print the sequence of files")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--save", type=Path, metavar="FILE", help="JSON to write")
    given = parser.parse_args(words)
    if unknown := [story for story in given.stories if story not in STORIES]:
        parser.error(f"there is no story {unknown[0]}; expected {' or '.join(STORIES)}")
    from code_lines import commit

    command = " ".join(["python", "benchmarks/tracer.py", *(sys.argv[1:] if words is None else words)])
    traced = {story: figures(STORIES[story]()) for story in given.stories or STORIES}
    found = {"command": command, "commit": commit(), "python": platform.python_version(), "stories": traced}
    if given.json:
        print(json.dumps(found, indent=1))
    else:
        print("\n\n".join(text(story, one, given.list) for story, one in traced.items()))
    if given.save:
        given.save.write_text(json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT / "src"))
    sys.exit(main())
