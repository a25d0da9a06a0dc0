"""Clips of the tabletop world: rendering with complete ground truth, and conversions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from egosim_jax.geometry import pixel_rays, transform, upsample_intrinsics
from egosim_jax.perception.oracle import motions_of
from egosim_jax.perception.pipeline import Observation
from egosim_jax.rendering.reference import draw_hands, render
from egosim_jax.simulation.episode import Episode
from egosim_jax.types import (
    JOINTS,
    Action,
    Cameras,
    GroundTruth,
    Kind,
    SceneState,
    Triplet,
    near_view,
)
from egosim_jax.worlds.tabletop.bodies import Part
from egosim_jax.worlds.tabletop.hands import Side
from egosim_jax.worlds.tabletop.raycast import Picture, Placed, RayCaster
from egosim_jax.worlds.tabletop.scene import FIRST_BODY, FIRST_HAND, Scene

POINTS_PER_PIXEL = 2
"""Points of a clip's first state along each side of a pixel of its first frame."""
POINT_PX = 2
"""Size in pixels at which the points of a state are rendered."""

Arm = tuple[Float[np.ndarray, "j 3"], tuple[Part, ...]]
"""Joints of a hand in the world in meters, and the meshes of hand and forearm."""


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
    """Action of the clip, such as "carry"; "execute" where any action was executed."""
    target: str
    """Name of the manipulated body; empty if none was."""
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
    """Arrangement of all bodies in the first frame."""
    world_from_body: Mapping[str, Float[np.ndarray, "f 4 4"]]
    """Pose of every body in every frame; for an articulated body, of its moving part."""
    body_ids: Mapping[str, int]
    """Instance id in `ids` of every body or moving part."""
    parts: Mapping[str, Part]
    """Mesh of every body or moving part, in its own coordinates."""
    paints: Mapping[int, tuple[int, int, int]]
    """Unshaded RGB color by instance id."""
    first: Picture
    """First frame without hands."""
    state: SceneState
    """Points visible in the first frame without hands; a moving part and its case have own ids."""


def film(
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
    pictures, joints, paints = [], [], {}
    for scene, here, pose in zip(scenes, arms, cameras.world_from_camera, strict=True):
        placed = place(scene, here)
        joints.append(
            [np.full((JOINTS[kind], 3), np.nan) if arm is None else arm[0] for arm in here]
        )
        paints |= paints_of(placed)
        if bare:
            hidden = scene.number(target)
            placed = [x for x in placed if x.number < FIRST_HAND and x.number != hidden]
        pictures.append(_render(RayCaster(placed), pose, cameras))
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
        frames=np.stack([picture.colors for picture in pictures]),
        depth_m=np.stack([picture.depth_m for picture in pictures]),
        ids=np.stack([picture.ids for picture in pictures]),
        joints_m=np.array(joints),
        sides=sides,
        scene=scenes[0],
        world_from_body={
            body.name: np.stack([scene.first_part_pose(body.name) for scene in scenes])
            for body in bodies
        },
        body_ids={body.name: scenes[0].number(body.name) for body in bodies},
        parts={body.name: body.parts[0] for body in bodies},
        paints=paints,
        first=first,
        state=replace(state, step=number, provenance=provenance(seed)),
    )


def film_scenes(
    scenes: Sequence[Scene],
    cameras: Cameras,
    *,
    arms: Sequence[Sequence[Arm | None]] | None = None,
    without: str | None = None,
) -> list[Picture]:
    """Render the scenes and arms of some frames, `without` one of the bodies."""
    hidden = None if without is None else scenes[0].number(without)
    pictures = []
    for index, (scene, pose) in enumerate(zip(scenes, cameras.world_from_camera, strict=True)):
        placed = place(scene, () if arms is None else arms[index])
        caster = RayCaster([item for item in placed if item.number != hidden])
        pictures.append(_render(caster, pose, cameras))
    return pictures


def place(scene: Scene, arms: Sequence[Arm | None]) -> list[Placed]:
    """Return every part of a scene and of arms, which are in the world, with its pose and id."""
    return scene.placed() + [
        Placed(part=part, world_from_part=np.eye(4), number=FIRST_HAND + 2 * index + k)
        for index, arm in enumerate(arms)
        for k, part in enumerate(arm[1] if arm else ())
    ]


