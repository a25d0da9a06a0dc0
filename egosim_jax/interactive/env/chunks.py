"""Chunks: the action rows of one clip, and the metadata of its result.

A chunk has a row for each frame but the first, which repeats the last row of the previous chunk. A
model generates a fixed number of frames, so a shorter chunk is padded with its last row.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any, cast, no_type_check

import numpy as np
from jaxtyping import Bool, Float

from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.interactive.env.batching import announced
from egosim_jax.io.bounded import quote
from egosim_jax.simulation.actions import check_action
from egosim_jax.simulation.rig import MountedCamera
from egosim_jax.simulation.simulator import Phase, Simulator, Step
from egosim_jax.simulation.start import Start
from egosim_jax.simulation.streams import Latency
from egosim_jax.state import snapshot
from egosim_jax.types import Action, Cameras, InputError, SceneState, VideoSpec, View

OBSERVATIONS = ("frames", "depth", "keypoints", "state")
OF_CAMERA = ("frames", "depth")
"""Observations of a further camera, after its name and a dot."""
STATE_FIELDS = ("points_m", "colors", "object_ids")
"""Arrays of the observation `state`."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Chunk:
    """Action of one clip, with its rows."""

    action: Action
    """Cameras, joints and prompt."""
    rows: Float[np.ndarray, "f d"]
    """Row of each frame; the first is the last row of the previous chunk."""
    padded: int
    """Number of frames at the end that hold the last row."""
    hidden: Bool[np.ndarray, " n"]
    """Mask of the hands that never come near the view and are missing from the action."""

    def info(self, spec: ActionSpec) -> dict[str, Any]:
        """Return the number of padded frames and the hidden hands."""
        hidden = [side for side, lost in zip(spec.sides, self.hidden, strict=True) if lost]
        return {"padded_frames": self.padded, "hidden_hands": hidden}


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Seconds of each phase of a step; all timings compare equal, so equal steps stay equal."""

    render_s: float = field(compare=False)
    """Prediction of the motion, and rendering along the camera path."""
    generate_s: float = field(compare=False)
    """Generation of the clip, including the wait for its batch."""
    update_s: float = field(compare=False)
    """Perception of the clip and its fusion into the state."""
    first_frame_s: float = field(compare=False)
    """From the action to the first decoded frames."""
    last_frame_s: float = field(compare=False)
    """From the action to the last decoded frames."""


def observation_names(cameras: Iterable[MountedCamera]) -> tuple[str, ...]:
    """Return the names of all observations."""
    return OBSERVATIONS + tuple(f"{c.name}.{name}" for c in cameras for name in OF_CAMERA)


def check_observe(observe: Iterable[Any], cameras: Iterable[MountedCamera]) -> None:
    """Raise `InputError` at the first name that is no observation."""
    names = observation_names(cameras)
    if unknown := [name for name in observe if name not in names]:
        raise InputError(
            f"There is no observation {quote(unknown[0])}: choose from {', '.join(names)}."
        )


def observed(cameras: Iterable[MountedCamera], observe: Iterable[str]) -> tuple[MountedCamera, ...]:
    """Return the cameras that an observation names."""
    names = {name.partition(".")[0] for name in observe if "." in name}
    return tuple(camera for camera in cameras if camera.name in names)


def make_chunk(
    spec: ActionSpec,
    rows: object,
    *,
    start: Start,
    video: VideoSpec,
    prompt: str | None = None,
) -> Chunk:
    """Return the chunk of 1 to `video.frames` - 1 rows after a start; it hides hands out of view.

    Environments and sessions both accept actions by this function. Raises `InputError` for invalid
    rows, and for cameras that the state does not allow.
    """
    given = spec.check(rows, max_rows=video.frames - 1)
    padded = video.frames - 1 - len(given)
    before = spec.rest if start.row is None else start.row
    path = np.concatenate([before[None], given, np.repeat(given[-1:], padded, axis=0)])
    action, hidden = spec.to_action(path, camera=start.camera, prompt=prompt or start.prompt)
    check_action(action, state=start.state, fps=video.fps, continued=True, any_hand=True)
    return Chunk(action=action, rows=path, padded=padded, hidden=hidden)


def last_camera(action: Action) -> Cameras:
    """Return the camera of an action's last frame."""
    return replace(action.cameras, world_from_camera=action.cameras.world_from_camera[-1:])


def straight_path(
    before: Float[np.ndarray, " d"], target: Float[np.ndarray, " d"], frames: int
) -> Float[np.ndarray, "k d"]:
    """Return the rows of a straight path to a target over a full chunk."""
    shares = np.linspace(0, 1, frames)[1:, None]
    return before + shares * (target - before)


def timed_step(
    simulator: Simulator,
    state: SceneState,
    action: Action,
    *,
    seed: int,
    first_frame: np.ndarray | None,
) -> tuple[Step, Timing]:
    """Run one step of a simulator, and time its phases.

    Updates of the state by chunk count as generation.
    """
    seconds: dict[Phase, float] = defaultdict(float)

    def run(name: Phase, make: Callable[[], Any]) -> Any:
        then = time.monotonic()
        result = make()
        seconds[name] += time.monotonic() - then
        return result

    with announced(simulator.generator):  # before rendering, so that a batch waits for this clip
        step = simulator.step(state, action, seed=seed, first_frame=first_frame, run=run)
    render_s, latency = seconds["predict"] + seconds["render"], cast(Latency, step.latency)
    return step, Timing(
        render_s=render_s,
        generate_s=seconds["generate"] - render_s,
        update_s=seconds["perceive"] + seconds["fuse"],
        first_frame_s=latency.first_frame_s,
        last_frame_s=latency.last_frame_s,
    )


def state_info(state: SceneState) -> dict[str, Any]:
    """Return the hash of a state, and the name and pose of each object, by id."""
    return {
        "state_sha256": snapshot.fingerprint(state),
        "objects": dict(state.names),
        "object_poses": object_poses(state),
    }


def object_poses(state: SceneState) -> dict[int, Float[np.ndarray, "4 4"]]:
    """Return the pose of each object in the world, by id.

    The translation is the center of the object's points. The rotation is relative to the state in
    which the object was first observed.
    """
    poses = {}
    for number in np.unique(state.object_ids[state.object_ids > 0]).tolist():
        pose = np.array(state.world_from_object.get(number, np.eye(4)), float)
        pose[:3, 3] = state.points_m[state.object_ids == number].mean(axis=0, dtype=float)
        poses[number] = pose
    return poses


def view_of(simulator: Simulator, state: SceneState, cameras: Cameras) -> View:
    """Return the view of a state along a camera path, as the simulator renders it."""
    return simulator.renderer.render(state, cameras, point_px=simulator.point_px)
