"""The mathematics: pure functions of [B, T] tensors that import only torch; only `statistics` reduces."""

__all__ = ["divergence", "returns", "statistics", "surrogate", "values"]
