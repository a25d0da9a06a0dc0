"""Choice between growths of a moved object, by the whole scene that each predicts.

A growth with half the object leaves the other half behind, and one with a part of the table takes
it along. Both look wrong where the object was and where it went. So all growths are compared over
the same pixels: those that the object of any growth covers, before or after the move.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from egosim_jax.geometry import cameras_in_object_frame, invert, pixels_of, transform
from egosim_jax.perception.objects.film import Film, ObjectModel, ObjectMotion, at_rest
from egosim_jax.rendering.reference import splat
from egosim_jax.state.fuse import dilate
from egosim_jax.state.new_objects import is_among
from egosim_jax.types import Cameras, SceneState
from egosim_jax.types.arrays import Colors

FRAMES = 5
"""Number of compared frames, from the grasp to the end."""
SMALLER = 0.1
"""Exponent of a part's relative size in the factor on its cost."""
WITHOUT_EDGES = 1.2
"""Factor on the cost of a part without edges."""
NOISE = 3.0
"""Difference from the clip that means nothing, in 8-bit levels."""
MIN_KNOWN = 0.25
"""Minimum fraction of the covered pixels that can be compared; fewer decide nothing."""
UNKNOWN = 4.0
"""Maximum cost of a pixel whose surface is a guess, and cost if it is unknown, in 8-bit levels."""
STAYED = 40.0
"""Cost of such a pixel if it has the color of before, in 8-bit levels: nothing left it."""
AS_BEFORE = 12.0
"""Maximum color difference of a pixel that has the color of before, in 8-bit levels."""
ON_SUPPORT_M = 0.005
"""Maximum distance of a point of the support from its plane, in meters."""
MARGIN_M = 0.05
"""Distance around the moved points within which the state is drawn, in meters."""
POINT_PX = 2
"""Size of the drawn points in pixels."""
SMOOTHED, SMOOTHINGS = 12, 4
"""Number of nearest points that decide together whether they move, and number of rounds."""
AT_REST = 5.0
"""Minimum advantage of a resting point over a moving one, in 8-bit levels."""
SQUARE = np.ones((3, 3), np.uint8)
"""A pixel and its neighbors."""


Candidate = tuple[float, ObjectMotion]
"""Change of the cost by a motion, less the highest accepted one; and the motion."""


def choose_extent(
    candidates: Sequence[Candidate], growths: Sequence[ObjectModel], film: Film, state: SceneState
) -> int:
    """Return the index of the candidate whose part of a cluster explains the clip best.

    The cluster has some growths, the whole first; a moving part has no edges. A smaller growth must
    explain the clip better, and a part without edges better still: gray frames explain nothing. If
    too little can be compared, the points of each candidate alone decide.
    """
    if len(candidates) == 1:
        return 0
    motions = [motion for _, motion in candidates]
    costs = predicted_costs(motions, growths[0], film, state)
    if costs is None:
        changes = np.array([change for change, _ in candidates])
        costs = changes - changes.min()
    sizes = np.array([len(motion.model.points_m) for motion in motions])
    edged = [any(motion.model is growth for growth in growths) for motion in motions]
    factors = (len(growths[0].points_m) / sizes) ** SMALLER * np.where(edged, 1.0, WITHOUT_EDGES)
    return int(np.argmin((costs + NOISE) * factors))


def moving_part(motion: ObjectMotion, film: Film) -> ObjectModel:
    """Return a cluster without the points that the clip shows at rest.

    A lid has no edge where it is flush with its box. Points that could be both move along.
    """
    from scipy.spatial import KDTree

    model, frames = motion.model, _compared_frames([motion])
    rest, moved = (
        film.at(frames).residuals(model, path[frames])
        for path in (at_rest(len(motion.path)), motion.path)
    )
    gain = np.nan_to_num(rest - moved).mean(axis=0)
    near = KDTree(model.points_m).query(model.points_m, min(SMOOTHED, len(gain)))[1]
    for _ in range(SMOOTHINGS):
        gain = gain[near].mean(axis=1)
    moves = gain > -AT_REST
    return replace(model, points_m=model.points_m[moves], colors=model.colors[moves])


