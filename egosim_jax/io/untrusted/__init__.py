"""Bounded readers of files that others wrote."""
