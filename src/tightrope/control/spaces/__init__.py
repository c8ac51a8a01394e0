"""Observation and action spaces."""
