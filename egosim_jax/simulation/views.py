"""Clips of the further cameras of a rig, made chunk by chunk while the main camera's is made.

Each camera has its own stream of the same generator, from the same state, prediction and seed. A
generator that batches the clips of several threads gets all of them at once.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from threading import Semaphore

import numpy as np
from jaxtyping import Float, UInt8

from egosim_jax.geometry import invert, pixels_of, transform
from egosim_jax.rendering import Renderer
from egosim_jax.simulation.rig import Rig
from egosim_jax.simulation.streams import (
    BatchedGenerator,
    ClipStream,
    VideoGenerator,
    WholeClip,
    begin,
)
from egosim_jax.types import Action, Cameras, Clip, Motion, SceneState, View
from egosim_jax.types.arrays import Video

Check = Callable[[np.ndarray, View], Video]
"""Function that returns a generator's frames, or raises `InputError` if they are not a view's."""


@dataclass(frozen=True, kw_only=True)
class Seen:
    """A clip as a further camera sees it."""

    clip: Clip
    """Generated clip."""
    unobserved: float
    """Share of its pixels that the state does not show, from 0 to 1: the generator invents them."""


@dataclass
class _Stream:
    """Stream of one camera."""

    clip: ClipStream
    views: list[View] = field(default_factory=list)
    frames: list[UInt8[np.ndarray, "f h w 3"]] = field(default_factory=list)
    made: Future[np.ndarray] | None = None

    def seen(self, fps: int) -> Seen:
        """Return the chunks that were taken; there must be one."""
        masks = [view.mask for view in self.views[: len(self.frames)]]
        unobserved = float((np.concatenate(masks) > 0).mean())
        return Seen(clip=Clip(frames=np.concatenate(self.frames), fps=fps), unobserved=unobserved)


class OpenViews:
    """Clips of further cameras: conditions in (`put`), frames out (`take`)."""

    def __init__(self, generator: VideoGenerator, *, renderer: Renderer, point_px: int, seed: int):
        self._generator, self._renderer = generator, renderer
        self._point_px, self._seed = point_px, seed
        self._streams: dict[str, _Stream] = {}
        self._frames = 0

    def put(self, rig: Rig, state: SceneState, action: Action, motion: Motion | None) -> None:
        """Begin the next chunk of each camera, from the state and the action of its frames."""
        for name, seen in rig.actions(action, self._frames).items():
            view = view_from(
                self._renderer, state, seen.cameras, point_px=self._point_px, motion=motion
            )
            if name not in self._streams:
                self._streams[name] = _Stream(begin(self._generator, view.frames[0], self._seed))
            self._streams[name].clip.put(view, seen)
            self._streams[name].views.append(view)
        self._frames += len(action.joints_m)

    def request(self) -> None:
        """Request the clips from a generator that batches, each in a thread; do not wait."""
        generator, announced = self._generator, Semaphore(0)
        streams = [s for s in self._streams.values() if isinstance(s.clip, WholeClip)]
        if not streams or not isinstance(generator, BatchedGenerator):
            return

        def make(clip: ClipStream) -> np.ndarray:
            with generator.announced():
                announced.release()
                return np.concatenate(list(clip.take()))

        threads = ThreadPoolExecutor(len(streams), thread_name_prefix="camera")
        for stream in streams:
            stream.made = threads.submit(make, stream.clip)
        for _ in streams:  # else the batch would not wait for them
            announced.acquire()
        threads.shutdown(wait=False)

    def take(self, check: Check) -> None:
        """Take the frames of each camera's oldest chunk that was put."""
        for stream in self._streams.values():
            made = stream.made
            frames = np.concatenate(list(stream.clip.take())) if made is None else made.result()
            stream.frames.append(check(frames, stream.views[len(stream.frames)]))

    def seen(self, fps: int) -> dict[str, Seen]:
        """Return the chunks that were taken, by the name of the camera."""
        return {name: stream.seen(fps) for name, stream in self._streams.items() if stream.frames}


def view_from(
    renderer: Renderer,
    state: SceneState,
    cameras: Cameras,
    *,
    point_px: int,
    motion: Motion | None = None,
) -> View:
    """Return the view of a camera that may see no point of the state, as `Renderer.render`."""
    points = state.points_m.astype(float)
    if _counts(points, cameras, slice(0, 1))[0]:
        return renderer.render(state, cameras, point_px=point_px, motion=motion)
    counts = _counts(points, cameras, slice(None))
    if not counts.any():
        return _empty_view(cameras)
    order = np.arange(len(counts))  # a renderer must see a point in its first frame
    order[[0, counts.argmax()]] = order[[counts.argmax(), 0]]
    swapped = replace(cameras, world_from_camera=cameras.world_from_camera[order])
    view = renderer.render(
        state, swapped, point_px=point_px, motion=None if motion is None else motion.at(order)
    )
    return View(**{name: array[order] for name, array in vars(view).items()})


def _counts(points_m: Float[np.ndarray, "n 3"], cameras: Cameras, frames: slice) -> np.ndarray:
    """Return the number of points that a camera sees in each of some frames."""
    poses = cameras.world_from_camera[frames]
    seen = [pixels_of(cameras, transform(invert(pose), points_m))[2] for pose in poses]
    return np.sum(seen, axis=1)


def _empty_view(cameras: Cameras) -> View:
    """Return a view in which nothing was observed."""
    size = len(cameras.world_from_camera), cameras.height, cameras.width
    return View(
        frames=np.zeros((*size, 3), np.uint8),
        mask=np.full(size, 255, np.uint8),
        depth_m=np.full(size, np.inf, np.float32),
        object_ids=np.zeros(size, np.int32),
    )
