"""The memory of a job before it begins."""
