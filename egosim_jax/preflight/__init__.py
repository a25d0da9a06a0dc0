"""Preflight: compile a program for a machine that need not be present, and read off its costs."""
