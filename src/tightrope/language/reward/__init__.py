"""Rewards: functions, reward models, and the judge that joins them."""

__all__ = ["call", "functions", "judge", "model"]
