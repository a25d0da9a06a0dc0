"""Conversion of clips with hands to clips with robots: video, joint positions and report."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any, Literal, no_type_check

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from egosim_jax.data.lerobot_writer import ClipRecord, EpisodeRecord, write_lerobot
from egosim_jax.dynamics import predict
from egosim_jax.geometry import level_axes
from egosim_jax.rendering import POINT_PX, PriorKind, Renderer
from egosim_jax.robots.arms import Arm
from egosim_jax.robots.background import Background, first_cloud, remove_hands
from egosim_jax.robots.drawing import Drawn, Shape, draw
from egosim_jax.robots.models import RobotModel, limits_of
from egosim_jax.robots.placement import Base, Placed, place
from egosim_jax.robots.retarget import Grips, continuous, grips_of, keypoints_of
from egosim_jax.robots.sources import Source
from egosim_jax.simulation.episode import Episode
from egosim_jax.simulation.start import Start
from egosim_jax.state.planes import vertical
from egosim_jax.types import Action, InputError, SceneState, Triplet, seen_hands

Hands = Literal["acting", "all"]
"""Hands that get a robot: the one that moves most, or every one; all hands are removed."""
AROUND_M = 0.25
"""Horizontal distance from the hand's path in which the table is searched."""
BIN_M = 0.01
"""Resolution of the table's height."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Follower:
    """A robot that follows one hand of an episode."""

    robot: RobotModel
    """Model of the arm."""
    hand: int
    """Number of the hand in the episode."""
    grips: Grips
    """Path of the hand's grips."""
    placed: Placed
    """Base, and motion of the arm."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Conversion:
    """Clips with robots in place of hands."""

    source: Source
    """Clips with hands."""
    followers: tuple[Follower, ...]
    """Robots, one for each hand that is followed."""
    backgrounds: tuple[Background, ...]
    """Frames of each clip without hands."""
    drawn: tuple[Drawn, ...]
    """Frames of each clip with robots."""

    @property
    def episode(self) -> Episode:
        """Actions and frames with hands."""
        return self.source.episode

    @property
    def fps(self) -> Fraction:
        """Frames per second."""
        return self.source.rate

    @property
    def arm(self) -> Arm:
        """Arm of all robots."""
        return self.followers[0].robot.arm

    def span(self, clip: int) -> slice:
        """Return the frames of a clip in the tracks; neighbors share a frame."""
        count = self.episode.shape[0]
        return slice(clip * (count - 1), clip * (count - 1) + count)


def convert(
    source: Source, robot: RobotModel, *, hands: Hands = "acting", base: Base | None = None
) -> Conversion:
    """Return the clips of a source with robots in place of the hands.

    Raises `InputError` without hands, and without depth and ids of each pixel.
    """
    episode = source.episode
    joints = _path([action.joints_m for action in episode.actions])
    poses = _path([action.cameras.world_from_camera for action in episode.actions])
    cameras = replace(episode.actions[0].cameras, world_from_camera=poses)
    chosen = _hands(joints, hands)
    backgrounds = _backgrounds(source)
    if base is not None and len(chosen) > 1:
        raise InputError("--base places one robot: use it with --hands acting. (--base)")
    world_from_up = up_frame(episode.state, joints[:, chosen], poses[0])
    followers = []
    for hand in chosen:
        grips = grips_of(joints[:, hand], fps=float(source.rate))
        placed = place(
            robot,
            grips,
            world_from_up=world_from_up,
            cameras=cameras,
            fps=float(source.rate),
            base=base,
        )
        followers.append(Follower(robot=robot, hand=hand, grips=grips, placed=placed))
    found = Conversion(source=source, followers=tuple(followers), backgrounds=backgrounds, drawn=())
    return replace(found, drawn=tuple(_drawn(found, world_from_up)))


def _path(clips: list[np.ndarray]) -> np.ndarray:
    """Join clips; each begins with the last frame of the clip before."""
    return np.concatenate([clips[0], *(clip[1:] for clip in clips[1:])])


def _hands(joints: Float[np.ndarray, "f n j 3"], hands: Hands) -> list[int]:
    """Return the numbers of the hands to follow."""
    seen = np.isfinite(joints).all(axis=(2, 3))
    present = np.flatnonzero(seen.any(axis=0)).tolist()
    if not present:
        raise InputError("The episode has no hands: there is nothing to follow. (SOURCE)")
    if hands == "all":
        return present
    steps = np.linalg.norm(np.diff(joints.mean(axis=2), axis=0), axis=-1)
    return [max(present, key=lambda hand: float(np.nansum(steps[:, hand])))]


def up_frame(
    state: SceneState,
    joints_m: Float[np.ndarray, "f n j 3"],
    world_from_camera: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "4 4"]:
    """Return a frame on the table below the hands, z upwards."""
    up = vertical(state, world_from_camera)
    turn = level_axes(up)
    tips = joints_m[np.isfinite(joints_m).all(axis=(2, 3))][:, 1:].reshape(-1, 3) @ turn
    points = state.points_m[state.object_ids == 0] @ turn
    low, high = tips.min(axis=0) - AROUND_M, tips.max(axis=0) + AROUND_M
    near = (points[:, :2] > low[:2]).all(axis=1) & (points[:, :2] < high[:2]).all(axis=1)
    near &= (points[:, 2] > low[2]) & (points[:, 2] < tips[:, 2].min() + 2 * BIN_M)
    heights = points[near, 2]
    height = tips[:, 2].min()
    if len(heights):
        bins = np.round(heights / BIN_M).astype(int)
        common = bins.min() + np.bincount(bins - bins.min()).argmax()
        height = np.median(heights[bins == common])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, height * up
    return pose


def _backgrounds(source: Source) -> tuple[Background, ...]:
    episode = source.episode
    image, cameras = episode.first_frame, episode.actions[0].cameras
    first = None if image is None else first_cloud(image, episode.state, cameras)
    return tuple(
        remove_hands(state, action.cameras, truth, first=first, estimated=source.estimated)
        for state, action, truth in zip(
            source.states, episode.actions, episode.ground_truth, strict=True
        )
    )


def _drawn(conversion: Conversion, world_from_up: np.ndarray) -> list[Drawn]:
    shapes = [Shape(robot=follower.robot) for follower in conversion.followers]
    colors = [color for shape in shapes for _, _, color in shape.geoms]
    found = []
    for clip, action in enumerate(conversion.episode.actions):
        background, span = conversion.backgrounds[clip], conversion.span(clip)
        meshes = [
            list(
                chain.from_iterable(
                    shape.pose(
                        f.placed.track.q[frame],
                        float(f.placed.track.opening_m[frame]),
                        f.placed.world_from_base,
                    )
                    for shape, f in zip(shapes, conversion.followers, strict=True)
                )
            )
            for frame in range(span.start, span.stop)
        ]
        found.append(
            draw(
                background.frames,
                background.depth_m,
                action.cameras,
                meshes,
                colors,
                world_from_up=world_from_up,
            )
        )
    return found


def video_of(conversion: Conversion) -> UInt8[np.ndarray, "f h w 3"]:
    """Return all frames with robots, each once."""
    return _path([drawn.frames for drawn in conversion.drawn])


def report_of(conversion: Conversion) -> dict[str, Any]:
    """Return the reached frames and the sources of the pixels behind hands, as JSON."""
    counts = ("from_state", "from_first_frame", "from_frames", "unknown", "shadow")
    return {
        "robots": [_report(f, float(conversion.fps)) for f in conversion.followers],
        "hand_pixels": {
            "all": sum(int(b.hidden.sum()) for b in conversion.backgrounds),
            **{name: sum(getattr(b, name) for b in conversion.backgrounds) for name in counts},
        },
    }


def _report(follower: Follower, fps: float) -> dict[str, Any]:
    track, grips, arm = follower.placed.track, follower.grips, follower.robot.arm
    base = follower.placed.world_from_base
    pinch = track.base_from_grip[:, :3, 3] @ base[:3, :3].T + base[:3, 3]
    error = np.linalg.norm(pinch - grips.pinch_m, axis=1)
    joints = track.q[:, follower.robot.joint_at]
    ends = [limits_of(follower.robot.mj, name) or (-np.inf, np.inf) for name in arm.joints]
    low, high = np.array(ends, float).T
    margin = float(min((joints - low).min(), (high - joints).min()))
    speed = np.abs(np.diff(joints, axis=0)) * fps / np.array(arm.speeds)
    missed = np.flatnonzero(grips.seen & ~track.reached)
    return {
        "robot": arm.name,
        "hand": follower.hand,
        "world_from_base": base.round(6).tolist(),
        "largest_opening_m": follower.robot.largest_m,
        "frames": len(joints),
        "frames_without_hand": int((~grips.seen).sum()),
        "frames_at_camera": int((~follower.placed.clear).sum()),
        "reached": float(track.reached[grips.seen].mean()),
        "missed_frames": {int(n): round(float(track.error_m[n]), 5) for n in missed},
        "pinch_error_m": {"median": float(np.nanmedian(error)), "max": float(np.nanmax(error))},
        "turn_error_degrees": {
            "median": float(np.degrees(np.median(track.turn_error))),
            "max": float(np.degrees(track.turn_error.max())),
        },
        "least_distance_from_limits": margin if np.isfinite(margin) else None,
        "speed_in_limits": float(speed.max()) if speed.size else 0.0,
        "least_distance_from_table_m": float(track.clearance_m.min()),
        "least_distance_of_links_m": float(track.apart_m.min()),
    }


def export(conversion: Conversion, folder: Path) -> None:
    """Write a LeRobot dataset: joint positions, opening and grip of each robot, and the frames."""
    names, rows, grips = [], [], {}
    for follower in conversion.followers:
        prefix = f"{follower.hand}." if len(conversion.followers) > 1 else ""
        names += [f"{prefix}{name}.pos" for name in conversion.arm.joints]
        names += [f"{prefix}gripper.opening"]
        rows.append(rows_of(follower))
        grips[f"observation.{prefix}grip"] = poses_of(follower)
    table = np.concatenate(rows, axis=1)
    clips = [
        ClipRecord(
            frames=conversion.drawn[clip].frames,
            rows=table[conversion.span(clip)],
            action=_skeletons(conversion, clip, action),
            others={name: values[conversion.span(clip)] for name, values in grips.items()},
        )
        for clip, action in enumerate(conversion.episode.actions)
    ]
    record = EpisodeRecord(clips=clips, save_scene=Start.of(conversion.episode).save)
    write_lerobot(
        folder,
        [record],
        names=names,
        fps=conversion.fps,
        robot_type=conversion.arm.name,
    )


def triplets_of(
    conversion: Conversion,
    name: str,
    renderer: Renderer,
    *,
    point_px: int = POINT_PX,
    prior: PriorKind = "static",
) -> Iterator[Triplet]:
    """Yield the triplet of each clip: the scene before it, the grippers' skeletons, the robots.

    `name` begins the ids of the clips. `point_px` and `prior` are the model's.
    """
    source = conversion.source
    for clip, (state, human) in enumerate(zip(source.states, source.episode.actions, strict=True)):
        action = _skeletons(conversion, clip, human)
        fps = source.episode.fps
        motion = predict(state, human, fps=fps) if prior == "predicted" else None
        view = renderer.render(state, action.cameras, point_px=point_px, motion=motion)
        hands, _ = renderer.draw_hands(action.joints_m, action.cameras, kind="robot")
        yield Triplet(
            video_id=f"{name}_{clip + 1}",
            prompt=action.prompt,
            prior=view.frames,
            mask=view.mask,
            hands=hands,
            first_frame=conversion.backgrounds[clip].frames[0],
            target=conversion.drawn[clip].frames,
            extra={"split": "train", "kind": "robot", "robot": conversion.arm.name},
        )


def rows_of(follower: Follower) -> Float[np.ndarray, "f d"]:
    """Return joint positions in radians and the opening, from 0 to 1, in each frame."""
    track, robot = follower.placed.track, follower.robot
    opening = track.opening_m[:, None] / robot.largest_m
    return np.concatenate([track.q[:, robot.joint_at], opening], axis=1)


def poses_of(follower: Follower) -> Float[np.ndarray, "f 7"]:
    """Return place and quaternion (x, y, z, w) of the grip in the base frame, in each frame."""
    poses = follower.placed.track.base_from_grip
    turns = continuous(Rotation.from_matrix(poses[:, :3, :3]).as_quat())
    return np.concatenate([poses[:, :3, 3], turns], axis=1)


def _skeletons(conversion: Conversion, clip: int, action: Action) -> Action:
    """Return the action of a clip with the grippers' three keypoints."""
    span, hands = conversion.span(clip), []
    for follower in conversion.followers:
        track = follower.placed.track
        pose = follower.placed.world_from_base @ track.base_from_grip[span]
        hands.append(keypoints_of(pose, track.opening_m[span]))
    joints = np.stack(hands, axis=1)
    return Action(
        cameras=action.cameras,
        joints_m=seen_hands(action.cameras, joints),
        kind="robot",
        prompt=action.prompt,
    )
