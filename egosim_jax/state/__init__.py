"""Operations on the scene state: alignment, interaction filter, fusion, storage.

NumPy and Open3D, no JAX: any generator can drive the loop.
"""
