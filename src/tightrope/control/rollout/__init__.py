"""Collecting rollouts."""

__all__ = ["collector", "rollout"]
