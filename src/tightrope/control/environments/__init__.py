"""Copies of a task behind reset and step."""

__all__ = [
    "base", "copies", "faults", "make", "masks", "pool", "processes", "seeds", "state", "tasks",
    "vector", "watchdog",
]  # fmt: skip
