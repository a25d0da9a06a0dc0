"""Played episode: a session, the true world next to it, and all earlier moments.

The session (`interactive/server/session.py`) generates and records every clip. If the scene comes
from a seed, the true world executes the same actions.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import cast, no_type_check

import numpy as np
from jaxtyping import Float, UInt8

from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.interactive.env.backends import GeneratedWorld, is_of_seed
from egosim_jax.interactive.env.chunks import straight_path, view_of
from egosim_jax.interactive.env.parts import part_rows
from egosim_jax.interactive.play.moves import (
    Pose,
    drive,
    ready_pose,
    scene_from_state,
    suggest_goal,
)
from egosim_jax.interactive.server.parts import Parts
from egosim_jax.interactive.server.session import Result, Session
from egosim_jax.rendering.mesh import Side
from egosim_jax.simulation.actions import all_joints_of
from egosim_jax.simulation.changes import moved_objects
from egosim_jax.simulation.episode import Episode
from egosim_jax.simulation.start import Start, check_size
from egosim_jax.types import Action, Cameras, InputError, SceneState
from egosim_jax.worlds.tabletop import Scene, World, start_of_sequence
from egosim_jax.worlds.tabletop.clips import render_scenes
from egosim_jax.worlds.tabletop.world import arms_of

Frames = UInt8[np.ndarray, "f h w 3"]
Filmed = tuple[World, Frames]
"""True world after a clip, and the clip's ground truth."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Moment:
    """Point of an episode after one of its clips, from which play can continue."""

    start: Start
    """Scene, camera and hand from which the session continues."""
    caption: str
    """Description of the last clip."""
    frames: Frames
    """Last generated clip; the first moment has one frame."""
    camera: Cameras
    """Camera of the last frame."""
    action: Action | None = None
    """Action of the last clip; None at the first moment."""
    truth: Future[Filmed] | None = None
    """Ground truth of the clip, once rendered; None if the scene does not come from a seed."""


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Latencies of a clip, in seconds since its request."""

    first_s: float
    """Time until the first frames are shown."""
    last_s: float
    """Time until the last frames are shown."""
    total_s: float
    """Time until the state is updated."""


class PlayedEpisode:
    """Episode in progress; one thread at a time may change it."""

    def __init__(self, world: GeneratedWorld, folder: Path, start: Start, side: Side):
        """Begin an episode, recorded as a new session in the folder."""
        check_size(start, world.video)
        self.world = world
        self.side: Side = side
        self.scene = _true_scene(start, world)
        self.goal = None if self.scene is None else suggest_goal(self.scene, side)
        """Suggested object and place for a first clip."""
        name = f"play-{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(2)}"
        actions = ActionSpec(sides=(side,), camera=True)
        if self.scene is not None and self.goal is not None and start.row is None:
            row = ready_pose(self.scene, self.goal[0], side).row(side, np.zeros(6))
            start = replace(start, row=np.clip(row, *actions.bounds))
        self.session = Session.create(folder / name, world, actions, start)
        self._parts = Parts(most=1, idle_s=0.0)
        self._filming = ThreadPoolExecutor(1, thread_name_prefix="truth")
        first = self.session.result.frames
        truth: Future[Filmed] | None = None
        if self.scene is not None:
            truth = Future()
            truth.set_result((World(scene=self.scene, seed=start.seed), first))
        self.moments = [
            Moment(
                start=self.session.now,
                caption="The beginning",
                frames=first,
                camera=start.camera,
                truth=truth,
            )
        ]
        self.at = 0

    def close(self) -> None:
        """End the thread that renders the true world, after the requested clips."""
        self._filming.shutdown(wait=False)

    @property
    def now(self) -> Moment:
        """Current moment, from which the next clip continues."""
        return self.moments[self.at]

    @property
    def row(self) -> Float[np.ndarray, " d"]:
        """Current row of hand and camera."""
        row = self.now.start.row
        return self.session.actions.rest if row is None else row

    @property
    def hand(self) -> Pose:
        """Current pose of the hand."""
        return Pose.of_row(self.row, self.side)

    @property
    def state(self) -> SceneState:
        """State of the current moment."""
        return self.now.start.state

    def current_scene(self) -> Scene | None:
        """Return the tabletop scene with the object poses of the state, or None without a seed."""
        return None if self.scene is None else scene_from_state(self.scene, self.state)

    def step(
        self,
        poses: Sequence[Pose],
        camera: Float[np.ndarray, " 6"],
        caption: str,
        show: Callable[[Frames, bool], None],
    ) -> Timing:
        """Make a clip of these hand poses, in which the camera moves to the given row.

        Moments after the current one are dropped. `show` gets each group of frames, and True with
        the last group, before perception starts. A hand out of view is hidden.
        """
        rows = self._rows(poses, self.row, camera)
        session = self.session
        return self._make(lambda n, shown: session.step(n, rows, caption, shown), caption, show)

    def steer(
        self,
        aim: Callable[[], tuple[Pose, Float[np.ndarray, " 6"]]],
        caption: str,
        show: Callable[[Frames, bool], None],
    ) -> Timing:
        """Make a clip in which the hand follows `aim`: the pose and camera where it should be.

        A causal student asks for them again before each part of the clip, so the hand changes
        course while the clip is made. `show` is used as in `step`.
        """
        counts = list(part_rows(self.world.chunk_frames))
        target, planned = None, np.zeros((0, 0))

        def rows_of(count: int, row: Float[np.ndarray, " d"]) -> Float[np.ndarray, "k d"]:
            nonlocal target, planned
            hand, camera = aim()
            aimed = hand.row(self.side, camera)
            if target is None or not np.allclose(aimed, target):
                poses = drive(Pose.of_row(row, self.side), hand, sum(counts) + 1)
                target, planned = aimed, self._rows(poses, row, camera)
            counts.pop(0)
            rows, planned = planned[:count], planned[count:]
            return rows

        return self._make_parts(rows_of, caption, show)

    def follow(
        self,
        take: Callable[[int], tuple[Sequence[Pose], Float[np.ndarray, " 6"]]],
        caption: str,
        show: Callable[[Frames, bool], None],
    ) -> Timing:
        """Make a clip of the poses that a hand went through, and of the camera where it should be.

        `take` returns the next poses, as many as the next part of the clip has rows. It may wait
        for them. `show` is used as in `step`.
        """

        def rows_of(count: int, row: Float[np.ndarray, " d"]) -> Float[np.ndarray, "k d"]:
            poses, camera = take(count)
            return self._rows(poses, row, camera)

        return self._make_parts(rows_of, caption, show)

    def _make_parts(
        self,
        rows_of: Callable[[int, Float[np.ndarray, " d"]], Float[np.ndarray, "k d"]],
        caption: str,
        show: Callable[[Frames, bool], None],
    ) -> Timing:
        """Make a clip part by part, of the rows that follow a row."""

        def make(number: int, shown: Callable[[Frames], None]) -> Result:
            row, result = self.row, None
            for part, count in enumerate(part_rows(self.world.chunk_frames), start=1):
                rows = rows_of(count, row)
                result = self._parts.step(self.session, number, part, rows, caption, shown)
                row = result.row
            return cast(Result, result)

        return self._make(make, caption, show)

    def _make(
        self,
        make: Callable[[int, Callable[[Frames], None]], Result],
        caption: str,
        show: Callable[[Frames, bool], None],
    ) -> Timing:
        """Make a clip, and append its moment; `make` gets the step's number and a callback."""
        then, times, count = time.monotonic(), [], 0
        number, before = self.session.committed + 1, self.now
        truth: Future[Filmed] | None = None

        def film() -> None:
            nonlocal truth
            if before.truth is not None and truth is None:
                action = self.session.action(number)
                truth = self._filming.submit(partial(_film, before.truth, action))

        def shown(frames: Frames) -> None:
            nonlocal count
            count += len(frames)
            last = count == self.world.video.frames
            if last and self.session.pending:
                film()  # renders while perception runs
            show(frames, last)
            times.append(time.monotonic() - then)

        result = make(number, shown)
        film()
        self.moments[self.at + 1 :] = [
            Moment(
                start=self.session.now,
                caption=caption,
                frames=result.frames,
                camera=result.camera,
                action=self.session.action(number),
                truth=truth,
            )
        ]
        self.at += 1
        return Timing(first_s=times[0], last_s=times[-1], total_s=time.monotonic() - then)

    def _rows(
        self,
        poses: Sequence[Pose],
        row: Float[np.ndarray, " d"],
        camera: Float[np.ndarray, " 6"],
    ) -> Float[np.ndarray, "k d"]:
        """Return the rows of hand poses, in which the camera moves from a row to the given one."""
        cameras = straight_path(row[-6:], camera, len(poses) + 1)
        rows = [pose.row(self.side, row) for pose, row in zip(poses, cameras, strict=True)]
        return np.clip(rows, *self.session.actions.bounds)

    def account(self) -> list[str]:
        """Return what perception noted of the last clip, and the objects that it moved."""
        if not self.at:
            return []
        before, after = (self.moments[n].start.state for n in (self.at - 1, self.at))
        notes = self.session.result.info["notes"]
        return [*notes, *map(str, moved_objects(before, after, notes))]

    def go_to(self, number: int) -> None:
        """Return to a moment; the next clip continues from there."""
        if not 0 <= number < len(self.moments):
            raise InputError(
                f"There is no moment {number}: choose one from 0 to {len(self.moments) - 1}."
            )
        self.session.restart(self.moments[number].start)
        self.at = number

    def episode(self) -> Episode:
        """Return the actions up to the current moment as an episode to simulate."""
        made = self.moments[: self.at + 1]
        first = made[0].start
        return Episode(
            state=first.state,
            actions=tuple(moment.action for moment in made if moment.action is not None),
            fps=self.world.video.fps,
            first_frame=first.first_frame,
        )

    def preview(self, hand: Pose, camera: Float[np.ndarray, " 6"]) -> UInt8[np.ndarray, "h w 3"]:
        """Return the wearer's view of the state, with the hand's skeleton drawn over it."""
        action = self._posed(hand, camera)
        simulator = self.world.simulator(self.now.start)
        view = view_of(simulator, self.state, action.cameras)
        drawn, depth = simulator.renderer.draw_hands(
            action.joints_m, action.cameras, kind=action.kind
        )
        return np.where(np.isfinite(depth)[..., None], drawn, view.frames)[0]

    def camera(self, moved: Float[np.ndarray, " 6"]) -> Float[np.ndarray, "4 4"]:
        """Return `world_from_camera` of the wearer's camera, moved from the first camera."""
        return self._posed(self.hand, moved).cameras.world_from_camera[0]

    def _posed(self, hand: Pose, camera: Float[np.ndarray, " 6"]) -> Action:
        spec = self.session.actions
        row = np.clip(hand.row(self.side, camera), *spec.bounds)
        return spec.to_action(row[None], camera=self.now.start.camera, prompt="")[0]


def _true_scene(start: Start, world: GeneratedWorld) -> Scene | None:
    """Return the tabletop scene of a start, or None if it does not come from a seed."""
    if not is_of_seed(start) or start.state.step:
        return None
    return start_of_sequence(start.seed, spec=world.video)[0]


def _film(before: Future[Filmed], action: Action) -> Filmed:
    """Execute an action in the true world, and render it."""
    joints_m = all_joints_of(action)
    scenes, world = before.result()[0].move(action, joints_m=joints_m)
    arms = arms_of(joints_m, action.kind)
    rendered = render_scenes(scenes, action.cameras, arms=arms)
    return world, np.stack([frame.colors for frame in rendered])
