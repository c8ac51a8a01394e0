"""Collecting rollouts."""

__all__ = ["collector", "episodes", "rollout", "running"]
