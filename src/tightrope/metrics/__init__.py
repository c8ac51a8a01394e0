"""The declarations of all metrics."""

__all__ = ["declare", "table"]
