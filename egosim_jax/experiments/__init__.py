"""Documented experiments: one module per experiment, named as its `egosim experiment` command."""
