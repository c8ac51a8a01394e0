"""The training loop of both stories. `events` is public, for listeners; the rest is internal."""

__all__ = ["events"]
