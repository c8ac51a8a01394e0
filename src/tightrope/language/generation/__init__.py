"""Sampling and what a policy gives to tokens."""

__all__ = ["distribution", "sample"]
