"""Sequences of the tabletop world: a seed gives scripted clips in one scene.

The first frame of each clip is the last frame of the clip before.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from egosim_jax.geometry import look_at
from egosim_jax.simulation.episode import Episode
from egosim_jax.types import Action, Cameras, Kind, SceneState, VideoSpec, seen_hands
from egosim_jax.worlds.tabletop import hand_motion
from egosim_jax.worlds.tabletop.clips import (
    TabletopClip,
    first_view,
    provenance,
    render_clip,
)
from egosim_jax.worlds.tabletop.hand_motion import Hand, Intent, Moment
from egosim_jax.worlds.tabletop.raycast import Frame
from egosim_jax.worlds.tabletop.scene import Scene, sample_scene, with_cloths

FIELD_OF_VIEW = 60.0
"""Horizontal field of view in degrees."""


@dataclass(frozen=True, kw_only=True)
class Script:
    """One scripted clip, not rendered."""

    intent: Intent
    """Action of the clip and its target."""
    moments: list[Moment]
    """Scene and hands at every frame."""
    cameras: Cameras
    """Camera of every frame."""
    kind: Kind
    """Human hands or a robot gripper."""
    caption: str
    """Prompt that describes the action."""

    @property
    def scene(self) -> Scene:
        """Scene before the clip."""
        return self.moments[0].scene

    @property
    def joints_m(self) -> Float[np.ndarray, "f n j 3"]:
        """World positions of the joints of all hands in meters."""
        return np.array(
            [
                [hand.grip.pose(self.kind, hand.side)[0] for hand in moment.hands]
                for moment in self.moments
            ]
        )

    @property
    def action(self) -> Action:
        """Cameras, joints and prompt, for `World.execute`."""
        return Action(
            cameras=self.cameras, joints_m=self.joints_m, kind=self.kind, prompt=self.caption
        )


def make_sequence(
    seed: int,
    *,
    spec: VideoSpec,
    clips: int = 1,
    kind: Kind = "human",
    bare: bool = False,
    black_cloths: int = 0,
    fixed_camera: bool = False,
    variant: int = 0,
) -> Iterator[TabletopClip]:
    """Yield the clips of a seed, each `spec.frames` long; a robot has one gripper.

    Equal seeds give equal clips at equal sizes, and the same events at any size.

    - `bare` renders the background: the same clips without hands and manipulated body.
    - `black_cloths` is the maximum number of cloths on the table; they change nothing else.
    - A `fixed_camera` keeps its pose of the first frame.
    - Each `variant` has other events in the same scene, under the same cameras.
    """
    scripts = make_scripts(
        seed,
        spec=spec,
        clips=clips,
        kind=kind,
        black_cloths=black_cloths,
        fixed_camera=fixed_camera,
        variant=variant,
    )
    for number, script in enumerate(scripts):
        yield render_clip(
            [moment.scene for moment in script.moments],
            [[hand_motion.hand_parts(hand, kind) for hand in m.hands] for m in script.moments],
            script.cameras,
            sides=tuple(hand.side for hand in script.moments[0].hands),
            kind=kind,
            seed=seed,
            number=number,
            verb=script.intent.verb,
            target=script.intent.name,
            caption=script.caption,
            bare=bare,
        )


def make_scripts(
    seed: int,
    *,
    spec: VideoSpec,
    clips: int = 1,
    kind: Kind = "human",
    black_cloths: int = 0,
    fixed_camera: bool = False,
    variant: int = 0,
) -> Iterator[Script]:
    """Yield the scripts of the clips that `make_sequence` renders."""
    rng, scene, eye, sway = _begin(seed, kind, black_cloths)
    if variant:  # a separate generator: the scene and the cameras stay the same
        rng = np.random.default_rng([seed, 0 if kind == "human" else 1, 2, variant])
    hands: tuple[Hand, ...] = ()
    for number in range(clips):
        intent = hand_motion.choose(scene, rng, hand=hands[0] if hands else None)
        if not hands:
            hands = (hand_motion.start_hand(scene, intent, kind, rng),)
            if kind == "human" and rng.random() < 0.35:
                hands = (*hands, hand_motion.waiting_hand(hands[0].side, rng))
        moments = hand_motion.act(scene, hands, intent, kind, frames=spec.frames)
        times = number + np.linspace(0, 1, spec.frames)
        cameras = _cameras(0 * times if fixed_camera else times, eye, sway, spec)
        who = f"The {hands[0].side} hand" if kind == "human" else "The gripper"
        yield Script(
            intent=intent,
            moments=moments,
            cameras=cameras,
            kind=kind,
            caption=f"{who} {intent.caption}",
        )
        scene, hands = moments[-1].scene, moments[-1].hands


def episode_of_sequence(
    seed: int, *, spec: VideoSpec, clips: int = 1, kind: Kind = "human"
) -> Episode:
    """Return the episode of a sequence without ground truth, which is slow to render.

    `clips.to_episode` returns it with ground truth.
    """
    scripts = list(make_scripts(seed, spec=spec, clips=clips, kind=kind))
    first, state = first_view(scripts[0].scene, scripts[0].cameras)
    return Episode(
        state=replace(state, provenance=provenance(seed)),
        actions=tuple(
            Action(
                cameras=script.cameras,
                joints_m=seen_hands(script.cameras, script.joints_m),
                kind=kind,
                prompt=script.caption,
            )
            for script in scripts
        ),
        fps=spec.fps,
        first_frame=first.colors,
    )


def start_of_sequence(
    seed: int, *, spec: VideoSpec, kind: Kind = "human"
) -> tuple[Scene, Cameras, Frame, SceneState]:
    """Return the scene, camera, frame without hands and state at the start of a sequence."""
    _, scene, eye, sway = _begin(seed, kind, black_cloths=0)
    cameras = _cameras(np.zeros(1), eye, sway, spec)
    first, state = first_view(scene, cameras)
    return scene, cameras, first, replace(state, provenance=provenance(seed))


def _begin(
    seed: int, kind: Kind, black_cloths: int
) -> tuple[np.random.Generator, Scene, np.ndarray, tuple[Any, Any]]:
    """Return the random generator, scene, eye position and head sway of a seed."""
    stream = 0 if kind == "human" else 1
    rng = np.random.default_rng([seed, stream])
    scene = sample_scene(rng)
    # Cloths have their own generator, so that they change no other random number.
    scene = with_cloths(scene, np.random.default_rng([seed, stream, 1]), black_cloths)
    sway = rng.uniform(0, 2 * np.pi, 6), rng.uniform(0.6, 1.4, 6)
    eye = np.array([0.0, -0.10, 0.46]) + rng.normal(0, [0.025, 0.015, 0.02])
    return rng, scene, eye, sway


def _cameras(times: np.ndarray, eye: np.ndarray, sway: tuple[Any, Any], spec: VideoSpec) -> Cameras:
    """Return the cameras of a head that sways while it looks at the middle of the table."""
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
