"""A small world whose clips are its views with the hands painted over them."""

import numpy as np

from egosim_jax.env.backends import GeneratedWorld
from egosim_jax.rendering import reference
from egosim_jax.types import VideoSpec

VIDEO = VideoSpec(frames=5, height=24, width=40, fps=8)


class Painter:
    """Generator that paints the hands over the view, and a little noise of the seed."""

    renderer = reference

    def __call__(self, view, action, first_frame, seed):
        hands, depth = reference.draw_hands(action.joints_m, action.cameras, kind=action.kind)
        frames = np.where((depth < view.depth_m)[..., None], hands, view.frames).astype(float)
        noise = np.random.default_rng(seed).normal(0, 2, frames.shape)
        return np.clip(np.rint(frames + noise), 0, 255).astype(np.uint8)

    def fingerprint(self):
        return "painter"


def painted(perception=None):
    """World of the painter, by default without perception, which takes longest."""
    return GeneratedWorld(generator=Painter(), video=VIDEO, perception=perception)