def paints_of(placed: Sequence[Placed]) -> dict[int, tuple[int, int, int]]:
    """Return the unshaded RGB color of parts by instance id."""
    return {item.number: item.part.paint.color for item in placed}


def provenance(seed: int) -> dict[str, str]:
    """Return the origin of a state of the tabletop world."""
    return {"world": "tabletop", "seed": str(seed)}


def _render(caster: RayCaster, pose: np.ndarray, cameras: Cameras) -> Picture:
    return caster.render(pose, cameras.intrinsics_px, height=cameras.height, width=cameras.width)


def first_view(scene: Scene, cameras: Cameras) -> tuple[Picture, SceneState]:
    """Render the first frame without hands, and unproject a finer rendering of it to points."""
    caster, pose = RayCaster(scene.placed()), cameras.world_from_camera[0]
    first = _render(caster, pose, cameras)
    intrinsics = upsample_intrinsics(cameras.intrinsics_px, POINTS_PER_PIXEL)
    height, width = POINTS_PER_PIXEL * cameras.height, POINTS_PER_PIXEL * cameras.width
    fine = caster.render(pose, intrinsics, height=height, width=width)
    seen = np.isfinite(fine.depth_m)
    rays = pixel_rays(intrinsics, height=height, width=width)
    points = transform(pose, rays[seen] * fine.depth_m[seen][:, None])
    ids = fine.ids[seen].astype(np.int32)
    return first, SceneState(
        points_m=points.astype(np.float32),
        colors=fine.colors[seen],
        object_ids=np.where(ids < FIRST_BODY, 0, ids).astype(np.int32),
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


def to_triplet(clip: TabletopClip, state: SceneState | None = None) -> Triplet:
    """Return the clip in EgoSim's format: prior and mask rendered from a state, hands as skeletons.

    By default the state is the clip's own and the first frame is ray cast. A given state, such as
    one carried over from the clip before in the closed loop, also renders the first frame, holes
    included. Hands and objects may leave the view. Raises `InputError` if the first frame shows no
    point.
    """
    view = render(state or clip.state, clip.cameras, point_px=POINT_PX)
    hands, _ = draw_hands(clip.joints_m, clip.cameras, kind=clip.kind)
    name = f"tabletop_{clip.kind}_{clip.seed}_{clip.number}"
    return Triplet(
        video_id=name,
        prompt=clip.caption,
        prior=view.frames,
        mask=view.mask,
        hands=hands,
        first_frame=clip.first.colors if state is None else view.frames[0],
        target=clip.frames,
        extra={"verb": clip.verb, "target": clip.target, "kind": clip.kind},
    )


def to_action(clip: TabletopClip) -> Action:
    """Return cameras, hand joints and prompt of the clip; hands that are never in view are missing.

    They are known to the true world only.
    """
    seen = np.asarray(near_view(clip.cameras, clip.joints_m).any(axis=0))[:, None, None]
    joints = clip.joints_m if seen.all() else np.where(seen, clip.joints_m, np.nan)
    return Action(cameras=clip.cameras, joints_m=joints, kind=clip.kind, prompt=clip.caption)


def to_episode(clips: Sequence[TabletopClip], *, fps: int) -> Episode:
    """Return a sequence as an episode with ground truth."""
    truths = [to_ground_truth(clip) for clip in clips]
    return Episode(
        state=clips[0].state,
        actions=tuple(to_action(clip) for clip in clips),
        fps=fps,
        first_frame=clips[0].first.colors,
        ground_truth=tuple(
            GroundTruth(
                frames=clip.frames,
                depth_m=truth.depth_m,
                object_ids=truth.object_ids,
                motions=truth.motions,
                target_id=clip.body_ids.get(clip.target),
            )
            for clip, truth in zip(clips, truths, strict=True)
        ),
    )


def to_ground_truth(clip: TabletopClip) -> Observation:
    """Return the ground truth of a clip, in the form that perception gives it."""
    ids = np.where(clip.ids >= FIRST_HAND, FIRST_HAND - 1 - clip.ids, clip.ids)
    return Observation(
        cameras=clip.cameras,
        depth_m=clip.depth_m,
        object_ids=np.where((ids > 0) & (ids < FIRST_BODY), 0, ids).astype(np.int32),
        names=clip.state.names,
        motions=motions_of({clip.body_ids[n]: p for n, p in clip.world_from_body.items()}),
    )
