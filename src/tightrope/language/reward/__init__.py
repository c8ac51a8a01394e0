"""Rewards: functions, reward models, and the judge that joins them."""
