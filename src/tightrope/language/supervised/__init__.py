"""The first two stages: SFT and reward models."""
