"""The tabletop world: a table with a few objects, and hands or a gripper that manipulate one.

All ground truth is exact: frames are ray cast, and joints, poses, depth and ids come from the
same geometry. A seed gives a sequence of clips; the first frame of each clip is the last frame of
the clip before.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from egosim_jax.episode import Episode
from egosim_jax.geometry import look_at, pixel_rays, transform, upsample_intrinsics
from egosim_jax.perception.oracle import motions_of
from egosim_jax.perception.pipeline import Observation
from egosim_jax.rendering.reference import draw_hands, render
from egosim_jax.types import Action, Cameras, GroundTruth, Kind, SceneState, Triplet, VideoSpec
from egosim_jax.worlds.tabletop import actions
from egosim_jax.worlds.tabletop.actions import Hand, Moment
from egosim_jax.worlds.tabletop.bodies import Part
from egosim_jax.worlds.tabletop.hands import Side
from egosim_jax.worlds.tabletop.raycast import Picture, Placed, RayCaster
from egosim_jax.worlds.tabletop.scene import (
    FIRST_BODY,
    FIRST_HAND,
    Scene,
    make_scene,
    with_cloths,
)

FIELD_OF_VIEW = 60.0
"""Horizontal field of view in degrees."""
POINTS_PER_PIXEL = 2
"""Points of a clip's first state along each side of a pixel of its first frame."""
POINT_PX = 2
"""Size in pixels at which the points of a state are rendered."""


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
    """Action of the clip, such as "carry"."""
    target: str
    """Name of the manipulated body."""
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
    """World positions of the joints of n hands in meters."""
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


def make_sequence(
    seed: int,
    *,
    spec: VideoSpec,
    clips: int = 1,
    kind: Kind = "human",
    bare: bool = False,
    black_cloths: int | None = None,
) -> Iterator[TabletopClip]:
    """Yield the clips of a seed, each `spec.frames` long; a robot has one gripper.

    Equal seeds give equal clips at equal sizes, and the same events at any size. `bare` renders the
    same clips without hands and manipulated body, which gives their background. `black_cloths` is
    the most that lie on the table; they change nothing else.
    """
    rng, scene, eye, sway = _begin(seed, kind, black_cloths)
    hands: tuple[Hand, ...] = ()
    for number in range(clips):
        intent = actions.choose(scene, rng, hand=hands[0] if hands else None)
        if not hands:
            hands = (actions.start_hand(scene, intent, kind, rng),)
            if kind == "human" and rng.random() < 0.35:
                hands = (*hands, actions.waiting_hand(hands[0].side, rng))
        moments = actions.act(scene, hands, intent, kind, frames=spec.frames)
        cameras = _cameras(number + np.linspace(0, 1, spec.frames), eye, sway, spec)
        yield _clip(seed, number, kind, intent, moments, cameras, bare=bare)
        scene, hands = moments[-1].scene, moments[-1].hands


def opening(
    seed: int, *, spec: VideoSpec, kind: Kind = "human"
) -> tuple[Scene, Cameras, Picture, SceneState]:
    """Return scene, camera, first frame without hands and state of a seed's first clip."""
    _, scene, eye, sway = _begin(seed, kind, None)
    cameras = _cameras(np.zeros(1), eye, sway, spec)
    first, state = _first_view(scene, cameras)
    return scene, cameras, first, replace(state, provenance=_provenance(seed))


def _begin(
    seed: int, kind: Kind, black_cloths: int | None
) -> tuple[np.random.Generator, Scene, np.ndarray, tuple[Any, Any]]:
    """Return generator of random numbers, scene, eye and sway of the head of a seed."""
    stream = 0 if kind == "human" else 1
    rng = np.random.default_rng([seed, stream])
    scene = make_scene(rng)
    if black_cloths is not None:
        scene = with_cloths(scene, np.random.default_rng([seed, stream, 1]), black_cloths)
    sway = rng.uniform(0, 2 * np.pi, 6), rng.uniform(0.6, 1.4, 6)
    eye = np.array([0.0, -0.10, 0.46]) + rng.normal(0, [0.025, 0.015, 0.02])
    return rng, scene, eye, sway


