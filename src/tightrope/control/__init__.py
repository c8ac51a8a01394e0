"""Story one: reinforcement learning on Gymnasium tasks."""

__all__ = ["agent", "evaluate", "record", "saving", "settings", "train"]
