"""Update rules: one file each, one signature; settings.py is importable without torch."""

__all__ = ["a2c", "batch", "ppo", "reinforce", "settings"]
