"""A small world whose clips are rendered views with painted hands, and its server.

    python -m tests.painted FOLDER [--pause S] [--batch N]

This serves the world on a free port and prints the address.
"""

import argparse
import functools
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from egosim_jax.geometry import look_at
from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.interactive.env.backends import GeneratedWorld, tabletop_start
from egosim_jax.interactive.env.batching import Batcher
from egosim_jax.rendering import reference
from egosim_jax.types import VideoSpec

VIDEO = VideoSpec(frames=5, height=32, width=48, fps=8)
UP = np.array([0.0, 0.0, 1.0])
SIDE = look_at(np.array([0.45, 0.05, 0.42]), np.array([0.0, 0.275, 0.03]), up=UP)
"""Pose in the world of a camera next to the table."""
WRIST = look_at(np.array([0.0, -0.06, 0.08]), np.array([0.0, 0.2, -0.04]), up=UP)
"""Pose on a wrist of a camera that looks along the fingers."""


@dataclass(frozen=True)
class Painter:
    """Generator that paints hands and a little seeded noise over the view."""

    pause: float = 0.0
    renderer = reference
    point_px = 2
    prior = "static"

    def __call__(self, view, action, first_frame, seed):
        time.sleep(self.pause)
        return self.paint(view, action, seed)

    def paint(self, view, action, seed):
        hands, depth = reference.draw_hands(action.joints_m, action.cameras, kind=action.kind)
        frames = np.where((depth < view.depth_m)[..., None], hands, view.frames).astype(float)
        noise = np.random.default_rng(seed).normal(0, 2, frames.shape)
        return np.clip(np.rint(frames + noise), 0, 255).astype(np.uint8)

    def fingerprint(self):
        return "painter"


class ChunkPainter(Painter):
    """Painter of a clip in chunks of 3 and 2 frames; equal actions give the painter's clip."""

    chunk_frames = (3, 2)

    def begin(self, first_frame, seed):
        return _PaintedChunks(self, np.random.default_rng(seed))


class BatchPainter(ChunkPainter):
    """Painter of a batch of clips in the time of one clip."""

    chunk_frames = (5,)

    def condition(self, view, action, first_frame):
        return view, action

    def groups(self, conditions, seeds):
        time.sleep(self.pause)
        print(f"a batch of {len(seeds)}", file=sys.stderr, flush=True)
        pairs = zip(conditions, seeds, strict=True)
        frames = np.stack([self.paint(*condition, seed) for condition, seed in pairs])
        yield frames[:, :1]
        time.sleep(self.pause)
        yield frames[:, 1:]


@dataclass
class _PaintedChunks:
    """Chunks of a clip (`streams.ClipStream`)."""

    painter: ChunkPainter
    rng: np.random.Generator
    waiting: list = field(default_factory=list)

    def put(self, view, action):
        self.waiting.append(self.painter.paint(view, action, self.rng))

    def take(self):
        frames = self.waiting.pop(0)
        yield frames[:1]
        yield frames[1:]


class PaintedWorld(GeneratedWorld):
    """World of a painter, with cached start scenes."""

    def start(self, seed, spec):
        return _start(seed, spec.kind, spec.sides)


@functools.cache
def _start(seed, kind, sides):
    layout = "gripper" if kind == "robot" else "wrist"
    return tabletop_start(seed, ActionSpec(layout=layout, sides=sides), VIDEO)


def painted(perception=None, pause=0.0, batch=None):
    """Return the painter's world, by default without perception, which is the slowest part."""
    painter = Painter(pause) if batch is None else Batcher(BatchPainter(pause), max_batch=batch)
    return PaintedWorld(generator=painter, video=VIDEO, perception=perception)


def main():
    """Serve the painted world with perception."""
    from egosim_jax.interactive.options import Limits
    from egosim_jax.interactive.origins import bind
    from egosim_jax.interactive.server.server import serve
    from egosim_jax.interactive.server.service import Service
    from egosim_jax.interactive.server.store import Store

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--pause", type=float, default=0.0)
    parser.add_argument("--batch", type=int)
    args = parser.parse_args()
    backend = painted("classical", args.pause, args.batch)
    service = Service(Store(args.folder, backend, Limits()), world="painted")

    def ready(port):
        print(f"http://127.0.0.1:{port}", flush=True)

    serve(service, bind("127.0.0.1", 0, token=None), token=None, ready=ready)
    service.store.close()


if __name__ == "__main__":
    main()
