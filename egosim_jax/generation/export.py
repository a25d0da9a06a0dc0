"""Export of an action's conditions as files, for EgoSim's loader and `egosim generate`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from egosim_jax.data.clip_files import prior_column
from egosim_jax.data.clips import write_clips
from egosim_jax.dynamics import predict
from egosim_jax.rendering import POINT_PX, PriorKind, Renderer, jitted
from egosim_jax.rendering.hand_mesh import pose_hands
from egosim_jax.rendering.mesh import MovingMesh
from egosim_jax.rendering.reference import draw_scene
from egosim_jax.simulation.actions import check_order
from egosim_jax.state.ply import has_triangles, read_triangles
from egosim_jax.state.snapshot import load, read_ply
from egosim_jax.types import Action, Cameras, InputError, SceneState, Triplet, check_video


def write_conditions(
    folder: Path | str,
    state: SceneState,
    action: Action,
    *,
    fps: int,
    video_id: str = "clip_1",
    first_frame: UInt8[np.ndarray, "h w 3"] | None = None,
    renderer: Renderer = jitted,
    point_px: int = POINT_PX,
    prior: PriorKind = "static",
) -> Path:
    """Write prior, mask and hand videos of an action in EgoSim's layout; return its metadata.csv.

    Rows of other clips in the folder stay; a clip of the same `video_id` is replaced.
    `point_px` is the side of a point, and `prior` says where objects are drawn; both must be the
    model's. The first frame defaults to the view's. Raises `InputError` if the first camera sees
    none of the state, and for a `video_id` that is not a valid file name.
    """
    motion = predict(state, action, fps=fps) if prior == "predicted" else None
    view = renderer.render(state, action.cameras, point_px=point_px, motion=motion)
    triplet = Triplet(
        video_id=video_id,
        prompt=action.prompt,
        prior=view.frames,
        mask=view.mask,
        hands=renderer.draw_hands(action.joints_m, action.cameras, kind=action.kind)[0],
        first_frame=view.frames[0] if first_frame is None else first_frame,
        extra=prior_column(prior),
    )
    return write_clips(Path(folder), [triplet], fps=fps, append=True)


Static = tuple[UInt8[np.ndarray, "f h w 3"], UInt8[np.ndarray, "f h w"]]
"""Video of a static scene, and its mask: 255 where the scene was not observed."""


def static_of(scene: Path, cameras: Cameras) -> Static:
    """Render a static scene from a state's folder, or from a PLY of points or triangles."""
    if scene.suffix == ".ply" and has_triangles(scene):
        state = read_ply(scene)
        return draw_scene(state.points_m, read_triangles(scene), state.colors, cameras)
    state = read_ply(scene) if scene.suffix == ".ply" else load(scene)
    view = jitted.render(state, cameras, point_px=POINT_PX)
    return view.frames, view.mask


MAX_MOVED_M, MAX_TURNED_DEG = 0.005, 0.2
"""Maximum motion of a camera that counts as fixed: about a pixel."""


def repeated(target: UInt8[np.ndarray, "f h w 3"], cameras: Cameras) -> Static:
    """Return the static video of a fixed camera: the first frame, repeated.

    Hands in the first frame stay visible, as in DWM's TASTE-Rob data. Raises `InputError` if the
    camera moves.
    """
    poses = np.asarray(cameras.world_from_camera)
    moved = np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=-1).max()
    # The chord between two rotations, which unlike their cosine is exact for small angles.
    chords = np.linalg.norm(poses[:, :3, :3] - poses[0, :3, :3], axis=(1, 2))
    turned = np.degrees(2 * np.arcsin(np.minimum(chords.max() / np.sqrt(8), 1)))
    if moved > MAX_MOVED_M or turned > MAX_TURNED_DEG:
        raise InputError(
            "The first frame of a video can only be repeated if its camera is fixed, within "
            f"{MAX_MOVED_M:g} m and {MAX_TURNED_DEG:g} degrees: this one moves by up to "
            f"{moved:.3f} m and turns by up to {turned:.1f} degrees. Give a scene to render along "
            "its path. (--scene)"
        )
    return np.repeat(target[:1], len(target), axis=0), np.zeros(target.shape[:3], np.uint8)


def static_triplet(
    action: Action,
    static: Static,
    *,
    video_id: str,
    meshes: MovingMesh | None = None,
    target: UInt8[np.ndarray, "f h w 3"] | None = None,
) -> Triplet:
    """Return a DWM triplet: a static scene, hand meshes along the action, and the ground truth.

    `meshes` default to meshes posed from the action's keypoints, left hand before right hand.
    Raises `InputError` if lengths or sizes disagree, or if the keypoints are in another order.
    """
    cameras = action.cameras
    shape = len(cameras.world_from_camera), cameras.height, cameras.width
    if target is not None:
        _check_recorded(target, shape)
    check_video("The static video", static[0], shape)
    mesh = _posed(action) if meshes is None else meshes
    if len(mesh.vertices_m) != shape[0]:
        raise InputError(
            f"The hands have {len(mesh.vertices_m)} frames, the cameras {shape[0]}: both must have "
            "the same number. (--mano-poses)"
        )
    return Triplet(
        video_id=video_id,
        prompt=action.prompt,
        prior=static[0],
        mask=static[1],
        hands=jitted.draw_mesh(mesh, cameras)[0],
        first_frame=static[0][0],
        target=target,
    )


def _posed(action: Action) -> MovingMesh:
    """Return the meshes of the keypoints. Raises `InputError` if they are in another order."""
    try:
        check_order(action)
    except InputError as error:
        raise InputError(f"In the action, {error} (--action)") from error
    return pose_hands(action.joints_m)


def _check_recorded(target: np.ndarray, shape: tuple[int, int, int]) -> None:
    """Raise `InputError` unless the recorded video has the length and size of the action."""
    try:
        check_video("The recorded video", target, shape)
    except InputError as error:
        raise InputError(
            f"{error} Cut or resize it, or give the action of this video. (--video, --action)"
        ) from error
