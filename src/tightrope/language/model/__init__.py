"""Loading and taking apart causal language models."""
