"""Worlds for training libraries: flat numbers, and adapters of environments."""
