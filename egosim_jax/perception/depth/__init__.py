"""Depth of recorded videos without network weights, and the scene state that is made from it.

    depth = SweptDepth()(frames, moving, camera_estimate, wanted=[0])

`sweep` measures depth from posed frames, `sparse` selects triangulated points to be trusted,
`complete` fills in what neither knows, and `planes` is for cameras that do not move.
"""

from egosim_jax.perception.depth.swept import SweptDepth

__all__ = ["SweptDepth"]
