"""Procedural worlds with exact ground truth for any action."""
