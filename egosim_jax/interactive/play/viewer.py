"""Page of `egosim play`: a state to orbit, a hand to drag, clips next to their ground truth.

viser shows the same page in every browser. One lock guards all changes of the episode. The page
accepts one more request while perception runs.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from functools import partial

import cv2
import numpy as np
import viser
import viser.transforms as tf
from jaxtyping import Float, UInt8

from egosim_jax.interactive.play.foresight import Foresight
from egosim_jax.interactive.play.moves import (
    Interaction,
    Pose,
    intent_of,
    perform,
    pre_grasp_pose,
)
from egosim_jax.interactive.play.played_episode import Frames, Moment, PlayedEpisode, Timing
from egosim_jax.interactive.play.state_cloud import StateCloud
from egosim_jax.io.bounded import quote_text
from egosim_jax.io.writing import write_video
from egosim_jax.types import InputError
from egosim_jax.worlds.tabletop.bodies import REACH_M
from egosim_jax.worlds.tabletop.hands import SKIN, hand_meshes, joints_of, pinch
from egosim_jax.worlds.tabletop.scene import Scene

SCALE = 3
"""Upscaling of clip frames on the page."""
CAMERA = (("turn", 4, 20.0), ("tilt", 3, 15.0), ("lean", 0, 12.0), ("forward", 2, 12.0))
"""Camera sliders: name, index in the camera row, maximum in degrees or centimeters."""
HELP = (
    "Drag the **hand** or the **ring**, choose an object, press a button. Orbit with the mouse; "
    "the image in the frustum is the wearer's view."
)
INTERACTIONS: tuple[tuple[str, Interaction], ...] = (
    ("put it on the ring", "carry"),
    ("lift it", "lift"),
    ("open or close it", "open or close"),
)
"""Button labels of the interactions."""
BACKGROUND = (206, 213, 220)
"""Color behind the scene, in which white objects and gaps of the state are seen."""
NOTHING: tuple[str, ...] = ("-",)
"""Placeholder of an empty list."""
CLOSURE_STEP = 0.01
"""Change of the closure after which a moving hand is drawn again."""
Take = Callable[[int], Sequence[Pose]]
"""Function that returns the next poses to paint."""
PREVIEW_S = 0.1
"""Minimum time between two previews, in seconds."""


class Page:
    """Page of a played episode."""

    def __init__(
        self, server: viser.ViserServer, new: Callable[[int], PlayedEpisode], played: PlayedEpisode
    ):
        """Show an episode; `new` begins another one from a seed."""
        self._server, self._new, self.played = server, new, played
        self.changing, self._waiting = threading.Lock(), threading.Lock()
        self._stale, self._shown = threading.Event(), 0
        self.live = False
        """True while the hand of a camera moves; it is not placed by the page then."""
        self.before_change: Callable[[], None] = lambda: None
        """Called before a person changes the episode by a control."""
        self._filling = False  # viser also calls back for values that the page itself sets
        self._make_scene()
        self._make_controls()
        self._open()
        threading.Thread(target=self._keep_preview, name="preview", daemon=True).start()

    def _make_scene(self) -> None:
        scene = self._server.scene
        scene.set_up_direction("+z")
        scene.set_background_image(np.full((1, 1, 3), BACKGROUND, np.uint8))
        first = self._server.initial_camera
        first.position, first.look_at, first.fov = (0.5, -0.42, 0.55), (0.0, 0.22, 0.0), 0.9
        self._cloud = StateCloud(scene)
        self._gizmo = scene.add_transform_controls("/hand", scale=0.12, depth_test=False)
        self._skin: viser.MeshHandle | None = None
        low, high = (REACH_M[0], REACH_M[2]), (REACH_M[1], REACH_M[3])
        self._ring = scene.add_transform_controls(
            "/ring", scale=0.09, active_axes=(True, True, False), disable_rotations=True,
            translation_limits=((low[0], high[0]), (low[1], high[1]), (0.0, 0.0)),
            position=(-0.05, 0.2, 0.0), depth_test=False,
        )  # fmt: skip
        scene.add_cylinder(
            "/ring/mark", radius=0.035, height=0.003, color=(40, 160, 255), opacity=0.6
        )
        video, start = self.played.world.video, self.played.now.start
        fov = 2 * np.arctan(video.height / 2 / start.camera.intrinsics_px[1, 1])
        self._eye = scene.add_camera_frustum(
            "/wearer", float(fov), video.width / video.height, scale=0.09, thickness=0.001,
            image=start.first_frame,
        )  # fmt: skip
        self._gizmo.on_update(lambda _: self._stale.set())

    def _make_controls(self) -> None:
        gui = self._server.gui
        gui.configure_theme(
            control_layout="fixed", control_width="large", show_logo=False, show_share_button=False
        )
        gui.set_panel_label("egosim play")
        size = self.played.world.video.height, self.played.world.video.width
        blank = _large(np.zeros((*size, 3), np.uint8))
        label = "Preview, no model" if self.played.world.makes_previews else "Generated"
        self._images = [gui.add_image(blank, label=label, jpeg_quality=90)]
        gui.add_markdown(HELP)
        self._status = gui.add_markdown("")
        self.top = self._status.order
        """Order of the last control above the folders."""
        with gui.add_folder("Act"):
            self._object: viser.GuiDropdownHandle[str] = gui.add_dropdown("Object", NOTHING)
            acts = {label: partial(self._interact, act) for label, act in INTERACTIONS}
            self._choose("Let the hand", acts)
        with gui.add_folder("Hand"):
            self._closure = gui.add_slider("Grasp", 0.0, 1.0, 0.01, 0.25)
            self._closure.on_update(lambda _: self._draw_hand(float(self._closure.value)))
            moves = {"aim at the object": self._aim, "move where it is shown": self._drive}
            self._choose("Let the hand", moves)
        with gui.add_folder("Camera", expand_by_default=False):
            self._moved = [
                gui.add_slider(name, -limit, limit, 0.5, 0.0, hint="degrees" if n > 2 else "cm")
                for name, n, limit in CAMERA
            ]
            for slider in self._moved:
                slider.on_update(lambda _: self._stale.set())
        with gui.add_folder("Time"):
            self._past: viser.GuiDropdownHandle[str] = gui.add_dropdown("Return to", NOTHING)
            self._past.on_update(lambda _: self._return())
            times = {"undo": self._undo, "replay": self._replay, "save": self._save}
            self._choose("This episode", times)
            self._seed = gui.add_number("Table", self.played.now.start.seed, min=0, step=1)
            self._choose("That table", {"begin there": self._begin})
        # Below the controls, which would else be out of sight on a small screen.
        self._images.append(gui.add_image(blank, label="Ground truth", jpeg_quality=90))

    def _choose(self, label: str, runs: dict[str, Callable[[], None]]) -> None:
        """Add a row of buttons; each one changes the episode."""
        group = self._server.gui.add_button_group(label, tuple(runs))
        group.on_click(lambda event: self._change(runs[event.target.value]))

    def _change(self, run: Callable[[], None]) -> None:
        """Run a change of the episode, unless another change already waits."""
        self.before_change()
        if not self._waiting.acquire(blocking=False):  # at most one waits: clicks do not pile up
            return
        try:
            with self.changing:
                self._waiting.release()
                self._shown += 1  # ends a running replay
                run()
        except (InputError, FloatingPointError) as error:
            self._status.content = quote_text(str(error))
            self._tell("Not possible", str(error))

    def _tell(self, title: str, body: str) -> None:
        for client in self._server.get_clients().values():
            client.add_notification(title, body, auto_close_seconds=8.0)

    @property
    def _camera(self) -> Float[np.ndarray, " 6"]:
        row = np.zeros(6)
        for slider, (_, number, _) in zip(self._moved, CAMERA, strict=True):
            row[number] = np.radians(slider.value) if number > 2 else slider.value / 100
        return row

    @property
    def _hand(self) -> Pose:
        return Pose(
            point_m=np.array(self._gizmo.position, float),
            rotation=tf.SO3(np.array(self._gizmo.wxyz, float)).as_matrix(),
            closure=float(self._closure.value),
        )

    def _interact(self, interaction: Interaction) -> None:
        """Act on the chosen object, at its place in the state."""
        played = self.played
        scene, name = self._scene(), self._object.value
        if scene.body(name).articulated != (interaction == "open or close"):
            raise InputError(
                f"The {name} cannot be used so: drawers and lids open and close, all other objects "
                "are lifted and carried. Choose another object or button."
            )
        place = np.array(self._ring.position[:2], float)
        intent = intent_of(interaction, scene, name, place)
        poses = perform(scene, intent, played.hand, played.side, played.world.video.frames)
        self._step(poses, f"The {played.side} hand {intent.caption}")

    def _scene(self) -> Scene:
        scene = self.played.current_scene()
        if scene is None:
            raise InputError(
                "The scene is not from the tabletop world, so its objects are unknown: drag the "
                "hand instead."
            )
        return scene

    def _aim(self) -> None:
        """Move the gizmo to the pose before a grasp of the object."""
        self._place(pre_grasp_pose(self._scene(), self._object.value, self.played.side))

    def _drive(self) -> None:
        played = self.played
        aim = lambda: (self._hand, self._camera)  # noqa: E731
        caption = played.now.start.prompt
        self._run(caption, lambda show: played.steer(aim, caption, show))

    def _step(self, poses: Sequence[Pose], caption: str) -> None:
        self._run(caption, lambda show: self.played.step(poses, self._camera, caption, show))

    def paint(self, take: Take, first: Callable[[], None], made: Callable[[], None]) -> None:
        """Make a clip of the poses of a camera's hand, unless a change by a person waits.

        `take` as in `PlayedEpisode.follow`; `first` is called at each group of frames, and `made`
        once the state is updated.
        """
        if self._waiting.locked():
            time.sleep(PREVIEW_S)
            return
        with self.changing:
            self._shown += 1
            played, caption = self.played, self.played.now.start.prompt

            def make(show: Callable[[Frames, bool], None]) -> Timing:
                def shown(frames: Frames, last: bool) -> None:
                    show(frames, last)
                    first()

                timing = played.follow(lambda n: (take(n), self._camera), caption, shown)
                made()
                return timing

            self._run(caption, make)

    def show_hand(self, hand: Pose) -> None:
        """Show the hand of a camera."""
        with self._server.atomic():
            self._gizmo.position = hand.point_m
            self._gizmo.wxyz = tf.SO3.from_matrix(hand.rotation).wxyz
            if abs(hand.closure - self._drawn) > CLOSURE_STEP:
                self._draw_hand(hand.closure)

    def show_objects(self, foresight: Foresight) -> None:
        """Show the objects where they are predicted."""
        with self._server.atomic():
            self._cloud.move(foresight.start.state, foresight.poses)

    def _run(self, caption: str, make: Callable[[Callable[[Frames, bool], None]], Timing]) -> None:
        """Make a clip, and show its frames as they are decoded and its latency."""
        self._status.content = "Generating…"

        def show(frames: Frames, last: bool) -> None:
            for frame in frames:
                self._images[0].image = _large(frame)
            if last:
                self._status.content = "Updating the state…"

        timing = make(show)
        lines = [
            caption,
            f"First frame after {timing.first_s:.1f} s, last after {timing.last_s:.1f} s; state "
            f"updated after {timing.total_s:.1f} s.",
            *self.played.account(),
        ]
        self._status.content = "  \n".join(map(quote_text, lines))
        self._refresh()
        if not self.live:
            self._replay_later([self.played.now])

    def _open(self) -> None:
        """Show a new episode."""
        played = self.played
        if played.scene is not None:
            self._object.options = [body.name for body in played.scene.bodies]
        if played.goal is not None:
            self._object.value, place = played.goal
            self._ring.position = (*place, 0.0)
        self._status.content = ""
        self._refresh()

    def _refresh(self) -> None:
        """Show the current moment."""
        played, now = self.played, self.played.now
        with self._server.atomic():
            self._cloud.show(played.state)
        self._filling = True
        captions = [f"{n}: {moment.caption}" for n, moment in enumerate(played.moments)]
        self._past.options = captions
        self._past.value = captions[played.at]
        for slider, (_, number, _) in zip(self._moved, CAMERA, strict=True):
            value = played.row[-6:][number]
            slider.value = round(float(np.degrees(value) if number > 2 else 100 * value), 1)
        if not self.live:
            self._place(played.hand)
        self._filling = False
        self._images[0].image = _large(now.frames[-1])
        self._images[1].visible = now.truth is not None
        if now.truth is not None and now.truth.done():
            self._images[1].image = _large(now.truth.result()[1][-1])

    def _place(self, hand: Pose) -> None:
        """Show the hand in a pose."""
        self._gizmo.position = hand.point_m
        self._gizmo.wxyz = tf.SO3.from_matrix(hand.rotation).wxyz
        self._closure.value = round(hand.closure, 2)
        self._draw_hand(self._closure.value)

    def _draw_hand(self, closure: float) -> None:
        joints = joints_of("human", closure, self.played.side)
        joints = joints - pinch(joints)[0]
        elbow, back = joints[0] - [0, 0.25, 0], np.array([0.0, 0.0, 1.0])
        skin = hand_meshes(joints, elbow, "human", back)[0]
        self._skin = self._server.scene.add_mesh_simple(
            "/hand/skin", skin.vertices_m, skin.triangles, color=SKIN, opacity=0.85
        )
        self._drawn = closure
        if not self.live:
            self._stale.set()

    def _keep_preview(self) -> None:
        """Redraw the wearer's view whenever hand, camera or state has changed."""
        while True:
            self._stale.wait()
            self._stale.clear()
            if self.changing.acquire(timeout=5):
                try:
                    pose = self.played.camera(self._camera)
                    self._eye.image = self.played.preview(self._hand, self._camera)
                    self._eye.position = pose[:3, 3]
                    self._eye.wxyz = tf.SO3.from_matrix(pose[:3, :3]).wxyz
                except InputError as error:
                    self._tell("Not visible", str(error))
                finally:
                    self.changing.release()
            time.sleep(PREVIEW_S)

    def _return(self) -> None:
        if self._filling:
            return
        number = int(self._past.value.split(":")[0])
        self._change(partial(self._go_to, number))

    def _go_to(self, number: int) -> None:
        if number != self.played.at:
            self.played.go_to(number)
            self._status.content = quote_text(self.played.now.caption)
            self._refresh()

    def _undo(self) -> None:
        self._go_to(max(0, self.played.at - 1))

    def _replay(self) -> None:
        self._replay_later(self.played.moments[1 : self.played.at + 1])

    def _replay_later(self, moments: Sequence[Moment]) -> None:
        self._shown += 1
        threading.Thread(target=self._show, args=(list(moments), self._shown), daemon=True).start()

    def _show(self, moments: Sequence[Moment], number: int) -> None:
        """Play clips at their frame rate next to their ground truth, until `_shown` changes."""
        pause = 1 / self.played.world.video.fps
        for moment in moments:
            truth = None if moment.truth is None else moment.truth.result()[1]
            for index, frame in enumerate(moment.frames):
                if self._shown != number:
                    return
                then = time.monotonic()
                self._images[0].image = _large(frame)
                if truth is not None:
                    self._images[1].image = _large(truth[index])
                time.sleep(max(0.0, pause - (time.monotonic() - then)))

    def _save(self) -> None:
        """Write the episode and its video to the session's folder."""
        played = self.played
        if not played.at:
            raise InputError("The episode has no clips yet: make one first.")
        folder = played.session.folder
        played.episode().save(folder / "episode.zip")
        write_video(folder / "episode.mp4", _video(played), played.world.video.fps)
        self._tell("Saved", f"{folder}: episode.zip and episode.mp4")

    def _begin(self) -> None:
        before, self.played = self.played, self._new(int(self._seed.value))
        before.close()
        self._open()


def _video(played: PlayedEpisode) -> UInt8[np.ndarray, "f h w 3"]:
    """Return the clips up to the current moment, with their ground truth on the right."""
    clips = []
    for moment in played.moments[1 : played.at + 1]:
        pair = [moment.frames]
        if moment.truth is not None:
            pair.append(moment.truth.result()[1])
        clips.append(np.concatenate(pair, axis=2))
    return np.concatenate(clips)


def _large(frame: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "H W 3"]:
    size = SCALE * frame.shape[1], SCALE * frame.shape[0]
    return cv2.resize(frame, size, interpolation=cv2.INTER_CUBIC)
