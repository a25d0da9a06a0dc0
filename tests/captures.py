"""A small scene from which tests write datasets: a moving camera, two hands, and their video."""

from fractions import Fraction

import av
import cv2
import numpy as np

from egosim_jax.geometry import look_at

FRAMES = 12


def coded(count, height=32, width=48):
    """Return frames whose gray levels are their numbers."""
    levels = 10 + 240 // count * np.arange(count)
    return np.broadcast_to(
        levels.astype(np.uint8)[:, None, None, None], (count, height, width, 3)
    ).copy()


def shown(frames, count):
    """Return the numbers of frames that were taken out of `count`."""
    numbers = (frames[:, 2:6, 2:6].mean(axis=(1, 2, 3)) - 10) / (240 // count)
    np.testing.assert_allclose(numbers, np.rint(numbers), atol=0.4)
    return np.rint(numbers).astype(int).tolist()


def encode(path, frames, *, rate=30, codec="libx264", options=None, aspect=None):
    """Write RGB frames as a video; return its path. Pixels are `aspect` times as wide as high."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(rate), options=options)
        (stream.height, stream.width), stream.pix_fmt = frames.shape[1:3], "yuv420p"
        if aspect is not None:
            stream.codec_context.sample_aspect_ratio = aspect
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
    return path


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
        focal, center = 0.7 * width, ((width - 1) / 2, (height - 1) / 2)
        self.intrinsics = np.array([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]])
        hand = rng.uniform(-0.04, 0.04, (21, 3))
        sides = np.array([[-0.1, 0, 0], [0.1, 0, 0]])
        drift = 0.002 * np.arange(frames)[:, None, None, None]
        self.joints = hand + sides[:, None] + drift * np.ones((frames, 2, 21, 3))
        self.video = np.empty((frames, height, width, 3), np.uint8)
        blocks = rng.integers(60, 200, (height // 8, width // 8))
        self.video[:] = blocks.repeat(8, 0).repeat(8, 1)[..., None]
        self.video[:, :8, :8] = (10 + 20 * np.arange(frames))[:, None, None, None]

    def render_plane(self):
        """Make the video show a textured plane through the origin, as the cameras see it."""
        texture = np.random.default_rng(1).integers(0, 256, (128, 128, 3)).astype(np.uint8)
        texture = cv2.resize(texture, (1024, 1024), interpolation=cv2.INTER_CUBIC)
        plane_from_texture = np.array([[2 / 1024, 0, -1], [0, -2 / 1024, 1], [0, 0, 1]])
        for index, pose in enumerate(self.poses):
            camera = np.linalg.inv(pose)[:3, [0, 1, 3]]
            homography = self.intrinsics @ camera @ plane_from_texture
            self.video[index] = cv2.warpPerspective(texture, homography, (self.width, self.height))

    def write_video(self, path, *, fps=30, codec="libx264", repeat=1):
        options = {"preset": "12" if codec == "libsvtav1" else "ultrafast", "crf": "12"}
        frames = np.concatenate([self.video] * repeat)
        return encode(path, frames, rate=fps, codec=codec, options=options)

    def assert_first(self, recording):
        """The corner of a frame shows its number: the recording's first must be ours."""
        corner = recording.read_frames().frames[:, 2:6, 2:6].mean(axis=(1, 2, 3))
        np.testing.assert_allclose(corner, 10 + 20 * np.arange(recording.frames), atol=8)


def quaternions(rotations):
    """Quaternions x y z w of rotations, by an implementation that is not ours."""
    vectors = np.stack([cv2.Rodrigues(rotation)[0][:, 0] for rotation in rotations])
    angles = np.linalg.norm(vectors, axis=1, keepdims=True)
    axes = vectors / np.maximum(angles, 1e-12)
    return np.concatenate([axes * np.sin(angles / 2), np.cos(angles / 2)], axis=1)
