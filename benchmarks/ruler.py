"""The ruler: a small run of every kind, and hashes of its results, which a refactoring must not change.

    python benchmarks/ruler.py record benchmarks/results/ruler.json   # before
    python benchmarks/ruler.py compare benchmarks/results/ruler.json  # after, on the same machine

``compare`` repeats all runs, names every kind, file, metric and tensor that differs, and exits with 1. It
uses only the public interface: the command line, ``tightrope`` and ``tightrope.language``, and the files of a
run. Each run is a separate process with one thread. These parts of each run are hashed:

    tensors   every .safetensors file of the newest checkpoint, best/, model/, adapter/ or a saved agent:
              ``values`` hashes the bytes without their names; ``names`` includes file and name
    rows      every .jsonl file: metrics, episodes, samples, answers; and the end in summary.json
    resumed   only runs of the command line: the same run is killed after its first checkpoint and resumed;
              lists the differences from the uninterrupted run, none if all is well

Clock times are excluded by name (see CLOCKS). Hashes are SHA-256, shortened to 16 digits. The last bits
depend on the processor and the library versions, which are recorded too: record again before a refactoring if
``compare`` reports that these differ. ``--quick`` skips the resumed runs; ``--renamed`` accepts renamed
tensors, for a refactoring that renames them on purpose.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from importlib import metadata
from pathlib import Path
from typing import Any

from ruler_kinds import KINDS, TASKS

ROOT = Path(__file__).resolve().parents[1]
CLOCKS = {
    "seconds", "wall_seconds", "steps_per_second", "date", "run_dir",  # the last one is a place, not a result
    "time/seconds", "time/fps", "time/env_seconds", "time/act_seconds", "time/update_seconds",
    "time/score_seconds", "time/generate_seconds", "time/tokens_per_second",
    "time/checkpoint_seconds", "time/checkpoint_megabytes",
}  # fmt: skip
LIBRARIES = ("torch", "numpy", "numba", "scipy", "gymnasium", "transformers", "tokenizers", "safetensors")
TRIES = 5  # to kill a run between its first checkpoint and its end


# ------------------------------------------------------------------------------------- what a run leaves


def digest(data: bytes | str) -> str:
    """SHA-256, its first 16 digits."""
    return hashlib.sha256(data.encode() if isinstance(data, str) else data).hexdigest()[:16]


def timeless(value: Any) -> Any:
    """A JSON value without clock times."""
    if isinstance(value, list):
        return [timeless(item) for item in value]
    if isinstance(value, dict):
        return {name: timeless(item) for name, item in value.items() if name not in CLOCKS}
    return value


def newest(run: Path) -> Path | None:
    """The newest checkpoint of a run."""
    found = sorted((run / "checkpoints").glob("step-*"))
    return found[-1] if found else None


def tensors_of(run: Path) -> dict[str, str]:
    """File and name -> hash of dtype, shape and bytes, for every tensor of a finished run."""
    import torch
    from safetensors.torch import load_file

    found, last = {}, newest(run)
    for path in sorted(run.rglob("*.safetensors")):
        inside = path.relative_to(run).parts
        if inside[0] == "checkpoints":
            if path.parent != last:
                continue
            inside = ("newest", *inside[2:])
        for name, tensor in load_file(path).items():
            head = f"{tensor.dtype} {tuple(tensor.shape)} ".encode()
            raw = tensor.contiguous().flatten().view(torch.uint8).numpy().tobytes()
            found[f"{'/'.join(inside)[: -len('.safetensors')]}:{name}"] = digest(head + raw)
    return found


def table(rows: list[Any]) -> dict[str, Any]:
    """Hashes of rows: of all rows, and of each column with its row numbers."""
    rows = timeless(rows)
    columns: dict[str, list[Any]] = {}
    for number, row in enumerate(rows):
        for name, value in (row if isinstance(row, dict) else {"value": row}).items():
            columns.setdefault(name, []).append([number, value])
    hashes = {name: digest(json.dumps(column, sort_keys=True)) for name, column in sorted(columns.items())}
    return {"count": len(rows), "all": digest(json.dumps(rows, sort_keys=True)), "columns": hashes}


def left(run: Path) -> dict[str, Any]:
    """The hashes of all results of a finished run."""
    tensors = tensors_of(run)
    if not tensors:
        raise RuntimeError(f"{run.name} left no tensors.")
    rows = {}
    for path in sorted(run.glob("*.jsonl")):
        rows[path.name] = table([json.loads(line) for line in path.read_text().splitlines()])
    if (run / "summary.json").exists():
        rows["summary.json"] = table([json.loads((run / "summary.json").read_text())])
    values = sorted(tensors.values())
    return {
        "tensors": {
            "count": len(values), "values": digest(" ".join(values)),
            "names": digest(json.dumps(tensors, sort_keys=True)), "each": tensors,
        },
        "rows": rows,
    }  # fmt: skip


# ------------------------------------------------------------------------------------- runs


def environment() -> dict[str, str]:
    """Environment variables for one thread and this checkout's package."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    path = os.pathsep.join(filter(None, (str(ROOT / "src"), os.environ.get("PYTHONPATH"))))
    return {**os.environ, **threads, "PYTHONPATH": path, "HF_HUB_OFFLINE": "1", "PYTHONHASHSEED": "0"}


