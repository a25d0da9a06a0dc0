"""Scenes of the tabletop world that no model was trained on, and how videos of them are judged."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from egosim_jax.data.sheet import SheetClip

if TYPE_CHECKING:
    import numpy as np

    from egosim_jax.generator import Generator
    from egosim_jax.types import Kind, Triplet, VideoSpec
    from egosim_jax.worlds.tabletop import TabletopClip

Hidden = Literal["prior", "mask", "hands"]
MEASURES = {
    "psnr": ("PSNR dB", "{:.2f}"),
    "ssim": ("SSIM", "{:.3f}"),
    "region_psnr": ("region PSNR dB", "{:.2f}"),
    "hand_iou": ("hand IoU", "{:.3f}"),
    "object_error": ("object error %", "{:.2f}"),
}
DEFINITIONS = {
    "psnr, ssim": "as in evaluate, frames 1 to the last",
    "region_psnr": "dB over the pixels where the truth shows a hand or the thing acted on, all "
    "frames of a clip together",
    "hand_iou": "silhouette of hands and arms, read off by color and opened by 3 x 3, against the "
    "true ids; mean over frames",
    "object_error": "distance between the centroids of the thing acted on, read off by color, and "
    "its true one, in percent of the width; mean over the frames in which it is seen",
}
SHEET_SCENES, SHEET_MOMENTS = 4, (0, 3, 6, 9, 12, 16)


@dataclass(frozen=True)
class Scene:
    """A held-out clip, its truth and its conditions."""

    clip: TabletopClip
    triplet: Triplet
    background: np.ndarray
    """The true frames without hands and without what they act on."""

    @classmethod
    def make(cls, seed: int, spec: VideoSpec, kind: Kind) -> Scene:
        """The first clip of a seed."""
        from egosim_jax.worlds.tabletop import make_sequence, to_triplet

        clip = next(make_sequence(seed, spec=spec, kind=kind))
        bare = next(make_sequence(seed, spec=spec, kind=kind, bare=True))
        return cls(clip, to_triplet(clip), bare.frames)

    def judge(self, video: np.ndarray) -> dict[str, float]:
        """Every measure of a video of this scene."""
        import numpy as np

        from egosim_jax.metrics import region
        from egosim_jax.metrics.report import score
        from egosim_jax.worlds.tabletop.scene import FIRST_HAND

        truth, ids = self.clip.frames[1:], self.clip.ids[1:]
        target = self.clip.body_ids[self.clip.target]
        hands, thing = ids >= FIRST_HAND, ids == target
        movers = {n: c for n, c in self.clip.paints.items() if n == target or n >= FIRST_HAND}
        seen = region.label(video[1:], self.background[1:], movers)
        whole = score(video[1:], truth)
        errors = region.centroid_errors(seen == target, thing)
        return {
            "psnr": whole.psnr,
            "ssim": whole.ssim,
            "region_psnr": region.region_psnr(video[1:], truth, hands | thing),
            "hand_iou": region.silhouette_iou(region.open_mask(seen >= FIRST_HAND), hands),
            "object_error": 100 * float(np.mean(errors)) / ids.shape[2] if len(errors) else np.nan,
        }

    def block(self, videos: Mapping[str, np.ndarray]) -> SheetClip:
        """This scene on a contact sheet: its conditions, the videos by name, the truth."""
        names = ", ".join(("prior", "hands", *videos, "truth"))
        return SheetClip(
            f"{self.triplet.video_id}: {self.clip.caption}   ({names})",
            [self.triplet.prior, self.triplet.hands, *videos.values(), self.clip.frames],
        )


def judge(scenes: Sequence[Scene], videos: Sequence[np.ndarray]) -> list[dict[str, float]]:
    """Every measure of a video of each scene."""
    return [scene.judge(video) for scene, video in zip(scenes, videos, strict=True)]


def generate(
    generator: Generator,
    scenes: Sequence[Scene],
    *,
    batch_size: int,
    seed: int = 0,
    without: Hidden | None = None,
) -> Iterator[np.ndarray]:
    """A video of every scene, from noise that differs by scene and seed."""
    from egosim_jax.generator import batches

    for some in batches(scenes, batch_size):
        noise = [1000 * seed + scene.clip.seed for scene in some]
        clips = generator.generate([scene.triplet for scene in some], noise, without=without)
        yield from (clip.frames for clip in clips)


def reconstruct(
    generator: Generator, scenes: Sequence[Scene], *, batch_size: int
) -> Iterator[np.ndarray]:
    """The truth through the autoencoder and back: the best that any denoiser could give."""
    from egosim_jax.generator import batches

    for some in batches(scenes, batch_size):
        clips = generator.reconstruct([scene.triplet for scene in some])
        yield from (clip.frames for clip in clips)


def copies(scenes: Sequence[Scene]) -> dict[str, list[np.ndarray]]:
    """What can be had without a denoiser."""
    import numpy as np

    truths = [scene.clip.frames for scene in scenes]
    return {
        "prior copied": [scene.triplet.prior for scene in scenes],
        "first frame repeated": [np.broadcast_to(truth[:1], truth.shape) for truth in truths],
    }
