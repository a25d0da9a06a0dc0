"""RGB-D images of boxes on a table, by ray casting, and a hand that pushes one.

The world is the first camera's, as in a user's own scene: x right, y down, z forward. Boxes are
given in the table's frame: x right, y away from the wearer, z up, the origin on the table.
"""

from dataclasses import dataclass

import numpy as np

from egosim_jax.geometry import invert, look_at, pixel_rays, transform
from egosim_jax.rendering.reference import draw_hands
from egosim_jax.types import Action
from tests.scenes import pinhole

EYE = np.array([0.0, -0.25, 0.45])
TABLE_FROM_CAMERA = look_at(EYE, np.array([0.0, 0.12, 0.0]), up=np.array([0.0, 0.0, 1.0]))
TABLE, WALL = (168, 140, 108), (205, 208, 200)
LIGHT = np.array([0.45, 0.65, 1.0])
"""Brightness of faces across x, y and z."""


@dataclass(frozen=True)
class Box:
    """A box: its lowest corner and size in meters, its color, and its object id."""

    corner_m: tuple[float, float, float]
    size_m: tuple[float, float, float]
    color: tuple[int, int, int]
    number: int


RED = Box((-0.06, 0.08, 0.0), (0.05, 0.05, 0.07), (190, 50, 45), 1)
GREEN = Box((0.1, 0.16, 0.0), (0.06, 0.06, 0.1), (60, 150, 70), 2)
TOP = Box((-0.4, -0.2, -0.02), (0.8, 0.65, 0.02), TABLE, 0)
BACK = Box((-2.0, 0.8, -0.7), (4.0, 0.1, 2.4), WALL, 0)
ROOM = (TOP, BACK)


def cameras(frames, height=96, width=160):
    """Cameras at rest, with the field of view of the tabletop world."""
    return pinhole(frames, 0.866 * width, height, width)


def cast(boxes, view):
    """Image, depth and object ids of the first frame."""
    rays = pixel_rays(view.intrinsics_px, height=view.height, width=view.width)
    rays = rays.reshape(-1, 3) @ TABLE_FROM_CAMERA[:3, :3].T
    depth = np.full(len(rays), np.inf)
    color, ids = np.zeros((len(rays), 3)), np.zeros(len(rays), np.int32)
    for box in (*ROOM, *boxes):
        low = np.array(box.corner_m) - TABLE_FROM_CAMERA[:3, 3]
        with np.errstate(divide="ignore"):
            ends = np.sort([low / rays, (low + box.size_m) / rays], axis=0)
        enter, leave = ends[0].max(axis=1), ends[1].min(axis=1)
        hit = (enter > 0) & (enter < leave) & (enter < depth)
        depth[hit], ids[hit] = enter[hit], box.number
        color[hit] = np.array(box.color) * LIGHT[ends[0].argmax(axis=1)[hit], None]
    shape = view.height, view.width
    grain = np.random.default_rng(0).normal(0, 2, (*shape, 3))
    image = np.clip(color.reshape(*shape, 3) + grain, 0, 255).astype(np.uint8)
    return image, depth.reshape(shape), ids.reshape(shape)


def hand(center_m, opening_m):
    """Joints of a right hand, in the table's frame; thumb and fingertips are around the center."""
    wrist = np.array([0.03, -0.13, 0.08])
    thumb = np.array([-opening_m / 2, 0.0, 0.0])
    tips = [[opening_m / 2, y, 0.0] for y in (0.014, -0.004, -0.022, -0.038)]
    joints = [wrist]
    joints += [wrist + share * (thumb - wrist) for share in (0.3, 0.55, 0.8, 1.0)]
    for side, tip in zip((0.0, 0.015, 0.03, 0.045), tips, strict=True):
        knuckle = np.array([0.01 + side, -0.05, 0.07])
        joints += [knuckle + share * (np.array(tip) - knuckle) for share in (0.0, 0.45, 0.75, 1.0)]
    return np.array(joints) + center_m


def push(view, box=RED, push_m=(0.1, 0.03, 0.0), prompt="The right hand pushes the red box."):
    """An action that closes on a box, pushes it and lets go; the box's offset in every frame."""
    frames = len(view.world_from_camera)
    time = np.linspace(0, 1, frames)
    share = np.interp(time, [0.3, 0.8], [0, 1])
    opening = box.size_m[0] + np.interp(time, [0, 0.25, 0.85, 1], [0.06, 0.004, 0.004, 0.06])
    offset = share[:, None] * np.array(push_m)
    middle = np.array(box.corner_m) + np.array(box.size_m) * [0.5, 0.5, 0.6]
    joints = [hand(middle + o, w) for o, w in zip(offset, opening, strict=True)]
    joints = transform(invert(TABLE_FROM_CAMERA), np.array(joints))
    return (
        Action(cameras=view, joints_m=joints[:, None], kind="human", prompt=prompt),
        offset,
    )


def film(boxes, action, offsets):
    """Frames of an action: boxes that move by `offsets` (by id, one per frame), and the hand."""
    view = action.cameras
    hands, hand_depth = draw_hands(action.joints_m, view, kind=action.kind)
    frames = []
    for number in range(len(view.world_from_camera)):
        placed = [
            Box(tuple(np.add(b.corner_m, offsets[b.number][number])), b.size_m, b.color, b.number)
            if b.number in offsets
            else b
            for b in boxes
        ]
        image, depth, _ = cast(placed, view)
        frames.append(np.where((hand_depth[number] < depth)[..., None], hands[number], image))
    return np.array(frames)
