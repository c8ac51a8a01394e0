"""Copies of a task behind reset and step."""

__all__ = ["base", "faults", "make", "masks", "processes", "state", "tasks"]
