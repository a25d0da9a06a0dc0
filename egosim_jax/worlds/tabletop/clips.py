"""Clips of the tabletop world: rendering with complete ground truth, and conversions.

`to_triplet` renders the conditions of EgoSim (points of a state, skeletons) or of DWM (a static
video, hand meshes). The static video is ray cast from the same geometry along the same cameras as
the clip, so the two differ only by what the hands do and hide.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, no_type_check

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from egosim_jax.data.clip_files import prior_column
from egosim_jax.dynamics import predict
from egosim_jax.geometry import pixel_rays, transform, upsample_intrinsics
from egosim_jax.perception.oracle import motions_of
from egosim_jax.perception.pipeline import Observation
from egosim_jax.rendering.hand_mesh import pose_hands
from egosim_jax.rendering.mesh import Side, hand_mask
from egosim_jax.rendering.reference import draw_hands, draw_mesh, render
from egosim_jax.simulation.episode import Episode
from egosim_jax.state.silhouettes import unmix_colors
from egosim_jax.types import (
    JOINTS,
    Action,
    Cameras,
    GroundTruth,
    InputError,
    Kind,
    SceneState,
    Triplet,
    seen_hands,
)
from egosim_jax.worlds.tabletop.bodies import Part
from egosim_jax.worlds.tabletop.raycast import Frame, Placed, RayCaster
from egosim_jax.worlds.tabletop.scene import FIRST_BODY, FIRST_HAND, Scene

POINTS_PER_PIXEL = 2
"""Points along each side of a first-frame pixel, in the state of a clip."""
POINT_PX = 1
"""Default side of the points of a rendered prior in pixels: the size for `tabletop`."""

PriorName = Literal["state", "predicted", "static"]
"""Rendering of the scene: a state at rest, on predicted paths, or the exact first frame."""
HandsName = Literal["skeleton", "mesh", "mask"]
"""Rendering of the hands: skeletons, shaded meshes, or the binary mask of the meshes."""

Arm = tuple[Float[np.ndarray, "j 3"], tuple[Part, ...]]
"""World joints of a hand in meters, and the meshes of hand and forearm."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class TabletopClip:
    """One clip of the tabletop world with its complete ground truth."""

    seed: int
    """Seed of the sequence."""
    number: int
    """Index of the clip in its sequence, from 0."""
    kind: Kind
    """Human hands or a robot gripper."""
    verb: str
    """Verb of the script, such as "carry"; "execute" for a clip of `World.execute`."""
    target: str
    """Name of the manipulated body; empty if no body was manipulated."""
    caption: str
    """Prompt that describes the action."""
    cameras: Cameras
    """Camera of every frame."""
    frames: UInt8[np.ndarray, "f h w 3"]
    """RGB frames of the clip."""
    depth_m: Float32[np.ndarray, "f h w"]
    """Depth along the camera axis in meters; infinite where a ray hits nothing."""
    ids: Int[np.ndarray, "f h w"]
    """Instance id of every pixel (`scene.py`)."""
    joints_m: Float[np.ndarray, "f n j 3"]
    """World positions of the joints of n hands in meters; NaN where a hand is missing."""
    sides: tuple[Side, ...]
    """Side of each hand."""
    scene: Scene
    """Scene in the first frame."""
    world_from_body: Mapping[str, Float[np.ndarray, "f 4 4"]]
    """Pose of every body, or of its moving part if it is articulated, in every frame."""
    body_ids: Mapping[str, int]
    """Instance id in `ids` of every body or moving part."""
    parts: Mapping[str, Part]
    """Mesh of every body or moving part, in its own coordinates."""
    paints: Mapping[int, tuple[int, int, int]]
    """Unshaded RGB color by instance id."""
    first: Frame
    """First frame without hands."""
    state: SceneState
    """Points visible in the first frame without hands; moving part and case have separate ids."""


