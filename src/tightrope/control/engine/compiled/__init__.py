"""The compiled CPU engine: the same PPO update as algorithms/ppo.py, on the memory of the torch parameters.

``fused.FusedEngine`` is the engine; importing it compiles the kernels or reads them from the cache. What it
supports is decided in plan.py, which does not need numba.

    fused > update, infer > layers, distributions, threads > primitives
"""
