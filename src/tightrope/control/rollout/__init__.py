"""Collecting rollouts, and episodes with a frozen policy."""

__all__ = ["collector", "evaluation", "replay", "rollout"]
