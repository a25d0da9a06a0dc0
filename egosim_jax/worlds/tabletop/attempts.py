"""Clips in which a hand may fail and the head turns, executed by the true world.

In a script every closing hand holds a body, and the head only sways. A model trained only on
scripts lets a body follow any hand, and has never seen the room next to the table.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from egosim_jax.geometry import rotation_z
from egosim_jax.types import Action, Cameras, Kind, VideoSpec
from egosim_jax.worlds.tabletop.clips import TabletopClip
from egosim_jax.worlds.tabletop.hand_motion import smooth
from egosim_jax.worlds.tabletop.policies import POLICIES
from egosim_jax.worlds.tabletop.sequence import Script, make_scripts, make_sequence
from egosim_jax.worlds.tabletop.world import World

TURN_DEGREES = (15.0, 50.0)
"""Minimum and maximum angle of a head turn, to either side."""
LOOK_AROUND_PROMPT = "The wearer looks around."
"""Prompt of the clips in which the head turns."""
MAX_TRIES = 20
"""Maximum number of variants of a scene that are searched for one that carries a body."""


def make_attempts(
    seed: int,
    *,
    spec: VideoSpec,
    clips: int = 1,
    kind: Kind = "human",
    black_cloths: int = 0,
) -> Iterator[TabletopClip]:
    """Yield the clips of a scene: a policy tries to carry a body, then the head turns.

    The policy is drawn from `POLICIES`. In the later clips the head alternately turns away and
    back, without hands. If no variant of the scene carries a body, the clips are the scripted ones
    of `make_sequence`.
    """
    settings = {"spec": spec, "kind": kind, "black_cloths": black_cloths}
    script = _carrying(seed, **settings)
    if script is None:
        yield from make_sequence(seed, clips=clips, **settings)
        return
    rng = np.random.default_rng([seed, 0 if kind == "human" else 1, 4])
    joints = POLICIES[int(rng.integers(len(POLICIES)))].plan(script, rng)
    angle = float(np.radians(rng.choice([-1, 1]) * rng.uniform(*TURN_DEGREES)))
    cameras, prompt = script.cameras, script.caption
    true_world = World(scene=script.scene, seed=seed)
    view = replace(cameras, world_from_camera=cameras.world_from_camera[-1:])
    for number in range(clips):
        if number:
            first, last = (0.0, angle) if number % 2 else (angle, 0.0)
            cameras, prompt = turn_camera(view, first, last, spec.frames), LOOK_AROUND_PROMPT
            joints = np.full_like(joints, np.nan)
        action = Action(cameras=cameras, joints_m=joints, kind=kind, prompt=prompt)
        clip, true_world = true_world.execute(action)
        yield clip


def turn_camera(cameras: Cameras, first: float, last: float, frames: int) -> Cameras:
    """Turn the first camera about the vertical from one angle to another, in radians."""
    start = cameras.world_from_camera[0]
    poses = np.repeat(start[None], frames, axis=0)
    for pose, share in zip(poses, np.linspace(0, 1, frames), strict=True):
        angle = first + smooth(float(share)) * (last - first)
        pose[:3, :3] = rotation_z(angle) @ start[:3, :3]
    return replace(cameras, world_from_camera=poses)


def _carrying(seed: int, *, spec: VideoSpec, kind: Kind, black_cloths: int) -> Script | None:
    """Return the first variant of a scene's script that carries a body, or None."""
    scripts = (
        next(make_scripts(seed, spec=spec, kind=kind, black_cloths=black_cloths, variant=variant))
        for variant in range(MAX_TRIES)
    )
    return next((script for script in scripts if script.intent.verb == "carry"), None)
