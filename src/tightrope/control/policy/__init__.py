"""Actors, critics and what they see."""

__all__ = ["normalise", "policy"]
