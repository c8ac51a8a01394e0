"""Copies of a task behind reset and step."""

__all__ = [
    "base", "copies", "episode", "faults", "make", "masks", "pool", "processes", "state", "tasks",
    "vector", "watchdog",
]  # fmt: skip
