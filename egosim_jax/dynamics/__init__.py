"""Prediction of what an action does to the objects of a state, before anything is painted.

    predict     state, action → Motion (`types.motion`)
    Prediction  the same, also of other grips and of objects without an id

The modules know neither frames nor jax:

    hands      tracks of the hands, exact or noisy
    solids     convex hulls of the objects
    level      the state's objects in level coordinates
    grips      when a hand holds an object
    walk       poses, grips and causes while the frames are walked through
    pushes     contact from the side
    support    riders, releases, falls, furniture
"""

from __future__ import annotations

from egosim_jax.dynamics.grips import Hold, find_holds, possible_holds
from egosim_jax.dynamics.predict import Prediction, predict

__all__ = ["Hold", "Prediction", "find_holds", "possible_holds", "predict"]