def start(words: list[str], base: Path) -> subprocess.Popen[str]:
    """Start a process in ``base``, in its own process group, so that a kill also ends its workers."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    command = [sys.executable, *words]
    return subprocess.Popen(command, cwd=base, env=environment(), start_new_session=True, **pipes)


def ended(words: list[str], base: Path) -> None:
    """Wait for the end; RuntimeError with the output if it fails."""
    process = start(words, base)
    said, _ = process.communicate()
    if process.returncode:
        raise RuntimeError(f"{' '.join(words)} ended with {process.returncode}:\n{said[-4000:]}")


def commands(kind: str, run: str) -> tuple[list[str], list[str] | None]:
    """The command lines that run a kind and resume it, in the folder ``run``."""
    words = once(KINDS[kind].split())
    if words[0] in ("agents", "judged"):
        return [TASKS, words[0], run], None
    kept = [w for flag in ("--env-module", "--gold") if flag in words for w in (flag, flag_of(words, flag))]
    if words[0] == "align":
        kept += ["--reward", flag_of(words, "--reward")]
    program = ["-m", "tightrope"]
    return [*program, *words, "--run-dir", run, "--quiet"], [*program, "resume", run, *kept, "--quiet"]


def once(words: list[str]) -> list[str]:
    """The words with each flag once: the last value, at the position of the first."""
    found: dict[str, list[str]] = {}
    flag = words[0]
    for word in words:
        if word.startswith("--") or not found:
            flag = word
            found[flag] = []
        found[flag].append(word)
    return [word for parts in found.values() for word in parts]


def flag_of(words: list[str], flag: str) -> str:
    """The value of a flag."""
    return words[words.index(flag) + 1]


def killed(words: list[str], base: Path, run: str) -> int:
    """Kill a run once its first checkpoint is complete; returns the step of the newest one."""
    process = start(words, base)
    manifests = base / run / "checkpoints"
    while process.poll() is None and not list(manifests.glob("step-*/manifest.json")):
        time.sleep(0.001)
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
    said, _ = process.communicate()
    if process.returncode != -signal.SIGKILL and process.returncode:
        raise RuntimeError(f"{' '.join(words)} ended with {process.returncode}:\n{said[-4000:]}")
    last = newest(base / run)
    return -1 if (base / run / "summary.json").exists() or last is None else int(last.name[5:])


def resumed(kind: str, base: Path, whole: dict[str, Any]) -> list[str]:
    """Differences between the uninterrupted run and one that was killed and resumed."""
    for number in range(TRIES):
        run = f"{kind}-killed-{number}"
        words, again = commands(kind, run)
        if again is None:
            raise ValueError(f"{kind} cannot be resumed from the command line")
        if killed(words, base, run) > 0:
            ended(again, base)
            return differences(whole, left(base / run))
    raise RuntimeError(f"{kind} ended {TRIES} times before it could be killed; make it longer.")


def measured(kinds: list[str], base: Path, quick: bool) -> dict[str, Any]:
    """Kind -> its results, one run after the other; a kind that fails has ``failed`` with its output. The
    reward model runs before the kinds that need it.
    """
    from ruler_tasks import write_data

    shutil.copy(ROOT / "benchmarks" / TASKS, base)
    write_data(base)
    found = {}
    for kind in KINDS:
        needed = kind == "reward" and any("--reward reward" in KINDS[k] for k in kinds)
        if kind not in kinds and not needed:
            continue
        begin = time.monotonic()
        try:
            found[kind] = one(kind, base, quick)
        except RuntimeError as error:
            found[kind] = {"failed": str(error)}
        print(f"{kind:24} {told(found[kind])} {time.monotonic() - begin:5.1f} s", flush=True)
    return found


def one(kind: str, base: Path, quick: bool) -> dict[str, Any]:
    """Run a kind, and if possible again with a kill and a resume. RuntimeError if it fails."""
    words, again = commands(kind, kind)
    ended(words, base)
    found = left(base / kind)
    if again is not None and not quick:
        found["resumed"] = resumed(kind, base, found)
    return found


def told(found: dict[str, Any]) -> str:
    """The results of a run in one line."""
    if "failed" in found:
        return "failed"
    tensors, broken = found["tensors"], "; resumed it differs" if found.get("resumed") else ""
    return f"{tensors['count']:4} tensors {tensors['values']}{broken}"


# ------------------------------------------------------------------------------------- comparing


def differences(wanted: dict[str, Any], found: dict[str, Any], *, renamed: bool = False) -> list[str]:
    """The differences between two results of `one`, one line each; empty if there are none. With ``renamed``,
    tensors that only changed their file or name do not count.
    """
    if "failed" in found or "failed" in wanted:
        return [f"failed: {found.get('failed', 'only when it was recorded')}"]
    said = []
    old, new = wanted["tensors"], found["tensors"]
    if old["values"] != new["values"]:
        said.append(f"tensors differ: {named(old['each'], new['each'])}")
    elif old["names"] != new["names"] and not renamed:
        said.append(f"tensors have other names, and the same values: {named(old['each'], new['each'])}")
    for file in sorted({*wanted["rows"], *found["rows"]}):
        old, new = wanted["rows"].get(file), found["rows"].get(file)
        if old is None or new is None:
            said.append(f"{file} is {'new' if old is None else 'gone'}")
        elif old["count"] != new["count"]:
            said.append(f"{file} has {new['count']} rows, had {old['count']}")
        elif old["all"] != new["all"]:
            said.append(f"{file} differs: {named(old['columns'], new['columns'])}")
    said += [f"resumed: {line}" for line in found.get("resumed", [])]
    return said


def named(old: dict[str, str], new: dict[str, str], most: int = 8) -> str:
    """The names with different hashes, removed names (-) and new names (+)."""
    other = [name for name in old if name in new and old[name] != new[name]]
    other += [f"-{name}" for name in old if name not in new] + [f"+{name}" for name in new if name not in old]
    more = f" and {len(other) - most} more" if len(other) > most else ""
    return ", ".join(other[:most]) + more


def machine() -> dict[str, Any]:
    """The processor and versions that the last bits depend on."""
    import torch

    found = {"python": platform.python_version(), "cores": os.cpu_count()}
    found["processor"] = f"{platform.machine()} {torch.backends.cpu.get_cpu_capability()}"
    return found | {name: metadata.version(name) for name in LIBRARIES}


def compare(given: argparse.Namespace, base: Path) -> int:
    """Run the kinds of a record again; returns 1 if anything differs."""
    record = json.loads(given.file.read_text())
    there, here = record["machine"], machine()
    changed = [f"{name} {there.get(name)} -> {here[name]}" for name in here if there.get(name) != here[name]]
    if changed:
        print(f"warning: recorded elsewhere ({', '.join(changed)}); last bits may differ.", flush=True)
    wanted = {kind: record["kinds"][kind] for kind in given.kinds or record["kinds"]}
    found = measured(list(wanted), base, given.quick)
    pairs = {kind: differences(wanted[kind], found[kind], renamed=given.renamed) for kind in wanted}
    lines = [f"{kind}: {line}" for kind, said in pairs.items() for line in said]
    print(*lines, f"{len(wanted)} kinds, {len(lines)} differences", sep="\n")
    return 1 if lines else 0


def main(words: list[str] | None = None) -> int:
    """Record or compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["record", "compare"])
    parser.add_argument("file", type=Path)
    parser.add_argument("--kinds", nargs="+", choices=[*KINDS], help="these alone")
    parser.add_argument("--quick", action="store_true", help="without what is killed and resumed")
    parser.add_argument("--renamed", action="store_true", help="compare: names of tensors may be others")
    given = parser.parse_args(words)
    begin = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="ruler-") as folder:
        if given.what == "compare":
            return compare(given, Path(folder))
        kinds = measured(given.kinds or [*KINDS], Path(folder), given.quick)
    from code_lines import commit

    command = " ".join(["python", "benchmarks/ruler.py", *(sys.argv[1:] if words is None else words)])
    record = {"command": command, "commit": commit(), "seconds": round(time.monotonic() - begin, 1)}
    record["machine"] = machine()
    if bad := [f"{kind}: {x.get('failed', x.get('resumed'))}" for kind, x in kinds.items() if unfit(x)]:
        print("nothing is recorded:", *bad, sep="\n")
        return 1
    given.file.write_text(json.dumps(record | {"kinds": kinds}, indent=1) + "\n")
    return 0


def unfit(found: dict[str, Any]) -> bool:
    """Whether a run failed, or ended differently after a resume."""
    return "failed" in found or bool(found.get("resumed"))


if __name__ == "__main__":
    sys.exit(main())
