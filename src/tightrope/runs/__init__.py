"""Run folders: records, checkpoints, the writer lock and signals.

Public: `run.Run` for reading, and the errors in `checkpoint`, `durable` and `lock`. The rest is internal.
"""

__all__ = ["checkpoint", "durable", "lock", "run"]