def render_clip(
    scenes: Sequence[Scene],
    arms: Sequence[Sequence[Arm | None]],
    cameras: Cameras,
    *,
    sides: tuple[Side, ...],
    kind: Kind,
    seed: int,
    number: int,
    verb: str,
    target: str,
    caption: str,
    bare: bool = False,
) -> TabletopClip:
    """Render a clip of the scenes and arms of its frames; `bare` without arms and target."""
    if bare:
        rendered = render_scenes(scenes, cameras, without=target)
    else:
        rendered = render_scenes(scenes, cameras, arms=arms)
    missing = np.full((JOINTS[kind], 3), np.nan)
    paints = {}
    for scene, present in zip(scenes, arms, strict=True):
        paints |= paints_of(place(scene, present))
    first, state = first_view(scenes[0], cameras)
    bodies = scenes[0].bodies
    return TabletopClip(
        seed=seed,
        number=number,
        kind=kind,
        verb=verb,
        target=target,
        caption=caption,
        cameras=cameras,
        frames=np.stack([frame.colors for frame in rendered]),
        depth_m=np.stack([frame.depth_m for frame in rendered]),
        ids=np.stack([frame.ids for frame in rendered]),
        joints_m=np.array([[arm[0] if arm else missing for arm in present] for present in arms]),
        sides=sides,
        scene=scenes[0],
        world_from_body={
            body.name: np.stack([scene.first_part_pose(body.name) for scene in scenes])
            for body in bodies
        },
        body_ids={body.name: scenes[0].instance_id(body.name) for body in bodies},
        parts={body.name: body.parts[0] for body in bodies},
        paints=paints,
        first=first,
        state=replace(state, step=number, provenance=provenance(seed)),
    )


def render_scenes(
    scenes: Sequence[Scene],
    cameras: Cameras,
    *,
    arms: Sequence[Sequence[Arm | None]] | None = None,
    without: str | None = None,
) -> list[Frame]:
    """Render the scenes and arms of some frames, optionally `without` one body."""
    hidden = None if without is None else scenes[0].instance_id(without)
    rendered = []
    for scene, present, pose in zip(
        scenes, arms or [()] * len(scenes), cameras.world_from_camera, strict=True
    ):
        placed = [item for item in place(scene, present) if item.instance_id != hidden]
        rendered.append(_render(RayCaster(placed), pose, cameras))
    return rendered


def film(
    scenes: Sequence[Scene], cameras: Cameras, *, arms: Sequence[Sequence[Arm | None]]
) -> UInt8[np.ndarray, "f h w 3"]:
    """Return the frames of a camera that a hand may move into an object: black inside of it."""
    frames = np.zeros((len(scenes), cameras.height, cameras.width, 3), np.uint8)
    for frame, scene, present, pose in zip(
        frames, scenes, arms, cameras.world_from_camera, strict=True
    ):
        caster = RayCaster(place(scene, present))
        if not caster.rays.contain(pose[:3, 3]):
            frame[:] = _render(caster, pose, cameras).colors
    return frames


def place(scene: Scene, arms: Sequence[Arm | None]) -> list[Placed]:
    """Return every part of the scene and the arms with its pose and id; arms are in world frame."""
    return scene.placed() + [
        Placed(part=part, world_from_part=np.eye(4), instance_id=FIRST_HAND + 2 * index + k)
        for index, arm in enumerate(arms)
        for k, part in enumerate(arm[1] if arm else ())
    ]


def paints_of(placed: Sequence[Placed]) -> dict[int, tuple[int, int, int]]:
    """Return the unshaded RGB colors of parts by instance id."""
    return {item.instance_id: item.part.paint.color for item in placed}


def provenance(seed: int) -> dict[str, str]:
    """Return the origin of a state of the tabletop world."""
    return {"world": "tabletop", "seed": str(seed)}


def _render(caster: RayCaster, pose: np.ndarray, cameras: Cameras) -> Frame:
    return caster.render(pose, cameras.intrinsics_px, height=cameras.height, width=cameras.width)


def first_view(scene: Scene, cameras: Cameras) -> tuple[Frame, SceneState]:
    """Render the first frame without hands, and unproject a finer rendering to points."""
    caster, pose = RayCaster(scene.placed()), cameras.world_from_camera[0]
    first = _render(caster, pose, cameras)
    intrinsics = upsample_intrinsics(cameras.intrinsics_px, POINTS_PER_PIXEL)
    height, width = POINTS_PER_PIXEL * cameras.height, POINTS_PER_PIXEL * cameras.width
    fine = caster.render(pose, intrinsics, height=height, width=width)
    seen = np.isfinite(fine.depth_m)
    rays = pixel_rays(intrinsics, height=height, width=width)
    points = transform(pose, rays[seen] * fine.depth_m[seen][:, None])
    ids = fine.ids[seen].astype(np.int32)
    ids = np.where(ids < FIRST_BODY, 0, ids).astype(np.int32)
    return first, SceneState(
        points_m=points.astype(np.float32),
        colors=unmix_colors(points, fine.colors[seen], ids, pose, intrinsics),
        object_ids=ids,
        last_seen=np.zeros(len(points), np.int32),
        intrinsics_px=cameras.intrinsics_px,
        names=scene.names(),
    )


def state_after(clip: TabletopClip, state: SceneState) -> SceneState:
    """Move the objects of a state by their ground-truth motion in the clip; add no points."""
    points = state.points_m.copy()
    for name, world_from_body in clip.world_from_body.items():
        moved = state.object_ids == clip.body_ids[name]
        last_from_first = world_from_body[-1] @ np.linalg.inv(world_from_body[0])
        points[moved] = transform(last_from_first, points[moved])
    return replace(state, points_m=points, step=clip.number + 1)


