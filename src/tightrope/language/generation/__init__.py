"""Sampling and what a policy gives to tokens."""
