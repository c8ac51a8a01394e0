"""Gymnasium's spaces as matrices and back."""

__all__ = ["actions", "observations", "structure"]