def to_triplet(
    clip: TabletopClip,
    state: SceneState | None = None,
    *,
    prior: PriorName = "state",
    hands: HandsName = "skeleton",
    point_px: int = POINT_PX,
) -> Triplet:
    """Return the clip in EgoSim's format, with a rendering of the scene and of the hands.

    `point_px` is the side of a point in pixels, which must be the model's.
    By default the state is the clip's own and the first frame is ray cast. A given state, such as
    the updated state of the clip before, also renders the first frame, holes included. A `static`
    prior is observed everywhere: its mask is 0. Hands and objects may leave the view. Raises
    `InputError` if the first frame shows no point, or for the mesh of a gripper.
    """
    # A static prior does not need this view, but every prior refuses a clip without points.
    start = state or clip.state
    motion = predict(start, to_action(clip)) if prior == "predicted" else None
    view = render(start, clip.cameras, point_px=point_px, motion=motion)
    frames, mask = view.frames, view.mask
    first = clip.first.colors if state is None else frames[0]
    if prior == "static":
        frames, mask = static_video(clip), np.zeros_like(mask)
        first = frames[0]
    if hands == "skeleton":
        drawn, _ = draw_hands(clip.joints_m, clip.cameras, kind=clip.kind)
    else:
        drawn = hand_video(clip)
    return Triplet(
        video_id=f"tabletop_{clip.kind}_{clip.seed}_{clip.number}",
        prompt=clip.caption,
        prior=frames,
        mask=mask,
        hands=hand_mask(drawn) if hands == "mask" else drawn,
        first_frame=first,
        target=clip.frames,
        extra={
            "verb": clip.verb,
            "target": clip.target,
            "kind": clip.kind,
            **prior_column("predicted" if prior == "predicted" else "static"),
        },
    )


def static_video(clip: TabletopClip) -> UInt8[np.ndarray, "f h w 3"]:
    """Return the scene as it was in the clip's first frame, along its cameras, without hands."""
    caster = RayCaster(clip.scene.placed())
    poses = clip.cameras.world_from_camera
    return np.stack([_render(caster, pose, clip.cameras).colors for pose in poses])


def hand_video(clip: TabletopClip) -> UInt8[np.ndarray, "f h w 3"]:
    """Return the shaded meshes of the clip's hands on black. Raises `InputError` for grippers."""
    if clip.kind != "human":
        raise InputError(
            f"The clip of seed {clip.seed} has hands of kind {clip.kind}, which have no mesh: only "
            "human hands have. (--kind, --hands)"
        )
    return draw_mesh(pose_hands(clip.joints_m, sides=clip.sides), clip.cameras)[0]


def to_action(clip: TabletopClip) -> Action:
    """Return the cameras, hand joints and prompt of the clip, without hands that are never in view.

    An action has no hand that its cameras do not see; `World.execute` takes such joints separately.
    """
    joints = seen_hands(clip.cameras, clip.joints_m)
    return Action(cameras=clip.cameras, joints_m=joints, kind=clip.kind, prompt=clip.caption)


def to_episode(clips: Sequence[TabletopClip], *, fps: int) -> Episode:
    """Return a sequence as an episode with ground truth."""
    return Episode(
        state=clips[0].state,
        actions=tuple(to_action(clip) for clip in clips),
        fps=fps,
        first_frame=clips[0].first.colors,
        ground_truth=tuple(ground_truth_of(clip) for clip in clips),
    )


def ground_truth_of(clip: TabletopClip) -> GroundTruth:
    """Return the ground truth of a clip, in the form of an episode."""
    truth = observation_of(clip)
    return GroundTruth(
        frames=clip.frames,
        depth_m=truth.depth_m,
        object_ids=truth.object_ids,
        motions=truth.motions,
        target_id=clip.body_ids.get(clip.target),
    )


def observation_of(clip: TabletopClip) -> Observation:
    """Return the ground truth of a clip, in the form of a perception result."""
    # Hands have ids from 100 in renderings, and -1, -2, ... in an observation.
    ids = np.where(clip.ids >= FIRST_HAND, FIRST_HAND - 1 - clip.ids, clip.ids)
    return Observation(
        cameras=clip.cameras,
        depth_m=clip.depth_m,
        object_ids=np.where((ids > 0) & (ids < FIRST_BODY), 0, ids).astype(np.int32),
        names=clip.state.names,
        motions=motions_of({clip.body_ids[n]: p for n, p in clip.world_from_body.items()}),
    )
