"""Worlds to step, serve and play in."""
