"""The compiled CPU engine: the same PPO update as algorithms/ppo.py, on the memory of the torch parameters.

``compiled_engine.CompiledEngine`` is the engine; importing it compiles the kernels or reads them from the
cache. What it supports is decided in plan.py, which does not need numba.

    compiled_engine > update, infer > layers, distributions, threads > primitives
"""

__all__ = ["cache", "infer", "plan", "threads", "update"]
