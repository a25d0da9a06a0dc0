"""Reading and writing: videos, weights, checkpoints, run folders."""
