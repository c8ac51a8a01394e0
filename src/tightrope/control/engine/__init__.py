"""Who computes: torch or the compiled CPU engine."""

__all__ = ["base", "choose"]
