"""Copies of a task behind reset and step."""

__all__ = ["base", "copies", "faults", "make", "masks", "processes", "state", "tasks", "vector", "watchdog"]
