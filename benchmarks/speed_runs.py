"""The processes that speed.py times from outside, and their use of memory."""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import speed_report as report

HERE = Path(__file__).resolve().parent
# the shell's own thread settings must not affect the contenders
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def plain_environment(**more: str) -> dict[str, str]:
    """This process's environment variables without those that set thread counts."""
    kept = {name: value for name, value in os.environ.items() if name not in THREAD_VARIABLES}
    return kept | more


def our_environment(**more: str) -> dict[str, str]:
    """The same, with this checkout first on tightrope's path."""
    path = os.pathsep.join(filter(None, [str(HERE.parent / "src"), os.environ.get("PYTHONPATH", "")]))
    return plain_environment(PYTHONPATH=path, **more)


def tree_megabytes(pid: int) -> float:
    """Memory of a process and its descendants in MB, shared pages counted once; 0 without /proc."""
    total, pids = 0.0, [pid]
    for one in pids:
        with contextlib.suppress(OSError):
            for task in Path(f"/proc/{one}/task").iterdir():
                pids += [
                    int(child) for child in (task / "children").read_text().split() if int(child) not in pids
                ]
            rollup = Path(f"/proc/{one}/smaps_rollup").read_text()
            total += sum(float(line.split()[1]) for line in rollup.splitlines() if line.startswith("Pss:"))
    return total / 1024


def run_process(
    command: list[str], environment: dict[str, str], *, watch_memory: bool = False
) -> dict[str, float]:
    """Run a process to its end: wall seconds and peak memory in MB. RuntimeError with its last output.

    Peak memory is the system's figure for the largest process of the tree or, with ``watch_memory``, the sum
    over the tree if that is larger, sampled every 20 ms. Watching costs time: never use it in a timed run.
    """
    with tempfile.TemporaryFile("w+") as words:
        begin = time.perf_counter()
        process = subprocess.Popen(command, env=environment, stdout=words, stderr=subprocess.STDOUT)
        highest = 0.0
        while watch_memory and not _ended(process):
            highest = max(highest, tree_megabytes(process.pid))
            time.sleep(0.02)
        if hasattr(os, "wait4"):
            _, status, usage = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
            highest = max(highest, usage.ru_maxrss / (1024**2 if sys.platform == "darwin" else 1024))
        else:
            process.wait()
        wall = time.perf_counter() - begin
        if process.returncode != 0:
            words.seek(0)
            raise RuntimeError(
                f"{shlex.join(command)} ended with {process.returncode}:\n{words.read()[-3000:]}"
            )
    return {"wall": wall, "memory_mb": highest}


def _ended(process: subprocess.Popen) -> bool:
    """Whether a process has ended, without collecting its resource figures."""
    if not hasattr(os, "waitid"):
        return process.poll() is not None
    return os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None


def train_ours(
    scenario: dict[str, Any], rollouts: int, *, watch_memory: bool = False, **environment: str
) -> dict:
    """One normal ``tightrope train`` with as many steps as these rollouts have."""
    total_steps = rollouts * scenario["num_envs"] * scenario["num_steps"]
    with tempfile.TemporaryDirectory() as folder:
        words = report.flags(report.tightrope_settings(scenario) | {"total_steps": total_steps})
        command = [sys.executable, "-m", "tightrope", "train", scenario["env"], *words, "--json", "--quiet"]
        found = run_process(
            [*command, "--run-dir", folder], our_environment(**environment), watch_memory=watch_memory
        )
        settings, summary = (
            json.loads((Path(folder) / f"{name}.json").read_text()) for name in ("settings", "summary")
        )
        updates = [json.loads(line) for line in (Path(folder) / "metrics.jsonl").read_text().splitlines()]
    backend = settings["vector_backend"]
    found |= {
        "contender": "tightrope",
        "steps": summary["steps"],
        "engine": settings["engine"],
        "backend": backend,
    }
    found["optimiser_steps"] = round(sum(update.get("train/minibatches", 0) for update in updates))
    report.check_work(scenario, found, phantoms=backend == "vector")
    return found


def train_peer(
    peer: str, python: str, scenario: dict[str, Any], rollouts: int, *, watch_memory: bool = False
) -> dict[str, Any]:
    """The same for a peer, in its own interpreter."""
    total_steps = rollouts * scenario["num_envs"] * scenario["num_steps"]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "result.json"
        words = [peer, json.dumps(scenario | {"total_steps": total_steps}), str(file)]
        found = run_process(
            [python, str(HERE / "speed_peers.py"), *words], plain_environment(), watch_memory=watch_memory
        )
        found |= {"contender": peer, **json.loads(file.read_text())}
    report.check_work(scenario, found, phantoms=False)
    return found


def written_by(script: list[str], environment: dict[str, str]) -> Any:
    """The result that a script of this folder writes to the file in its last argument."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "result.json"
        run_process([*script, str(file)], environment)
        return json.loads(file.read_text())
