"""Data of the simulation loop: state, action, view, triplet, clip, perceived, ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8

from egosim_jax.types.cameras import Cameras, is_rigid
from egosim_jax.types.settings import InputError, check_video
from egosim_jax.types.shown import Shown

Kind = Literal["human", "robot"]
"""Kind of hands: human with 21 keypoints, or robot grippers with 3."""


@no_type_check
@dataclass(frozen=True, kw_only=True, repr=False)
class SceneState(Shown):
    """State of the world: colored 3D points, each with its object instance and last observation."""

    points_m: Float32[np.ndarray, "n 3"]
    """Positions in the world, in meters."""
    colors: UInt8[np.ndarray, "n 3"]
    object_ids: Int32[np.ndarray, " n"]
    """Object instance of each point; 0 is the background."""
    last_seen: Int32[np.ndarray, " n"]
    """Step in which each point was last observed."""
    intrinsics_px: Float[np.ndarray, "3 3"]
    """Intrinsics of the camera that observed the scene, in pixels."""
    step: int = 0
    """Number of clips fused into the state."""
    names: Mapping[int, str] = field(default_factory=dict)
    """Names of object instances, by id."""
    world_from_object: Mapping[int, Float[np.ndarray, "4 4"]] = field(default_factory=dict)
    """Poses of the objects that have moved, relative to where they were first observed."""
    held: Mapping[int, int] = field(default_factory=dict)
    """Object that each hand held at the end of the last clip, by the hand's index in the action."""
    provenance: Mapping[str, str] = field(default_factory=dict)
    """Origin of the state, as free key-value pairs."""

    def __post_init__(self) -> None:
        """Check shapes and dtypes, which are never converted, and that all points are finite."""
        count = len(self.points_m)
        for name, dtype, shape in (
            ("points_m", np.float32, (count, 3)),
            ("colors", np.uint8, (count, 3)),
            ("object_ids", np.int32, (count,)),
            ("last_seen", np.int32, (count,)),
        ):
            value = getattr(self, name)
            have = getattr(value, "dtype", type(value).__name__)
            if np.shape(value) != shape or have != np.dtype(dtype):
                raise InputError(
                    f"{name} of a state of {count} points is {have} {np.shape(value)}: it must be "
                    f"{np.dtype(dtype)} {shape}, one for each point. Convert it with "
                    f"astype(np.{np.dtype(dtype)})."
                )
        if not count:
            raise InputError("SceneState must contain at least one point.")
        poses = {f"pose of object {n}": pose for n, pose in self.world_from_object.items()}
        for name, matrix in {"intrinsics_px": self.intrinsics_px, **poses}.items():
            size = 3 if name == "intrinsics_px" else 4
            if np.shape(matrix) != (size, size) or not np.isfinite(matrix).all():
                raise InputError(
                    f"The {name} of a state must be finite and of shape ({size}, {size}), not "
                    f"{np.shape(matrix)}."
                )
        finite = np.isfinite(self.points_m).all(axis=1)
        if not finite.all():
            raise InputError(
                f"Point {int(np.argmin(finite))} of the state is not finite: "
                f"{self.points_m[np.argmin(finite)]}."
            )


def object_name(number: int, names: Mapping[int, str]) -> str:
    """Return the name of an object, or its number if it has none."""
    return names.get(number, f"object {number}")


JOINTS: Mapping[Kind, int] = {"human": 21, "robot": 3}
"""Number of keypoints of a hand, by kind."""
HAND_SIZE_M = (0.01, 1.0)
"""Minimum and maximum plausible extent of a hand, in meters."""
NEAR_IMAGE = 0.25
"""Margin around the image in which a joint counts as near the view, in widths and heights."""
REACH_M = 3.0
"""Maximum distance in front of a camera at which a joint counts as near the view, in meters."""


