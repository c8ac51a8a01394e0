"""Actors, critics and what they see."""
