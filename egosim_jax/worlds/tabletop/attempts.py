"""Clips in which a hand may fail and the head turns, executed by the true world.

In a script every hand that closes holds a body, and the head only sways. A model that was trained
on scripts alone lets a body follow any hand, and has never seen what is next to the table.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from egosim_jax.geometry import rotation_z
from egosim_jax.types import Action, Cameras, Kind, VideoSpec
from egosim_jax.worlds.tabletop import Script, make_scripts, make_sequence
from egosim_jax.worlds.tabletop.clips import TabletopClip
from egosim_jax.worlds.tabletop.hand_motion import smooth
from egosim_jax.worlds.tabletop.policies import POLICIES
from egosim_jax.worlds.tabletop.world import World

TURN_DEGREES = (15.0, 50.0)
"""Minimum and maximum angle by which the head turns, to either side."""
LOOKING = "The wearer looks around."
"""Prompt of clips in which the head turns."""
TRIES = 20
"""Actions of a scene of which the first one that carries a body is tried."""


def make_attempts(
    seed: int,
    *,
    spec: VideoSpec,
    clips: int = 1,
    kind: Kind = "human",
    black_cloths: int | None = None,
) -> Iterator[TabletopClip]:
    """Yield the clips of a scene: a policy tries to carry a body, then the head turns.

    The policy is any of `POLICIES`, and what its hand does not hold stays. In the clips after it
    the head turns away and back in turns, without hands. A scene in which no body can be carried
    has the clips of `make_sequence`.
    """
    world = {"spec": spec, "kind": kind, "black_cloths": black_cloths}
    script = _carrying(seed, **world)
    if script is None:
        yield from make_sequence(seed, clips=clips, **world)
        return
    rng = np.random.default_rng([seed, 0 if kind == "human" else 1, 4])
    joints = POLICIES[int(rng.integers(len(POLICIES)))].plan(script, rng)
    angle = float(np.radians(rng.choice([-1, 1]) * rng.uniform(*TURN_DEGREES)))
    cameras, prompt, true = script.cameras, script.caption, World(scene=script.scene, seed=seed)
    view = replace(cameras, world_from_camera=cameras.world_from_camera[-1:])
    for number in range(clips):
        if number:
            first, last = (0.0, angle) if number % 2 else (angle, 0.0)
            cameras, prompt = turn(view, first, last, spec.frames), LOOKING
            joints = np.full_like(joints, np.nan)
        action = Action(cameras=cameras, joints_m=joints, kind=kind, prompt=prompt)
        clip, true = true.execute(action)
        yield clip


def turn(cameras: Cameras, first: float, last: float, frames: int) -> Cameras:
    """Return the first camera, turned about the vertical from one angle to another, in radians."""
    start = cameras.world_from_camera[0]
    poses = np.repeat(start[None], frames, axis=0)
    for pose, share in zip(poses, np.linspace(0, 1, frames), strict=True):
        angle = first + smooth(float(share)) * (last - first)
        pose[:3, :3] = rotation_z(angle) @ start[:3, :3]
    return replace(cameras, world_from_camera=poses)


def _carrying(seed: int, *, spec: VideoSpec, kind: Kind, black_cloths: int | None) -> Script | None:
    """Return the first script of a scene that carries a body; None if there is none."""
    for number in range(TRIES):
        scripts = make_scripts(seed, spec=spec, kind=kind, black_cloths=black_cloths, action=number)
        script = next(scripts)
        if script.intent.verb == "carry":
            return script
    return None
