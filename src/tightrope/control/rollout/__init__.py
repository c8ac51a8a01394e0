"""Collecting rollouts, and episodes with a frozen policy."""

__all__ = ["collector", "episodes", "evaluation", "replay", "rollout"]
