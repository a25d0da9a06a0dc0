"""Actions: their checks in a scene, and their files; `episode.py` has the conventions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Float
from scipy.sparse.csgraph import connected_components

from egosim_jax.geometry import invert, pixels_of, transform
from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.bounded import named, quote, read_json
from egosim_jax.io.untrusted.npz import read_arrays
from egosim_jax.state.depth import DEPTH_M
from egosim_jax.types import (
    JOINTS,
    Action,
    Cameras,
    InputError,
    Kind,
    SceneState,
    seen_hands,
)

MAX_SPEED_M_S = 20.0
"""Maximum speed of the camera, in meters per second."""
ARRAYS = ("world_from_camera", "intrinsics_px", "joints_m")
"""Arrays of an action file."""
HANDS_SUFFIX = "_hands.npz"
"""Suffix of the file with the joints of all hands, next to the action file."""
MAX_JSON_BYTES = 256 << 20
"""Maximum size of a .json action file in bytes."""
_FINGERS = np.arange(1, 21).reshape(5, 4)
ORDERS = {
    "MANO's (index, middle, little, ring, thumb, then the tips)": np.array(
        [0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20]
    ),
    "from tip to knuckle": np.array([0, *_FINGERS[:, ::-1].ravel()]),
    "from tip to knuckle with the wrist last": np.array([20, *(_FINGERS[:, ::-1] - 1).ravel()]),
    "with the wrist last": np.array([20, *range(20)]),
    "by joint, each over all fingers": np.array([0, *np.arange(1, 21).reshape(4, 5).T.ravel()]),
}
"""Other joint orders of human hands, as indices that convert them to ours."""
MAX_FINGER_RATIO = 1.4
"""Maximum median ratio of a gripper's finger lengths; above it, the joint order is wrong."""
MAX_BONE_M = 0.07
"""Maximum length of a finger's bone outside of the palm, in meters."""
THUMB_RATIO = 1.25
"""Maximum length of the thumb's bone in the palm, relative to the shortest of the others."""
EXACT_CHANGE = 0.005
"""Maximum relative change of the distance of two joints that a bone of an exact hand connects."""
MAX_CHANGE = 0.05
"""Maximum relative change of a bone's length in the frames of an exact hand."""


def check_action(
    action: Action, *, state: SceneState, fps: int, continued: bool = False, any_hand: bool = False
) -> None:
    """Raise `InputError` for a camera that is too fast, a wrong joint order, or an unseen scene.

    The first camera must see the scene. If the action is `continued`, so must the last camera: it
    is the first one of the next action. `any_hand`: as in `check_order`.
    """
    _check_speed(action.cameras, fps)
    check_order(action, any_hand=any_hand)
    _check_scene(state, action.cameras, 0)
    if continued:
        _check_scene(state, action.cameras, -1)


def _check_speed(cameras: Cameras, fps: int) -> None:
    centers = cameras.world_from_camera[:, :3, 3]
    speed = np.linalg.norm(np.diff(centers, axis=0), axis=1) * fps
    if len(speed) and speed.max() > MAX_SPEED_M_S:
        frame = int(speed.argmax())
        raise InputError(
            f"the camera moves at {speed.max():.4g} m/s from frame {frame} to {frame + 1}, more "
            f"than {MAX_SPEED_M_S:g} m/s: world_from_camera must be in meters."
        )


def check_order(action: Action, *, any_hand: bool = False) -> None:
    """Raise `InputError` if the hands' joints are in another order.

    Human hands are checked by their bones. With `any_hand`, as for random actions of an
    environment, they need not have any, and are refused only if they have them in another order.
    """
    hands = action.joints_m[np.isfinite(action.joints_m).all(axis=(2, 3))]
    if not len(hands):
        return
    if action.kind == "robot":
        sides = np.linalg.norm(hands[:, 1:] - hands[:, :1], axis=-1)
        ratio = np.median(sides.max(axis=1) / np.maximum(sides.min(axis=1), 1e-9))
        if ratio > MAX_FINGER_RATIO:
            raise InputError(
                f"the fingers of a gripper differ in length by a factor of {ratio:.3g} "
                f"(median), more than {MAX_FINGER_RATIO:g}: its joints must be in the order wrist, "
                "thumb tip, index tip."
            )
        return
    for hand in np.moveaxis(action.joints_m, 1, 0):
        joints_m = hand[np.isfinite(hand).all(axis=(1, 2))]
        problem = _bone_problem(joints_m)
        if problem and (not any_hand or _is_reordered(joints_m)):
            raise InputError(
                f"the joints of the hands are not in the order of this package: {problem}. The "
                "order must be wrist, then thumb, index, middle, ring and little finger, each from "
                f"knuckle to tip.{_reordering(joints_m)}"
            )


