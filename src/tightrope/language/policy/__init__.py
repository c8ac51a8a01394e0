"""The roles on one trunk."""
