"""Metrics of generated videos and of states, against ground truth."""
