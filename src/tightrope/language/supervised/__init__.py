"""The first two stages: SFT and reward models."""

__all__ = ["preferences", "prepare", "sft"]