def _reordering(hand: Float[np.ndarray, "n 21 3"]) -> str:
    """Return how to reorder joints that are in an order of `ORDERS`."""
    for name, order in ORDERS.items():
        if not _bone_problem(hand[:, order]):
            return (
                f" They seem to be in the order {name}: reorder them by joints_m[:, :, "
                f"{order.tolist()}]."
            )
    return ""


def _is_reordered(hand: Float[np.ndarray, "n 21 3"]) -> bool:
    """Return True if joints bend between the frames, and bones of constant length join them.

    One joint may be apart, which a dataset puts on no bone. What only moves as a whole may be any
    hand. Of 20,000 random straight paths from a hand, each joint to another place, none is refused.
    """
    variation = _variation(hand)
    pieces, _ = connected_components(variation < EXACT_CHANGE, directed=False)
    bends = (variation - np.eye(len(variation))).max() > MAX_CHANGE
    return pieces <= 2 and bool(bends)


def _variation(hand: Float[np.ndarray, "n 21 3"]) -> Float[np.ndarray, "21 21"]:
    """Return the relative change of the distance of each pair of joints; 1 for a joint itself."""
    pairs = np.linalg.norm(hand[:, :, None] - hand[:, None], axis=-1)
    return pairs.std(axis=0) / np.maximum(pairs.mean(axis=0), 1e-9) + np.eye(JOINTS["human"])


def _bone_problem(hand: Float[np.ndarray, "n 21 3"]) -> str | None:
    """Return why the bones cannot be a human hand's, or None."""
    if not len(hand):
        return None
    bones = _bones(hand)
    lengths = np.median(bones, axis=0)
    palm, longest = lengths[:, 0], float(lengths[:, 1:].max())
    change = float((bones.std(axis=0) / np.maximum(bones.mean(axis=0), 1e-9)).max())
    # Every joint has a bone, which keeps its length if nothing is noisy.
    if np.median(_variation(hand).min(axis=1)) < EXACT_CHANGE and change > MAX_CHANGE:
        return f"the length of a bone changes by {change:.0%} of its mean between frames"
    if longest > MAX_BONE_M:
        return f"a bone of a finger is {1e3 * longest:.0f} mm long (median)"
    if palm[0] > THUMB_RATIO * palm[1:].min():
        return "the first finger is farther from the wrist than another, so it is no thumb"
    return None


def _bones(hands: Float[np.ndarray, "n 21 3"]) -> Float[np.ndarray, "n 5 4"]:
    """Return the lengths of each finger's bones, from the wrist outwards."""
    outer = np.arange(1, JOINTS["human"])
    inner = np.where(outer % 4 == 1, 0, outer - 1)
    return np.linalg.norm(hands[:, outer] - hands[:, inner], axis=-1).reshape(-1, 5, 4)


def _check_scene(state: SceneState, cameras: Cameras, frame: int) -> None:
    """Raise `InputError` unless a frame's camera sees points at plausible distances in meters."""
    local = transform(invert(cameras.world_from_camera[frame]), state.points_m.astype(float))
    inside = pixels_of(cameras, local)[2]
    which = "last" if frame else "first"
    if not inside.any():
        raise InputError(
            f"its {which} camera sees none of the {len(local)} points of the state: state and "
            "cameras must be in one world frame (OpenCV axes, world_from_camera), in meters."
        )
    median = float(np.median(local[inside, 2]))
    if not DEPTH_M[0] <= median <= DEPTH_M[1]:
        raise InputError(
            f"the points that its {which} camera sees are {median:.4g} m away (median): it must be "
            f"from {DEPTH_M[0]} to {DEPTH_M[1]} m. Convert the state to meters."
        )


