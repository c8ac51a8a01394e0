"""Rows to tokens."""

__all__ = ["batching", "examples"]
