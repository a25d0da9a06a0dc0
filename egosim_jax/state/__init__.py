"""The state's operations: align what was perceived, filter it, fuse it, keep it.

NumPy and Open3D, no jax: any generator can drive the loop.
"""
