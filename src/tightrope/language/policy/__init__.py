"""The roles on one trunk."""

__all__ = ["policy_model", "roles"]