def predicted_costs(
    motions: Sequence[ObjectMotion], whole: ObjectModel, film: Film, state: SceneState
) -> Float[np.ndarray, " m"] | None:
    """Return how far the scene that each motion predicts is from the clip, in 8-bit levels.

    What an object leaves is a guess: the support behind the `whole`
    cluster, and nothing known behind a part. A part may also bring sides along that it had inside
    the cluster, as a drawer does; they are seen where it passed over the support. A guess costs
    little, unless the clip shows the color of before: then nothing left the place. If too little is
    no guess, the result is None.
    """
    frames = _compared_frames(motions)
    film = film.at(frames)
    local, shown, color = film.cameras, film.shown, film.color
    near = _near(motions, state)
    points, colors = state.points_m[near], state.colors[near].astype(np.float32)
    ground = _ground_color(motions[0], points, colors)
    plane = whole.plane
    on_support = np.append(np.abs(points @ plane[:3] + plane[3]) < ON_SUPPORT_M, False)
    models = {id(motion.model): motion.model for motion in motions}
    rests = {key: _draw_rest(model, local, points) for key, model in models.items()}
    layers = [(*_draw(motion, frames, local), *rests[id(motion.model)]) for motion in motions]
    compared = np.any([layer[1] >= 0 for layer in layers], axis=0)
    everything = np.concatenate([m.points_m for m in models.values()]).astype(np.float32)
    compared |= splat(everything, local, point_px=POINT_PX)[1] >= 0
    compared &= ~film.hidden
    judged = compared.copy()
    nothing = np.full(3, np.nan, np.float32)
    _, first = splat(points, local, point_px=POINT_PX)
    before = _closest(np.append(colors, np.zeros((1, 3), np.float32), axis=0)[first], shown)
    stayed = (first >= 0) & (np.sqrt(np.square(shown - before).mean(axis=-1)) < AS_BEFORE)
    costs = []
    for motion, (moved_m, moved, rest_m, rest) in zip(motions, layers, strict=True):
        is_whole = motion.model is whole
        drawn = np.append(colors, (ground if is_whole else nothing)[None], axis=0)[rest]
        nearer = (moved >= 0) & (moved_m < rest_m)
        drawn = np.where(nearer[..., None], motion.model.colors[moved], drawn)
        gaps = color.apart(shown, _closest(np.nan_to_num(drawn), shown))
        left = (rest == len(points)) & ~nearer
        guessed = left
        if not is_whole:
            edge = dilate(left, 0.0)
            judged &= ~edge
            gaps = np.where(left, UNKNOWN, gaps)
            guessed = edge | (_passed(motion, frames, local) & on_support[rest] & ~nearer)
        gaps = np.where(guessed, np.minimum(gaps, UNKNOWN), gaps)
        gaps = np.where(left & stayed & (gaps >= UNKNOWN), STAYED, gaps)
        costs.append(np.minimum(gaps, color.max_residual))
    if judged.sum() <= MIN_KNOWN * compared.sum():
        return None
    return np.array([gaps[compared].mean() for gaps in costs])


def _passed(
    motion: ObjectMotion, frames: Int[np.ndarray, " g"], cameras: Cameras
) -> Bool[np.ndarray, "g h w"]:
    """Return the pixels between an object's first place and its place in each frame."""
    import cv2

    drawn = np.zeros((len(frames), cameras.height, cameras.width), np.uint8)
    points = motion.model.points_m
    for index, frame in enumerate(frames):
        both = np.concatenate([points, transform(motion.path[frame], points)])
        one = replace(cameras, world_from_camera=cameras.world_from_camera[index : index + 1])
        row, column, inside = pixels_of(one, transform(invert(one.world_from_camera), both))
        corners = np.stack([column[inside], row[inside]], axis=1).astype(np.int32)
        if len(corners):
            cv2.fillConvexPoly(drawn[index], cv2.convexHull(corners), 1)
    return drawn > 0


def _closest(
    drawn: Float32[np.ndarray, "g h w 3"], shown: Float32[np.ndarray, "g h w 3"]
) -> Float32[np.ndarray, "g h w 3"]:
    """Return the color nearest to the shown one between those drawn within a pixel.

    So a border that the clip blurs, or shows a pixel aside, costs nothing.
    """
    import cv2

    low, high = (
        np.stack([function(frame, SQUARE) for frame in drawn])
        for function in (cv2.erode, cv2.dilate)
    )
    return np.clip(shown, low, high)


def _compared_frames(motions: Sequence[ObjectMotion]) -> Int[np.ndarray, " g"]:
    first = min(motion.grasped for motion in motions)
    last = len(motions[0].path) - 1
    return np.unique(np.rint(np.linspace(first, last, FRAMES + 1)[1:]).astype(int))


def _near(motions: Sequence[ObjectMotion], state: SceneState) -> Bool[np.ndarray, " n"]:
    """Return the state's points in the box of the moved points, widened by a margin."""
    places = np.concatenate(
        [
            motion.model.points_m @ pose[:3, :3].T + pose[:3, 3]
            for motion in motions
            for pose in motion.path[[0, motion.released, -1]]
        ]
    )
    low, high = places.min(axis=0) - MARGIN_M, places.max(axis=0) + MARGIN_M
    return ((state.points_m >= low) & (state.points_m <= high)).all(axis=1)


def _ground_color(
    motion: ObjectMotion, points_m: Float32[np.ndarray, "n 3"], colors: Colors
) -> Float32[np.ndarray, " 3"]:
    """Return the color of the supporting plane; NaN without points on it."""
    plane = motion.model.plane
    on = np.abs(points_m @ plane[:3] + plane[3]) < ON_SUPPORT_M
    if not on.any():
        return np.full(3, np.nan, np.float32)
    return np.median(colors[on], axis=0).astype(np.float32)


def _draw(
    motion: ObjectMotion, frames: Int[np.ndarray, " g"], cameras: Cameras
) -> tuple[Float32[np.ndarray, "g h w"], Int[np.ndarray, "g h w"]]:
    """Return depth and index of the moved object."""
    local = cameras_in_object_frame(cameras, motion.path[frames])
    return splat(motion.model.points_m, local, point_px=POINT_PX)


def _draw_rest(
    model: ObjectModel, cameras: Cameras, points_m: Float32[np.ndarray, "n 3"]
) -> tuple[Float32[np.ndarray, "g h w"], Int[np.ndarray, "g h w"]]:
    """Return depth and index of the points that an object leaves behind."""
    left = np.flatnonzero(~is_among(points_m, model.points_m.astype(np.float32)))
    rest_m, rest = splat(points_m[left], cameras, point_px=POINT_PX)
    return rest_m, np.append(left, len(points_m))[rest]
