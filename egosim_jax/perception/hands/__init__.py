"""Hands of the wearer in a video: detected, tracked per side, and lifted to meters."""

from egosim_jax.perception.hands.estimator import LandmarkHands
from egosim_jax.perception.hands.lift import lift

__all__ = ["LandmarkHands", "lift"]
