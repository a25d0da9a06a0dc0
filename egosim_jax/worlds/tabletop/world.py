"""True tabletop world: executes any action, exactly and without randomness.

    world = World(scene=make_scene(objects=[...]))
    clip, world = world.execute(action)  # clip: frames, depth, ids, poses; world: after the action

A world is a value: executing an action returns a new one, and the same action in the same world
gives the same clip. `docs/world.md` describes the physics of `contact.py` and `support.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import no_type_check

import numpy as np
from jaxtyping import Float

from egosim_jax.rendering.mesh import Side
from egosim_jax.types import JOINTS, Action, Cameras, InputError, Kind, SceneState
from egosim_jax.worlds.tabletop.clips import Arm, TabletopClip, first_view, provenance, render_clip
from egosim_jax.worlds.tabletop.contact import Contact, Grasp, advance, start
from egosim_jax.worlds.tabletop.hands import arm_of, side_of
from egosim_jax.worlds.tabletop.raycast import Frame
from egosim_jax.worlds.tabletop.scene import Scene

EXECUTED = "execute"
"""Verb of clips of executed actions."""
MOVED_M = 1e-4
"""Motion below which a body counts as unmoved, in meters or radians."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class World:
    """True tabletop world at one moment: the scene and the grasps."""

    scene: Scene
    """All bodies and their poses."""
    grasps: tuple[Grasp, ...] = ()
    """Bodies in hands."""
    seed: int = 0
    """Seed in the names of clips; arbitrary for a scene of your own."""
    number: int = 0
    """Number of actions executed so far."""

    def move(
        self, action: Action, *, joints_m: Float[np.ndarray, "f n j 3"] | None = None
    ) -> tuple[list[Scene], World]:
        """Return the scene at every frame, not rendered, and the world after the action.

        A hand keeps the body that it holds if it starts near where it ended; otherwise the body
        falls. A hand is missing where its joints are NaN. `joints_m` replaces the joints of the
        action; an action refuses hands out of view, `joints_m` does not. Raises `InputError` if
        the shape of `joints_m` does not match the cameras and the kind of hands.
        """
        joints = np.asarray(action.joints_m if joints_m is None else joints_m, float)
        frames, number = len(action.cameras.world_from_camera), JOINTS[action.kind]
        if joints.ndim != 4 or (len(joints), *joints.shape[2:]) != (frames, number, 3):
            raise InputError(
                f"joints_m is {joints.shape}: {action.kind} hands of a path of {frames} cameras "
                f"must be ({frames}, hands, {number}, 3). Give as many frames as cameras."
            )
        contact = start(Contact(scene=self.scene, grasps=self.grasps), joints[0], action.kind)
        scenes = [contact.scene]
        for before, after in pairwise(joints):
            contact = advance(contact, before, after, action.kind)
            scenes.append(contact.scene)
        after = replace(self, scene=contact.scene, grasps=contact.grasps, number=self.number + 1)
        return scenes, after

    def execute(
        self, action: Action, *, joints_m: Float[np.ndarray, "f n j 3"] | None = None
    ) -> tuple[TabletopClip, World]:
        """Return the clip of an action with its ground truth, and the world after the action.

        `joints_m` is as in `move`. Raises `InputError` if a camera is inside an object.
        """
        scenes, after = self.move(action, joints_m=joints_m)
        joints = action.joints_m if joints_m is None else joints_m
        clip = render_clip(
            scenes,
            arms_of(joints, action.kind),
            action.cameras,
            sides=sides_of(joints, action.kind),
            kind=action.kind,
            seed=self.seed,
            number=self.number,
            verb=EXECUTED,
            target=_most_moved(scenes),
            caption=action.prompt,
        )
        return clip, after

    def observe(self, cameras: Cameras) -> tuple[Frame, SceneState]:
        """Return the first camera's frame without hands, and the state of its visible points."""
        first, state = first_view(self.scene, cameras)
        return first, replace(state, step=self.number, provenance=provenance(self.seed))


def arms_of(joints_m: Float[np.ndarray, "f n j 3"], kind: Kind) -> list[list[Arm | None]]:
    """Return joints and meshes of every hand in every frame; None where a hand is missing."""
    sides = sides_of(joints_m, kind)
    return [
        [
            (joints, arm_of(joints, kind, side)) if np.isfinite(joints).all() else None
            for joints, side in zip(frame, sides, strict=True)
        ]
        for frame in joints_m
    ]


def sides_of(joints_m: Float[np.ndarray, "f n j 3"], kind: Kind) -> tuple[Side, ...]:
    """Return the side of each hand in its first frame; a gripper at x < 0 is a left one."""
    sides: list[Side] = []
    for path in np.moveaxis(joints_m, 1, 0):
        seen = path[np.isfinite(path).all(axis=(1, 2))]
        if len(seen) and kind == "human":
            sides.append(side_of(seen[0]))
        else:
            sides.append("left" if len(seen) and seen[0][0, 0] < 0 else "right")
    return tuple(sides)


def _most_moved(scenes: list[Scene]) -> str:
    """Return the name of the body that moved most; empty if no body moved."""
    amounts = {}
    for body in scenes[0].bodies:
        path = np.stack([scene.first_part_pose(body.name) for scene in scenes])
        amounts[body.name] = float(np.abs(path - path[0]).max())
    name = max(amounts, key=lambda name: amounts[name])
    return name if amounts[name] > MOVED_M else ""
