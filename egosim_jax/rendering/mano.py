"""MANO hands (Romero et al. 2017) from the user's own model file, which we may not ship.

With shape b, rotations R_0 ... R_15 of the wrist and 15 joints given as axis times angle, and the
model's arrays, the vertices are

    s = v_template + shapedirs b            joints j = J_regressor s
    p = s + posedirs (R_1 - I, ..., R_15 - I)
    v = sum over joints k of weights_k (G_k (p - j_k) + g_k) + translation

where G_k, g_k chain the rotations from the wrist to joint k: G_k = G_parent R_k and g_k = G_parent
(j_k - j_parent) + g_parent, with g_0 = j_0.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int

from egosim_jax.io.bounded import quote_path
from egosim_jax.io.untrusted.npz import read_arrays
from egosim_jax.io.untrusted.pickled_arrays import read_model
from egosim_jax.rendering.mesh import HAND_COLORS, MovingMesh, Side, join_meshes
from egosim_jax.types import InputError

JOINTS, BETAS = 16, 10
"""Number of joints, including the wrist, and number of shape coefficients."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Mano:
    """Hand model of one side."""

    v_template: Float[np.ndarray, "v 3"]
    """Vertices of the mean shape in meters."""
    shapedirs: Float[np.ndarray, "v 3 10"]
    """Displacement of the vertices for each shape coefficient."""
    posedirs: Float[np.ndarray, "v 3 135"]
    """Displacement of the vertices for each entry of the joints' rotations."""
    j_regressor: Float[np.ndarray, "16 v"]
    """Weights of the vertices in each joint's position."""
    weights: Float[np.ndarray, "v 16"]
    """Share of each joint in the motion of each vertex."""
    parents: tuple[int, ...]
    """Parent of each joint after the wrist, which is joint 0."""
    triangles: Int[np.ndarray, "t 3"]
    """Vertex indices of each triangle."""
    hands_mean: Float[np.ndarray, " 45"]
    """Mean pose; some datasets give poses relative to it."""

    def __post_init__(self) -> None:
        """Check shapes, parents, triangles, and that all values are finite."""
        count = len(self.v_template)
        shapes = {
            "v_template": (count, 3), "shapedirs": (count, 3, BETAS),
            "posedirs": (count, 3, 9 * (JOINTS - 1)), "j_regressor": (JOINTS, count),
            "weights": (count, JOINTS), "hands_mean": (3 * (JOINTS - 1),),
        }  # fmt: skip
        for name, shape in shapes.items():
            value = getattr(self, name)
            if np.shape(value) != shape or not np.isfinite(value).all():
                raise InputError(
                    f"{name} of the hand model has shape {np.shape(value)}: it must be finite and "
                    f"{shape} for {count} vertices, as in MANO. (--mano-right, --mano-left)"
                )
        if len(self.parents) != JOINTS - 1 or any(
            not 0 <= parent <= number for number, parent in enumerate(self.parents)
        ):
            raise InputError(
                f"The joints of the hand model have the parents {self.parents}: each must come "
                "after its parent. (--mano-right, --mano-left)"
            )
        if not 0 <= self.triangles.min() <= self.triangles.max() < count:
            raise InputError(
                f"Triangles of the hand model use vertices up to {self.triangles.max()}: there "
                f"are {count}. (--mano-right, --mano-left)"
            )


@no_type_check
@dataclass(frozen=True, kw_only=True)
class ManoPoses:
    """Poses of n hands along a clip, in the world."""

    global_orient: Float[np.ndarray, "f n 3"]
    """Rotation of the wrist, axis times angle in radians; NaN where a hand is missing."""
    hand_pose: Float[np.ndarray, "f n 45"]
    """Rotations of the joints, axis times angle in radians."""
    translation_m: Float[np.ndarray, "f n 3"]
    """Translation of the vertices in meters."""
    betas: Float[np.ndarray, "n 10"]
    """Shape coefficients of each hand."""

    def __post_init__(self) -> None:
        """Check shapes, and that each hand of a frame is complete or missing."""
        frames, hands = (
            np.shape(self.global_orient)[:2] if np.ndim(self.global_orient) == 3 else (0, 0)
        )
        shapes = {
            "global_orient": (frames, hands, 3), "hand_pose": (frames, hands, 45),
            "translation_m": (frames, hands, 3), "betas": (hands, BETAS),
        }  # fmt: skip
        for name, shape in shapes.items():
            if np.shape(getattr(self, name)) != shape or 0 in shape:
                raise InputError(
                    f"{name} of the hands has shape {np.shape(getattr(self, name))}: it must be "
                    f"{shape} for {frames} frames of {hands} hands. (--mano-poses)"
                )
        rows = [self.global_orient, self.hand_pose, self.translation_m]
        finite = np.isfinite(np.concatenate(rows, axis=-1))
        broken = ~finite.all(axis=-1) & finite.any(axis=-1)
        if broken.any() or not np.isfinite(self.betas).all():
            frame, hand = np.argwhere(broken)[0].tolist() if broken.any() else (0, 0)
            raise InputError(
                f"Hand {hand} of frame {frame} is only partly finite: give all parameters of a "
                "hand, or NaN for all where it is missing. (--mano-poses)"
            )

    @property
    def given(self) -> np.ndarray:
        """Hands that are given, `f n`."""
        return np.asarray(np.isfinite(self.global_orient).all(axis=-1))


