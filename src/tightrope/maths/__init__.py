"""The mathematics: pure functions of [B, T] tensors that import torch alone; only `statistics` reduces."""
