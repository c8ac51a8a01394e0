"""What the exact results depend on besides the settings: library versions, the processor's instructions."""

from __future__ import annotations

import platform
import sys

VERSIONED = ("torch", "numpy", "numba", "gymnasium", "transformers")


def known() -> dict[str, str]:
    """Name -> version of Python, of this library, the processor and the imported libraries."""
    from importlib import metadata

    try:
        own = metadata.version("tightrope")
    except metadata.PackageNotFoundError:
        own = "not installed"
    found = {"python": platform.python_version(), "tightrope": own, "processor": platform.machine()}
    if "torch" in sys.modules:
        import torch

        found["processor"] += f" {torch.backends.cpu.get_cpu_capability()}"
    return found | {name: str(sys.modules[name].__version__) for name in VERSIONED if name in sys.modules}


def version_changes(saved: object) -> str:
    """What has changed since ``saved``, an earlier result of `known`, as text; empty if nothing has."""
    saved, now = saved if isinstance(saved, dict) else {}, known()
    changed = [name for name in now if name in saved and saved[name] != now[name]]
    return ", ".join(f"{name} {saved[name]} -> {now[name]}" for name in changed)