def _provenance(seed: int) -> dict[str, str]:
    return {"world": "tabletop", "seed": str(seed)}


def _cameras(times: np.ndarray, eye: np.ndarray, sway: tuple[Any, Any], spec: VideoSpec) -> Cameras:
    """Return cameras of a head that sways while it looks at the middle of the table."""
    phases, rates = sway
    swing = np.sin(phases + 2 * np.pi * 0.45 * rates * times[:, None])
    eyes = eye + swing[:, :3] * [0.04, 0.02, 0.02]
    targets = np.array([0.0, 0.275, 0.03]) + swing[:, 3:] * [0.04, 0.025, 0.01]
    up = np.array([0.0, 0.0, 1.0])
    poses = [look_at(a, b, up=up) for a, b in zip(eyes, targets, strict=True)]
    focal = spec.width / 2 / np.tan(np.radians(FIELD_OF_VIEW / 2))
    middle = (spec.width - 1) / 2, (spec.height - 1) / 2
    return Cameras(
        world_from_camera=np.stack(poses),
        intrinsics_px=np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]]),
        height=spec.height,
        width=spec.width,
    )


def _clip(
    seed: int,
    number: int,
    kind: Kind,
    intent: actions.Intent,
    moments: list[Moment],
    cameras: Cameras,
    *,
    bare: bool,
) -> TabletopClip:
    pictures, joints, paints = [], [], {}
    for moment, pose in zip(moments, cameras.world_from_camera, strict=True):
        placed = moment.scene.placed()
        here = []
        for index, hand in enumerate(moment.hands):
            keypoints, parts = actions.hand_parts(hand, kind)
            here.append(keypoints)
            placed += [
                Placed(part=part, world_from_part=np.eye(4), number=FIRST_HAND + 2 * index + k)
                for k, part in enumerate(parts)
            ]
        joints.append(here)
        paints |= {item.number: item.part.paint.color for item in placed}
        if bare:
            target = moment.scene.number(intent.name)
            placed = [x for x in placed if x.number < FIRST_HAND and x.number != target]
        pictures.append(_render(RayCaster(placed), pose, cameras))
    first, state = _first_view(moments[0].scene, cameras)
    who = f"The {moments[0].hands[0].side} hand" if kind == "human" else "The gripper"
    return TabletopClip(
        seed=seed,
        number=number,
        kind=kind,
        verb=intent.verb,
        target=intent.name,
        caption=f"{who} {intent.caption}",
        cameras=cameras,
        frames=np.stack([picture.colors for picture in pictures]),
        depth_m=np.stack([picture.depth_m for picture in pictures]),
        ids=np.stack([picture.ids for picture in pictures]),
        joints_m=np.array(joints),
        sides=tuple(hand.side for hand in moments[0].hands),
        scene=moments[0].scene,
        world_from_body=_poses(moments),
        body_ids=_numbers(moments[0].scene),
        parts={body.name: body.parts[0] for body in moments[0].scene.bodies},
        paints=paints,
        first=first,
        state=replace(state, step=number, provenance=_provenance(seed)),
    )


def _render(caster: RayCaster, pose: np.ndarray, cameras: Cameras) -> Picture:
    return caster.render(pose, cameras.intrinsics_px, height=cameras.height, width=cameras.width)


def _poses(moments: list[Moment]) -> dict[str, np.ndarray]:
    bodies = moments[0].scene.bodies
    return {
        body.name: np.stack([moment.scene.first_part_pose(body.name) for moment in moments])
        for body in bodies
    }


def _numbers(scene: Scene) -> dict[str, int]:
    return {body.name: scene.number(body.name) for body in scene.bodies}


def _first_view(scene: Scene, cameras: Cameras) -> tuple[Picture, SceneState]:
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
    """Return cameras, hand joints and prompt of the clip."""
    return Action(cameras=clip.cameras, joints_m=clip.joints_m, kind=clip.kind, prompt=clip.caption)


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
                target_id=clip.body_ids[clip.target],
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