def near_view(cameras: Cameras, joints_m: Float[np.ndarray, "f n j 3"]) -> Bool[np.ndarray, "f n"]:
    """Return which hands have a joint within reach of the camera and in or near its image."""
    poses = cameras.world_from_camera
    present = np.asarray(np.isfinite(joints_m).all(axis=(2, 3)))
    where = np.where(present[:, :, None, None], joints_m, 0.0) - poses[:, None, None, :3, 3]
    x, y, z = np.moveaxis(np.einsum("fnjc,fcd->fnjd", where, poses[:, :3, :3]), -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = cameras.intrinsics_px[0, 0] * x / z + cameras.intrinsics_px[0, 2]
        v = cameras.intrinsics_px[1, 1] * y / z + cameras.intrinsics_px[1, 2]
    near_u, near_v = NEAR_IMAGE * cameras.width, NEAR_IMAGE * cameras.height
    seen = (z > 0) & (z < REACH_M) & (u > -near_u) & (u < cameras.width + near_u)
    seen &= (v > -near_v) & (v < cameras.height + near_v) & present[..., None]
    return np.asarray(seen.any(axis=2))


def seen_hands(
    cameras: Cameras, joints_m: Float[np.ndarray, "f n j 3"]
) -> Float[np.ndarray, "f n j 3"]:
    """Return the joints with NaN for hands that are never near the view (`near_view`)."""
    seen = np.asarray(near_view(cameras, joints_m).any(axis=0))[:, None, None]
    return joints_m if seen.all() else np.where(seen, joints_m, np.nan)


@no_type_check
def check_hands(
    joints_m: Float[np.ndarray, "f n j 3"], kind: Kind, frames: int
) -> Bool[np.ndarray, "f n"]:
    """Return which hands are given; raise `InputError` if joints are not of such hands."""
    if kind not in JOINTS:
        raise InputError(f"The kind of hands must be 'human' or 'robot', not {str(kind)[:40]!r}.")
    joints, wanted = np.asarray(joints_m), JOINTS[kind]
    shape = (frames, max(1, joints.shape[1] if joints.ndim == 4 else 1), wanted, 3)
    if joints.shape != shape or joints.dtype.kind != "f":
        raise InputError(
            f"joints_m is {joints.dtype} {joints.shape}: {kind} hands of a path of {frames} "
            f"cameras must be floats ({frames}, hands, {wanted}, 3), at least one hand. A missing "
            "hand has joints of NaN."
        )
    present = np.asarray(np.isfinite(joints).all(axis=(2, 3)))
    broken = ~present & ~np.isnan(joints).all(axis=(2, 3))
    if broken.any():
        frame, hand = np.argwhere(broken)[0].tolist()
        raise InputError(
            f"Hand {hand} of frame {frame} is only partly finite: give all joints of a hand, or "
            "NaN for all where it is missing."
        )
    extent = np.linalg.norm(np.ptp(joints, axis=2), axis=-1)
    low, high = HAND_SIZE_M
    bad = present & ~((extent >= low) & (extent <= high))
    if bad.any():
        frame, hand = np.argwhere(bad)[0].tolist()
        raise InputError(
            f"Hand {hand} of frame {frame} is {extent[frame, hand]:.4g} m large: a hand has {low} "
            f"to {high} m. Joints must be in meters."
        )
    return present


@no_type_check
@dataclass(frozen=True, kw_only=True, repr=False)
class Action(Shown):
    """The wearer's camera path, hands and caption for one clip."""

    cameras: Cameras
    """Trajectory of the head's camera."""
    joints_m: Float[np.ndarray, "f n j 3"]
    """Joints of n hands in the world, in meters: 21 of a human hand, 3 of a gripper.

    All joints of a hand are NaN in frames where it is missing. For a clip without hands, give one
    hand that is missing from all frames."""
    kind: Kind
    """Kind of hands."""
    prompt: str
    """Caption of the clip."""

    def __post_init__(self) -> None:
        """Check kind, joint count, frame count, units and frame of reference.

        Raises `InputError`, also if a hand never comes near any camera's view: then it is not in
        world coordinates.
        """
        present = check_hands(self.joints_m, self.kind, len(self.cameras.world_from_camera))
        if not isinstance(self.prompt, str):
            raise InputError(f"The prompt must be text, not {type(self.prompt).__name__}.")
        if present.any():
            self._check_place(self.joints_m, present)

    def _check_place(self, joints: np.ndarray, present: np.ndarray) -> None:
        """Raise `InputError` if no joint of a hand is within reach of a camera and near its image.

        Each hand that is given in any frame is checked separately.
        """
        seen = near_view(self.cameras, joints)
        lost = present.any(axis=0) & ~seen.any(axis=0)
        if lost.any():
            raise InputError(
                f"No joint of hand {int(np.argmax(lost))} comes near the view of the cameras, at "
                f"most {REACH_M:g} m away, in any frame: joints must be in world coordinates, as "
                "the cameras are, and in meters. A hand that is out of sight all the time is given "
                "as NaN."
            )


@no_type_check
@dataclass(frozen=True, kw_only=True, repr=False)
class View(Shown):
    """Rendering of a state along a camera trajectory."""

    frames: UInt8[np.ndarray, "f h w 3"]
    """Rendered colors; black where no point is visible.

    Where an object has moved away from what no point shows, its image of before."""
    mask: UInt8[np.ndarray, "f h w"]
    """Unobserved pixels, black in the frames: 255 not observed, 0 observed."""
    depth_m: Float32[np.ndarray, "f h w"]
    """Depth along the camera's z axis in meters; infinite where no point is visible."""
    object_ids: Int32[np.ndarray, "f h w"]
    """Object instance of each pixel; 0 for the background and where no point is visible."""


@no_type_check
@dataclass(frozen=True, kw_only=True, repr=False)
class Triplet(Shown):
    """Conditions of one clip at the model's length and size, and its target video if known."""

    video_id: str
    prompt: str
    prior: UInt8[np.ndarray, "f h w 3"]
    """The scene rendered along the camera path, without hands."""
    mask: UInt8[np.ndarray, "f h w"]
    """Unobserved pixels of the prior: 255 not observed, 0 observed, gray where it was resized."""
    hands: UInt8[np.ndarray, "f h w 3"]
    """The hand skeletons on black."""
    first_frame: UInt8[np.ndarray, "h w 3"]
    """The image for CLIP: the scene at the first frame."""
    target: UInt8[np.ndarray, "f h w 3"] | None = None
    """The recorded video."""
    extra: Mapping[str, str] = field(default_factory=dict)
    """Further metadata columns, carried to the results."""
    tokens: Float32[np.ndarray, "m e"] | None = None
    """Tokens for the denoiser's image branch where it has no encoder; None: zeros."""


@no_type_check
@dataclass(frozen=True, kw_only=True, repr=False)
class Clip(Shown):
    """A generated video."""

    frames: UInt8[np.ndarray, "f h w 3"]
    fps: int

    def __post_init__(self) -> None:
        """Check that the frames are a uint8 RGB video."""
        check_video("A clip", self.frames)


@no_type_check
@dataclass(frozen=True, kw_only=True, repr=False)
class Perceived(Shown):
    """Reconstruction of a clip in world coordinates, frame by frame."""

    step: int
    """Number of the clip, from 1."""
    frames: UInt8[np.ndarray, "f h w 3"]
    cameras: Cameras
    depth_m: Float32[np.ndarray, "f h w"]
    """Depth along the camera's z axis in meters; infinite where unknown."""
    object_ids: Int32[np.ndarray, "f h w"]
    """Object instance of each pixel: 0 background, negative hands and arms, never fused."""
    names: Mapping[int, str]
    """Names of object instances, by id."""
    world_from_object: Mapping[int, Float[np.ndarray, "f 4 4"]]
    """Poses of tracked objects; the first frame has the pose of the state before."""
    interacted_frames: Mapping[int, Bool[np.ndarray, " f"]]
    """Frames in which hands acted on each object; objects without any are absent."""
    new_objects: Mapping[int, Float32[np.ndarray, "n 3"]] = field(default_factory=dict)
    """Points of the state before the clip that the clip shows to be an object, by its new id."""
    held: Mapping[int, int] = field(default_factory=dict)
    """Object that each hand holds in the last frame, by the hand's index in the action."""
    notes: tuple[str, ...] = ()
    """New objects, and what could not be decided, in words for reports."""


@no_type_check
@dataclass(frozen=True, kw_only=True, repr=False)
class GroundTruth(Shown):
    """Ground truth of one clip; None where it is unknown."""

    frames: UInt8[np.ndarray, "f h w 3"]
    """Recorded or ray-cast video of the action."""
    depth_m: Float32[np.ndarray, "f h w"] | None = None
    """Depth along the camera's z axis in meters; infinite where a ray hits nothing."""
    object_ids: Int32[np.ndarray, "f h w"] | None = None
    """Object instance of each pixel: 0 background, negative hands and arms, else the state's."""
    motions: Mapping[int, Float[np.ndarray, "f 4 4"]] | None = None
    """Rigid motion in the world of each object that moves, relative to its pose in frame 0."""
    target_id: int | None = None
    """Object that the hands act on."""

    def __post_init__(self) -> None:
        """Check that the frames are a video and that everything else fits them."""
        check_video("The ground truth", self.frames)
        shape = self.frames.shape[:3]
        for name, dtype in (("depth_m", np.float32), ("object_ids", np.int32)):
            value = getattr(self, name)
            if value is not None and (value.shape != shape or value.dtype != dtype):
                raise InputError(
                    f"Ground truth {name} is {value.dtype} {value.shape}: it must be "
                    f"{np.dtype(dtype)} {shape}, one value per pixel of the frames."
                )
        if self.depth_m is not None and not (self.depth_m > 0).all():
            raise InputError(
                "Ground truth depth_m has values that are not positive: depth is in meters along "
                "the camera's z axis, and infinite where it is unknown."
            )
        for number, motion in (self.motions or {}).items():
            if np.shape(motion) != (shape[0], 4, 4) or not is_rigid(np.asarray(motion)).all():
                raise InputError(
                    f"The ground-truth motion of object {number} has shape {np.shape(motion)}: "
                    f"it must be one finite rigid transform per frame, ({shape[0]}, 4, 4)."
                )
