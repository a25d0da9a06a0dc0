"""Conversion of weights and LoRAs from and to the checkpoints of PyTorch projects."""
