"""Clips in which the wearer does nothing in particular, executed by the true world.

The hands rest, are absent, or wander as under an untrained policy, under any prompt. In a
script a hand always reaches for a body. A model trained only on scripts lets a resting hand melt.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from egosim_jax.types import Action, Kind, VideoSpec
from egosim_jax.worlds.tabletop.clips import TabletopClip
from egosim_jax.worlds.tabletop.sequence import make_scripts
from egosim_jax.worlds.tabletop.world import World

STILL_HEAD, ABSENT, WANDERING = 0.4, 0.25, 0.4
"""Probabilities of a head that is still, of absent hands, and of wandering ones."""
STEP_M = 0.006
"""Standard deviation of a wandering hand's change of speed along each axis, meters a frame."""
REACH_M = 0.08
"""Maximum distance of a wandering hand from its start along each axis, in meters."""
ABSENT_PROMPT = "The wearer rests."
RESTING_PROMPT = "The hand rests."
"""Prompts of absent and of resting hands; every second clip has the script's prompt instead."""


def make_idle(
    seed: int, *, spec: VideoSpec, clips: int = 1, kind: Kind = "human", black_cloths: int = 0
) -> Iterator[TabletopClip]:
    """Yield the clips of a scene whose hands rest, are absent or wander."""
    rng = np.random.default_rng([seed, 0 if kind == "human" else 1, 9])
    script = next(
        make_scripts(
            seed,
            spec=spec,
            kind=kind,
            black_cloths=black_cloths,
            fixed_camera=bool(rng.random() < STILL_HEAD),
        )
    )
    joints = np.repeat(script.action.joints_m[:1], spec.frames, axis=0)
    prompt, choice = RESTING_PROMPT, rng.random()
    wanders = ABSENT < choice < ABSENT + WANDERING
    if choice < ABSENT:
        joints, prompt = np.full_like(joints, np.nan), ABSENT_PROMPT
    world = World(scene=script.scene, seed=seed)
    for _ in range(clips):
        if wanders:
            joints = joints[-1:] + wander(spec.frames, rng)
        action = Action(
            cameras=script.cameras,
            joints_m=joints,
            kind=kind,
            prompt=script.caption if wanders or rng.random() < 0.5 else prompt,
        )
        clip, world = world.execute(action)
        yield clip


def wander(frames: int, rng: np.random.Generator) -> Float[np.ndarray, "f 1 1 3"]:
    """Return the offsets of a hand on a smooth random path from 0, in meters."""
    speed = np.cumsum(rng.normal(0, STEP_M, (frames, 3)), axis=0)
    path = np.cumsum(speed - speed[:1], axis=0) / np.sqrt(frames)
    path = REACH_M * np.tanh(path / REACH_M)
    path[:, 2] = np.maximum(path[:, 2], -0.02)  # a hand does not sink into the table
    return path[:, None, None, :]
