"""The third stage: PPO."""

__all__ = ["align", "experience", "samples"]
