"""Sharded training: one script that reads straight down, and a recipe for each model."""