def read_mano(path: Path) -> Mano:
    """Read MANO_RIGHT.pkl or MANO_LEFT.pkl. Raises `InputError` for any other file."""
    arrays = read_model(path)
    names = (
        "v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f",
        "hands_mean",
    )  # fmt: skip
    if missing := [name for name in names if name not in arrays]:
        raise InputError(
            f"{quote_path(path)} has no {', '.join(missing)}: it is not a MANO hand model. Give "
            "MANO_RIGHT.pkl or MANO_LEFT.pkl from mano.is.tue.mpg.de. (--mano-right, --mano-left)"
        )
    table, triangles = arrays["kintree_table"], arrays["f"]
    if table.shape != (2, JOINTS) or triangles.ndim != 2 or triangles.shape[1] != 3:
        raise InputError(
            f"{quote_path(path)} has joints {table.shape} and triangles {triangles.shape}: they "
            f"must be (2, {JOINTS}) and (t, 3). (--mano-right, --mano-left)"
        )
    return Mano(
        **{name: arrays[name].astype(float) for name in names[:3]},
        j_regressor=arrays["J_regressor"].astype(float),
        weights=arrays["weights"].astype(float),
        parents=tuple(int(parent) for parent in table[0, 1:]),
        triangles=triangles.astype(np.int64),
        hands_mean=arrays["hands_mean"].astype(float),
    )


def read_poses(path: Path) -> ManoPoses:
    """Read the poses of hands from an npz with the fields of `ManoPoses`."""
    names = ("global_orient", "hand_pose", "translation_m", "betas")
    arrays = read_arrays(path, {}, others=names, packed=True)
    return ManoPoses(**{name: arrays[name].astype(float) for name in names})


def mano_hands(
    right: Mano, poses: ManoPoses, *, left: Mano | None = None, add_mean: bool = False
) -> MovingMesh:
    """Return the meshes of a left and a right hand, in this order, in the colors of their sides.

    Without a model of the left hand, its poses are read as right-hand poses, as HaMeR estimates
    them: the right hand is posed, mirrored in x, then translated. So the global orientation is in
    mirrored world axes. If HaMeR's is G and R rotates its camera to the world, it is (M R M) G
    with M = diag(-1, 1, 1). `add_mean` is for poses relative to the mean pose.
    Raises `InputError` for another number of hands.
    """
    if poses.global_orient.shape[1] != 2:
        raise InputError(
            f"The poses have {poses.global_orient.shape[1]} hands: there must be 2, left before "
            "right; a missing hand has NaN. (--mano-poses)"
        )
    sides: tuple[Side, Side] = ("left", "right")
    models = (left or right, right)
    meshes = []
    for number, (side, model) in enumerate(zip(sides, models, strict=True)):
        mirrored = side == "left" and left is None
        meshes.append(
            MovingMesh(
                vertices_m=_pose(model, poses, number, add_mean, mirrored),
                triangles=model.triangles[:, ::-1] if mirrored else model.triangles,
                colors=np.tile(HAND_COLORS[side], (len(model.v_template), 1)),
            )
        )
    return join_meshes(meshes)


def _pose(
    model: Mano, poses: ManoPoses, hand: int, add_mean: bool, mirrored: bool
) -> Float[np.ndarray, "f v 3"]:
    """Return the vertices of one hand, NaN where it is missing."""
    present = poses.given[:, hand]
    vertices = np.full((len(present), *model.v_template.shape), np.nan)
    if present.any():
        pose = poses.hand_pose[present, hand] + (model.hands_mean if add_mean else 0.0)
        turns = np.concatenate([poses.global_orient[present, hand], pose], axis=-1)
        posed = skin(model, poses.betas[hand], turns.reshape(-1, JOINTS, 3))
        posed = posed * [-1, 1, 1] if mirrored else posed
        vertices[present] = posed + poses.translation_m[present, hand, None]
    return vertices


def skin(
    model: Mano, betas: Float[np.ndarray, " 10"], turns: Float[np.ndarray, "f 16 3"]
) -> Float[np.ndarray, "f v 3"]:
    """Return the vertices for a shape and the rotations of the joints, axis times angle."""
    from scipy.spatial.transform import Rotation

    shaped = model.v_template + model.shapedirs @ betas
    joints = model.j_regressor @ shaped
    rotations = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix()
    rotations = rotations.reshape(*turns.shape, 3)
    bend = (rotations[:, 1:] - np.eye(3)).reshape(len(turns), -1)
    posed = shaped + np.einsum("vcp,fp->fvc", model.posedirs, bend)
    chained = [rotations[:, 0]]
    places = [np.broadcast_to(joints[0], (len(turns), 3))]
    for number, parent in enumerate(model.parents, start=1):
        step = joints[number] - joints[parent]
        places.append(np.einsum("fcd,d->fc", chained[parent], step) + places[parent])
        chained.append(chained[parent] @ rotations[:, number])
    vertices = np.zeros_like(posed)
    for number in range(JOINTS):
        moved = (posed - joints[number]) @ chained[number].swapaxes(-1, -2)
        vertices += model.weights[:, number, None] * (moved + places[number][:, None])
    return vertices