def save_action(path: Path, action: Action) -> None:
    """Write cameras and joints of an action to an .npz file."""
    cameras = action.cameras
    with atomic_write(path) as temporary:
        np.savez(
            temporary,
            world_from_camera=np.ascontiguousarray(cameras.world_from_camera, float),
            intrinsics_px=np.ascontiguousarray(cameras.intrinsics_px, float),
            joints_m=np.ascontiguousarray(action.joints_m),
        )


def load_action(path: Path, *, kind: Kind, size: tuple[int, int], prompt: str) -> Action:
    """Read an action's cameras and joints; `size` is height and width of its images."""
    names = {"world_from_camera": "float64", "intrinsics_px": "float64"}
    arrays = read_arrays(path, names, others=("joints_m",))
    return Action(
        cameras=Cameras(
            world_from_camera=arrays["world_from_camera"],
            intrinsics_px=arrays["intrinsics_px"],
            height=size[0],
            width=size[1],
        ),
        joints_m=arrays["joints_m"],
        kind=kind,
        prompt=prompt,
    )


@no_type_check
@dataclass(frozen=True, kw_only=True)
class FullAction(Action):
    """Action that also has the joints of hands out of view, for the ground-truth world.

    A model is not given a hand that is out of view; the true world still moves it.
    """

    all_joints_m: Float[np.ndarray, "f n j 3"]
    """Joints of all hands in the world, visible or hidden, in meters."""

    def __post_init__(self) -> None:
        """Check as `Action` does; `all_joints_m` must be finite and agree with `joints_m`."""
        super().__post_init__()
        placed, joints = np.asarray(self.all_joints_m), np.asarray(self.joints_m)
        agree = placed.shape == joints.shape and np.isfinite(placed).all()
        if not agree or not (np.isnan(joints) | (joints == placed)).all():
            raise InputError(
                f"all_joints_m is {placed.dtype} {placed.shape}: it must have the finite joints of "
                f"all hands {joints.shape}, equal to joints_m where joints_m is finite."
            )


def all_joints_of(action: Action) -> Float[np.ndarray, "f n j 3"]:
    """Return the joints of all hands, including hidden ones if the action has them."""
    return action.all_joints_m if isinstance(action, FullAction) else action.joints_m


def with_all_joints(action: Action, all_joints_m: Float[np.ndarray, "f n j 3"]) -> FullAction:
    """Return the action with the joints of all hands."""
    values = {field.name: getattr(action, field.name) for field in fields(Action)}
    return FullAction(**values, all_joints_m=all_joints_m)


def slice_action(action: Action, start: int, end: int | None) -> Action:
    """Return the action of some frames; a hand that is out of view in all of them is missing."""
    poses = action.cameras.world_from_camera[start:end]
    cameras = replace(action.cameras, world_from_camera=poses)
    joints = seen_hands(cameras, action.joints_m[start:end])
    piece = Action(cameras=cameras, joints_m=joints, kind=action.kind, prompt=action.prompt)
    if isinstance(action, FullAction):
        return with_all_joints(piece, action.all_joints_m[start:end])
    return piece


def split_action(action: Action, lengths: Sequence[int]) -> list[Action]:
    """Return the action of each chunk of a clip, by the numbers of frames of the chunks."""
    if len(lengths) == 1:
        return [action]
    ends = np.cumsum(lengths).tolist()
    return [slice_action(action, n - length, n) for length, n in zip(lengths, ends, strict=True)]


def join_actions(first: Action, then: Action) -> Action:
    """Return the action of consecutive frames."""
    poses = [action.cameras.world_from_camera for action in (first, then)]
    return Action(
        cameras=replace(then.cameras, world_from_camera=np.concatenate(poses)),
        joints_m=np.concatenate([first.joints_m, then.joints_m]),
        kind=then.kind,
        prompt=then.prompt,
    )


