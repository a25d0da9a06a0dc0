"""Depth of recorded videos without network weights.

Depth from networks is in `networks`; the state made from depth is in `state.depth`.

    SweptDepth:        the estimator, `SweptDepth()(frames, moving, cameras, wanted=[0])`
    points_per_pixel:  density of the state's points for a camera path

`SweptDepth` calls `triangulate` for sparse points, `sweep` for depth from posed frames, and
`complete` for all other pixels.
"""

from egosim_jax.perception.video.depth.swept import SweptDepth, points_per_pixel

__all__ = ["SweptDepth", "points_per_pixel"]
