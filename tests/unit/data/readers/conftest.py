"""Scenes from which tiny datasets are written: a moving camera, two hands, and their video."""

from fractions import Fraction

import av
import numpy as np
import pytest

from egosim_jax.data.importing import import_recordings
from egosim_jax.data.recording import Recording
from egosim_jax.geometry import look_at

FRAMES = 12


class World:
    """A camera that moves by some centimeters, two hands before it, and a textured video."""

    def __init__(self, frames=FRAMES, height=96, width=128):
        rng = np.random.default_rng(0)
        self.frames, self.height, self.width = frames, height, width
        target, up = np.zeros(3), np.array([0.0, 1, 0])
        eyes = np.stack([0.1 * np.sin(0.3 * np.arange(frames)), np.full(frames, 0.3)], axis=1)
        self.poses = np.stack(
            [look_at(np.array([x, y, -0.5]), target, up=up) for x, y in eyes.tolist()]
        )
        self.intrinsics = np.array([[90.0, 0, 63.5], [0, 90, 47.5], [0, 0, 1]])
        hand = rng.uniform(-0.04, 0.04, (21, 3))
        sides = np.array([[-0.1, 0, 0], [0.1, 0, 0]])
        drift = 0.002 * np.arange(frames)[:, None, None, None]
        self.joints = hand + sides[:, None] + drift * np.ones((frames, 2, 21, 3))
        self.video = np.empty((frames, height, width, 3), np.uint8)
        self.video[:] = (
            rng.integers(60, 200, (1, height // 8, width // 8, 3)).repeat(8, 1).repeat(8, 2)
        )
        self.video[:, :8, :8] = (10 + 20 * np.arange(frames))[:, None, None, None]

    def write_video(self, path, *, fps=30, codec="libx264", repeat=1):
        path.parent.mkdir(parents=True, exist_ok=True)
        with av.open(str(path), "w") as container:
            stream = container.add_stream(codec, rate=Fraction(fps))
            stream.width, stream.height, stream.pix_fmt = self.width, self.height, "yuv420p"
            stream.options = {"preset": "12" if codec == "libsvtav1" else "ultrafast", "crf": "12"}
            for frame in [*self.video] * repeat:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
            container.mux(stream.encode())
        return path

    def assert_first(self, recording):
        """The corner of a frame shows its number: the recording's first must be ours."""
        corner = recording.read_frames().frames[:, 2:6, 2:6].mean(axis=(1, 2, 3))
        np.testing.assert_allclose(corner, 10 + 20 * np.arange(recording.frames), atol=8)


@pytest.fixture
def world():
    return World()


@pytest.fixture
def imported(tmp_path):
    """Return a function that imports and returns recordings and problems by id."""

    def run(reader, **options):
        total, outcomes = import_recordings(reader, tmp_path / "out", **options)
        outcomes = list(outcomes)
        assert len(outcomes) == total
        problems = {o.recording_id: o.problem for o in outcomes if o.problem}
        done = {
            o.recording_id: Recording.load(tmp_path / "out" / o.recording_id)
            for o in outcomes
            if not o.problem
        }
        return done, problems

    return run
