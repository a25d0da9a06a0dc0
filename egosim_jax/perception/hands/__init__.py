"""The wearer's hands in a video: detected, tracked per side, and lifted to meters.

Drawing of hands is in `silhouettes` and `rendering`.

    LandmarkHands:  the estimator, by MediaPipe's networks
    lift:           metric joints in the camera from hand tracks
"""

from egosim_jax.perception.hands.estimator import LandmarkHands
from egosim_jax.perception.hands.lift import lift

__all__ = ["LandmarkHands", "lift"]
