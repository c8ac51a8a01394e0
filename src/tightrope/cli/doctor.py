"""``tightrope doctor``: what this machine and this installation can do, and with a model its self-check."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform

from tightrope.findings import Finding

OPTIONAL = {
    "transformers": ("the language story", "pip install 'tightrope[language]'"),
    "Box2D": ("LunarLander and BipedalWalker", "pip install 'tightrope[box2d]'"),
    "mujoco": ("HalfCheetah and the other MuJoCo tasks", "pip install 'tightrope[mujoco]'"),
    "ale_py": ("Atari", "pip install 'tightrope[atari]'"),
    "imageio_ffmpeg": ("tightrope record", "pip install 'tightrope[video]'"),
}


def examine_installation(model: str | None = None) -> list[Finding]:
    """The findings about this machine and installation; with ``model`` those about a language model too."""
    found = [
        _machine(),
        *(_package(name) for name in ("torch", "numpy", "gymnasium", "numba", "safetensors")),
    ]
    found += [_optional(module, *words) for module, words in OPTIONAL.items()]
    found.append(_engine())
    if model is not None:
        from tightrope.language.selfcheck import check_model

        found += check_model(model)
    return found


def _machine() -> Finding:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return Finding(
        "machine",
        True,
        f"{platform.system()} {platform.machine()}, {cores} cores, Python {platform.python_version()}",
    )


def _package(name: str) -> Finding:
    try:
        return Finding(name, True, importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        return Finding(
            name, False, "not installed", "Install tightrope with its dependencies: pip install tightrope"
        )


def _optional(module: str, what: str, command: str) -> Finding:
    there = importlib.util.find_spec(module) is not None
    return Finding(what, True, "installed" if there else f"not installed ({command})")


def _engine() -> Finding:
    from tightrope.control.engine.compiled.cache import compilation_due

    due = compilation_due()
    seen = "compiles at its first use, about 15 seconds" if due else "compiled for this machine"
    return Finding("compiled CPU engine", True, seen)