def save_placed(folder: Path, name: str, action: Action) -> None:
    """Write an action to NAME.npz, and the joints of a `FullAction` to NAME_hands.npz."""
    if isinstance(action, FullAction):  # first: NAME.npz alone is an action without hidden hands
        with atomic_write(folder / f"{name}{HANDS_SUFFIX}") as temporary:
            np.savez(temporary, placed_m=np.ascontiguousarray(action.all_joints_m, float))
    save_action(folder / f"{name}.npz", action)


def load_placed(
    folder: Path, name: str, *, kind: Kind, size: tuple[int, int], prompt: str
) -> Action:
    """Read the files of `save_placed`; `size` is the height and width of the cameras."""
    action = load_action(folder / f"{name}.npz", kind=kind, size=size, prompt=prompt)
    path = folder / f"{name}{HANDS_SUFFIX}"
    if not path.exists():
        return action
    return with_all_joints(action, read_arrays(path, {"placed_m": "float64"})["placed_m"])


def read_action(path: Path, *, height: int, width: int, prompt: str | None) -> Action:
    """Return the action of a user's .npz or .json file (`egosim episode make`).

    `prompt` replaces the file's; without either it is empty. The number of joints gives the kind of
    hands. Raises `InputError` naming the file.
    """
    values: Mapping[str, Any]
    if path.suffix == ".json":
        values = _read_json(path)
    elif path.suffix == ".npz":
        values = read_arrays(path, {}, others=ARRAYS, packed=True)
    else:
        raise InputError(f"{path}: actions are read from .npz and .json files. (--actions)")
    written = values.get("prompt")
    if not isinstance(written, str | None):
        raise InputError(f"{path}: prompt is {quote(written)}: it must be text.")
    if written == "" and not prompt:
        raise InputError(
            f"{path} has no prompt: give one per clip, or omit it to use none. (--prompts)"
        )
    prompt = prompt or written or ""
    joints = np.asarray(values["joints_m"])
    kinds: dict[int, Kind] = {count: kind for kind, count in JOINTS.items()}
    try:
        if joints.ndim != 4 or joints.shape[2] not in kinds:
            raise InputError(
                f"joints_m has shape {joints.shape}: it must be (frames, hands, joints, 3), with "
                "21 joints of a human hand or 3 of a gripper."
            )
        return Action(
            cameras=Cameras(
                world_from_camera=np.asarray(values["world_from_camera"], float),
                intrinsics_px=np.asarray(values["intrinsics_px"], float),
                height=height,
                width=width,
            ),
            joints_m=joints.astype(float),
            kind=kinds[joints.shape[2]],
            prompt=prompt,
        )
    except InputError as error:
        raise InputError(named(str(path), error)) from error


def _read_json(path: Path) -> dict[str, Any]:
    """Return the arrays and the prompt of a .json file; null hands become joints of NaN."""
    written = read_json(path, limit=MAX_JSON_BYTES)
    if not isinstance(written, dict) or not written.keys() <= {*ARRAYS, "prompt"}:
        raise InputError(f"{path}: must be an object of {', '.join(ARRAYS)} and prompt.")
    values: dict[str, Any] = {"prompt": written.get("prompt")}
    for name in ARRAYS:
        rows = written.get(name)
        if name == "joints_m" and isinstance(rows, list):
            rows = _fill_missing(rows)
        try:
            values[name] = np.array(rows, float)
        except (ValueError, TypeError, OverflowError):
            raise InputError(
                f"{path}: {name} is {quote(rows)}, not an array of numbers: all rows must have "
                "equal lengths."
            ) from None
    return values


def _fill_missing(frames: list[Any]) -> list[Any]:
    """Replace null hands by NaN joints, as many as the other hands have.

    If all hands are null, they count as human.
    """
    lists = [hands for hands in frames if isinstance(hands, list)]
    given = [hand for hands in lists for hand in hands if isinstance(hand, list)]
    nan = [[float("nan")] * 3] * (len(given[0]) if given else JOINTS["human"])
    return [
        [nan if hand is None else hand for hand in hands] if isinstance(hands, list) else hands
        for hands in frames
    ]
