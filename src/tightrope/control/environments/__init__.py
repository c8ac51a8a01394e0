"""Copies of a task behind reset and step."""
