"""What a run leaves behind: its folder, its checkpoints, and the one table of metrics."""
