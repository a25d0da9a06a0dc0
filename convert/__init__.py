"""Weights in and out: PyTorch checkpoints to ours and back."""
