"""The third stage: PPO."""
