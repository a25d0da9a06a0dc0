"""Sample clips in EgoSim's format, drawn by formula: a stand-in for recorded data.

Each clip looks down on a table while the head turns a little. A hand reaches for a ball, grasps it
and carries it. The prior is the table as the first frame shows it, with the holes that the turn
uncovers; the mask is white in the holes; the hand video shows the 21-keypoint skeleton on black.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw

from egosim_jax.data.clips import write_clips
from egosim_jax.types import Triplet, VideoSpec

CHAINS = [[0, *range(first, first + 4)] for first in (1, 5, 9, 13, 17)]
"""Keypoints from the wrist to each fingertip, thumb first."""
PALETTE = [(247, 189, 247), (255, 167, 144), (244, 251, 253), (215, 255, 119), (0, 203, 224)]
"""Colours of the fingers on EgoSim's skeletons, thumb first."""
SKIN = (214, 160, 130)
BALLS = {"red": (200, 50, 45), "blue": (40, 80, 200), "green": (40, 150, 70)}


@dataclass(frozen=True)
class _Motion:
    """Where things are at each frame, in units of the picture's height."""

    pan: Float[np.ndarray, " f"]
    hand: Float[np.ndarray, "f 2"]
    ball: Float[np.ndarray, "f 2"]


def make_sample(spec: VideoSpec, *, seed: int = 0) -> Triplet:
    """One clip by seed, its truth included."""
    rng = np.random.default_rng(seed)
    colour = list(BALLS)[int(rng.integers(len(BALLS)))]
    height, width = spec.height, spec.width
    table = _table(rng, height, 2 * width)
    motion = _motion(rng, spec)

    def still(pan: float) -> Image.Image:
        left = width / 2 + pan * height
        return table.transform((width, height), Image.Transform.AFFINE, (1, 0, left, 0, 1, 0),
                               Image.Resampling.BILINEAR)  # fmt: skip

    truth, prior, mask, hands = [], [], [], []
    columns = np.arange(width)
    for pan, hand, ball in zip(motion.pan, motion.hand, motion.ball, strict=True):
        view = np.array([pan, 0.0])
        hole = columns + pan * height > width - 1
        scene = still(pan)
        _ball(scene, (motion.ball[0] - view) * height, height, BALLS[colour])
        prior.append(np.where(hole[:, None], np.uint8(0), np.asarray(scene)))
        mask.append(np.broadcast_to(np.where(hole, 255, 0), (height, width)).astype(np.uint8))
        joints = (_keypoints() + hand - view) * height
        picture = still(pan)
        _ball(picture, (ball - view) * height, height, BALLS[colour])
        _fingers(picture, joints, height * 0.05, [SKIN] * 5)
        truth.append(np.asarray(picture))
        skeleton = Image.new("RGB", (width, height))
        _fingers(skeleton, joints, height * 0.012, PALETTE)
        hands.append(np.asarray(skeleton))
    return Triplet(
        video_id=f"sample_{seed}",
        prompt=f"The right hand picks up a {colour} ball and carries it across the table.",
        prior=np.stack(prior),
        mask=np.stack(mask),
        hands=np.stack(hands),
        first_frame=prior[0],
        truth=np.stack(truth),
    )


def write_sample(folder: Path, *, spec: VideoSpec, clips: int = 1, seed: int = 0) -> Path:
    """Write clips of consecutive seeds as files; the path of their metadata.csv."""

    def split(number: int) -> dict[str, str]:
        return {"split": "test" if number % 4 == 3 else "train"}

    numbers = range(seed, seed + clips)
    samples = (replace(make_sample(spec, seed=n), extra=split(n)) for n in numbers)
    return write_clips(folder, samples, fps=spec.fps)


def _table(rng: np.random.Generator, height: int, width: int) -> Image.Image:
    """Smooth random wood: coarse noise, stretched along the rows and enlarged."""
    base = np.array([150, 115, 80]) + rng.integers(-25, 25, 3)
    noise = rng.normal(0, 18, (12, 6, 1)) + rng.normal(0, 6, (12, 6, 3))
    coarse = np.clip(base + noise, 0, 255).astype(np.uint8)
    return Image.fromarray(coarse).resize((width, height), Image.Resampling.BICUBIC)


def _motion(rng: np.random.Generator, spec: VideoSpec) -> _Motion:
    """Reach in the first half, carry in the second, under a slow turn of the head."""
    time = np.linspace(0, 1, spec.frames)[:, None]
    aspect = spec.width / spec.height
    start, grasp, end = (
        np.array([aspect * x, y]) + rng.uniform(-0.05, 0.05, 2)
        for x, y in ((0.75, 0.9), (0.4, 0.45), (0.65, 0.35))
    )
    ease = lambda t: t * t * (3 - 2 * t)  # noqa: E731
    reach, carry = ease(np.clip(2 * time, 0, 1)), ease(np.clip(2 * time - 1, 0, 1))
    hand = start + (grasp - start) * reach + (end - grasp) * carry
    ball = grasp + (end - grasp) * carry
    return _Motion(pan=0.15 * time[:, 0] * rng.uniform(0.5, 1.0), hand=hand, ball=ball)


def _keypoints() -> Float[np.ndarray, "21 2"]:
    """A curled right hand whose fingertips meet at the origin, in units of the height."""
    points = np.zeros((21, 2))
    points[0] = (0.22, 0.30)
    tips = np.array([(-0.03, 0.05), (-0.02, -0.01), (0.0, -0.03), (0.03, -0.02), (0.06, 0.0)])
    knuckles = np.array([(0.08, 0.24), (0.08, 0.14), (0.12, 0.12), (0.16, 0.12), (0.20, 0.14)])
    for tip, knuckle, chain in zip(tips, knuckles, CHAINS, strict=True):
        points[chain[1:]] = knuckle + (tip - knuckle) * np.linspace(0, 1, 4)[:, None]
    return points


def _fingers(
    picture: Image.Image,
    joints: Float[np.ndarray, "21 2"],
    thickness: float,
    colours: list[tuple[int, int, int]],
) -> None:
    """Draw each finger as round-ended lines."""
    draw = ImageDraw.Draw(picture)
    radius = max(1.0, thickness / 2)
    for chain, colour in zip(CHAINS, colours, strict=True):
        line = [(float(x), float(y)) for x, y in joints[chain]]
        draw.line(line, fill=colour, width=max(1, round(thickness)))
        for x, y in line:
            draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)


def _ball(
    picture: Image.Image, centre: Float[np.ndarray, " 2"], height: int, colour: tuple[int, int, int]
) -> None:
    """A disc with a highlight."""
    draw = ImageDraw.Draw(picture)
    for part, shade in ((1.0, 1.0), (0.4, 1.25)):
        radius = 0.08 * height * part
        x, y = centre - (1 - part) * 0.03 * height
        fill = tuple(min(255, int(c * shade)) for c in colour)
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=fill)
