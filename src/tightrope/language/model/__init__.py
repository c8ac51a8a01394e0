"""Loading and taking apart causal language models."""

__all__ = ["architecture", "load", "lora", "packaged", "saving", "trunk", "weights"]
