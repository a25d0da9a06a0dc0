"""The wearer's hands in a video: detected, tracked per side, and lifted to meters.

Drawing of hands is in `silhouettes` and `rendering`.

    LandmarkHands:  the estimator, by MediaPipe's networks
    lift:           metric joints in the camera from hand tracks
    steady:         lifted hands of constant size
"""

from egosim_jax.perception.video.hands.estimator import LandmarkHands
from egosim_jax.perception.video.hands.lift import lift, steady

__all__ = ["LandmarkHands", "lift", "steady"]
