"""The memory that a job may take, and the error when it needs more."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import torch

from tightrope.errors import TightropeError

SHARE = 0.9  # of the available memory that a job may claim


class DoesNotFit(TightropeError, ValueError):
    """A job needs more memory than there is."""


def available_memory(device: str | torch.device = "cpu", root: Path = Path("/")) -> int | None:
    """Bytes that a job may still take on this device; None where that is not known.

    A GPU: what its driver calls free. Otherwise the least of the machine's free memory and of what every
    control group above this process (a container's limit) leaves; pages that can be dropped count as free.
    """
    place = torch.device(device)
    if place.type == "cuda":
        return int(torch.cuda.mem_get_info(place)[0])
    found = [*_machine_free(root), *_groups_free(root)]
    return min(found) if found else None


def _machine_free(root: Path) -> Iterator[int]:
    for line in _read(root / "proc/meminfo").splitlines():
        if line.startswith("MemAvailable:"):
            yield int(line.split()[1]) * 1024
            return
    if root == Path("/") and "SC_PHYS_PAGES" in getattr(os, "sysconf_names", {}):
        yield os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _groups_free(root: Path) -> Iterator[int]:
    """What each limit on the way up leaves: version 2 in one tree, version 1 under memory/."""
    top = root / "sys/fs/cgroup"
    for line in _read(root / "proc/self/cgroup").splitlines():
        number, kinds, path = line.split(":", 2)
        if number == "0":
            tree, names, cached = top, ("memory.max", "memory.current"), "inactive_file"
        elif "memory" in kinds.split(","):
            tree, cached = top / "memory", "total_inactive_file"
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes")
        else:
            continue
        group = Path(*(part for part in Path(path.strip("/")).parts if part != ".."))
        for folder in (group, *group.parents):
            limit, used = (_read(tree / folder / name).strip() for name in names)
            if limit.isdigit() and used.isdigit():
                numbers = dict(entry.split() for entry in _read(tree / folder / "memory.stat").splitlines())
                yield max(0, int(limit) - int(used) + int(numbers.get(cached, 0)))


def _read(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""
