"""Collecting rollouts."""

__all__ = ["collector", "episodes", "replay", "rollout", "running"]
