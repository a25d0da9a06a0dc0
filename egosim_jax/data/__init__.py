"""Triplets on their way to the models: metadata, clips, shards and the loader."""
