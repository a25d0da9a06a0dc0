"""Depth of recorded videos without network weights, and the scene state that is made from it.

    depth = SweptDepth()(frames, moving, camera_estimate, wanted=[0])

`sweep` measures depth from posed frames, `sparse` selects triangulated points to be trusted,
`triangulate` finds such points where cameras are known without them, `complete` fills in what
neither knows, `planes` is for cameras that do not move, and `density` for the state's points.
"""

from egosim_jax.perception.depth.density import points_per_pixel
from egosim_jax.perception.depth.swept import SweptDepth

__all__ = ["SweptDepth", "points_per_pixel"]
