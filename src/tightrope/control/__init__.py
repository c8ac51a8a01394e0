"""Story one: reinforcement learning on Gymnasium tasks."""
