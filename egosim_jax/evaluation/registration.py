"""Find the crop of the recorded video that a method's images show.

Models of other sizes are often run on center crops. A crop is found by its correlation with the
ground truth, jointly over clips, in three steps: a search over offsets and scales of small images
at equal times; the recorded frame that is most similar to each frame of the method, since cameras
and hands of generated clips may lead or lag; and the maximum of

    sum over clips of -log(1 - r^2)

with Pearson's r of the gray levels: the log-likelihood of one crop under noise, brightness and
contrast of unknown size in each clip. A clip that the method got wrong thus has little weight.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from egosim_jax.data.windows import Window
from egosim_jax.evaluation.cache import ScoreCache
from egosim_jax.evaluation.measures import VERSION
from egosim_jax.evaluation.methods import WHOLE, Edges, Folder, without_border
from egosim_jax.io.digest import fingerprint, sha256
from egosim_jax.io.video import VideoInfo, probe_video, read_video

MIN_CORRELATION = 0.7
"""Minimum median correlation over clips of a crop that counts as found."""
SNAP_PX = 1.0
"""Maximum distance in recorded pixels of an edge from the image's that counts as equal."""
MAX_SLACK_PX = 1.5
"""Maximum distance in recorded pixels of all edges from the whole image's that counts as whole."""
MIN_GAIN = 0.1
"""Minimum mean gain over clips of -log(1 - r^2) for a crop to replace the whole image."""
FRAMES, TRUE_FRAMES = 6, 24
"""Number of a method's frames, and of recorded frames, that are used of each clip."""
CLIPS, MAX_FRAMES = 8, 64
"""Maximum number of clips from which a crop is found, and of the frames read of each."""
_COARSE_PX, _FINE_PX, _EVERY = 96, 320, 4
"""Widths of the images in both searches, and the step of frames in the first."""
_MIN_SHARE = 0.3
"""Minimum width of a crop in the search, as a share of the recorded width."""


class Found(NamedTuple):
    """A crop and its evidence."""

    crop: Edges
    """The whole image if no other crop was found."""
    correlation: float
    """Median correlation of the crop over clips."""
    found: bool
    """False if the images correlate too little with the recorded ones to find a crop."""


Pair = tuple[UInt8[np.ndarray, "_ h w 3"], UInt8[np.ndarray, "_ i j 3"]]
"""`FRAMES` frames of a method's clip and `TRUE_FRAMES` of its ground truth, over equal times."""


def find_crops(
    folder: Folder, lengths: Mapping[Window, VideoInfo], *, cache: ScoreCache, every: bool
) -> list[str]:
    """Find the crop of each data set's clips of one size; store it in the folder.

    Without `every`, images of the ground truth's size show all of it. Returns the crops in words.
    """
    groups: dict[tuple[str, int, int, int, int], list[tuple[Window, Path]]] = {}
    for window, info in lengths.items():
        path = window.files.target
        if path is None or not path.exists():
            continue
        truth = probe_video(path)
        blank = np.broadcast_to(np.uint8(0), (info.height, info.width))
        size = without_border(blank, truth.height, truth.width).shape
        if every or size != (truth.height, truth.width):
            key = (window.files.extra.get("dataset", ""), *size, truth.height, truth.width)
            groups.setdefault(key, []).append((window, path))
    lines = []
    for (dataset, _, _, height, width), clips in groups.items():
        result = _find(folder, clips[:CLIPS], lengths, cache)
        folder.crops.update({window.output_id: result.crop for window, _ in clips})
        evidence = f"correlation {result.correlation:.3f}, {len(clips[:CLIPS])} clips"
        if not result.found:
            text = "no crop was found; the images are stretched to the whole"
        elif result.crop == WHOLE:
            text = "the whole image"
        else:
            edges = result.crop.pixels(height, width)
            left, top, right, bottom = (f"{edge + 0:.1f}" for edge in np.round(edges, 1))
            text = f"columns {left} to {right}, rows {top} to {bottom} of {width}x{height}"
        name = f"{folder.name}, {dataset}" if dataset else folder.name
        lines.append(f"{name}: {text} ({evidence})")
    return lines


def _find(
    folder: Folder,
    clips: Sequence[tuple[Window, Path]],
    lengths: Mapping[Window, VideoInfo],
    cache: ScoreCache,
) -> Found:
    """Return the crop of some clips, cached or computed."""
    content = [[sha256(folder.file(w)), sha256(path), w.start] for w, path in clips]
    key = fingerprint(["crop", VERSION, content])
    values = cache.get(key)
    if values is None:
        result = find_crop(
            [_pair(folder.file(w), path, w.start, lengths[w].frames) for w, path in clips]
        )
        evidence = {"correlation": result.correlation, "found": float(result.found)}
        values = {**result.crop._asdict(), **evidence}
        cache.put(key, values)
    crop = Edges(*(values[name] for name in Edges._fields))
    return Found(crop, values["correlation"], bool(values["found"]))


def _pair(video: Path, truth: Path, start: int, count: int) -> Pair:
    """Return frames of a method's clip and of its ground truth, over equal times."""
    count = min(count, MAX_FRAMES)
    true = read_video(truth, start=start, stop=start + count).frames
    taken = np.unique(places(TRUE_FRAMES, min(count, len(true)))).tolist()
    chosen = [taken[place] for place in np.unique(places(FRAMES, len(taken)))]
    border = partial(without_border, height=true.shape[1], width=true.shape[2])
    frames = read_video(video, stop=count, each=border).frames
    return frames[chosen], true[taken]


def find_crop(pairs: Sequence[Pair]) -> Found:
    """Return the crop that all clips of a method share.

    All clips have one size, and so have their ground truths.
    """
    height, width = pairs[0][1].shape[1:3]
    whole = WHOLE.pixels(height, width)
    guess = _search(pairs)
    couples = [_matched(pair, (whole, guess)) for pair in pairs]
    start = max((whole, guess), key=lambda crop: _evidence(crop, couples).sum())
    crop = _refine(start, couples)
    couples = [_matched(pair, (whole, crop)) for pair in pairs]  # better ones, in a better crop
    crop = _refine(crop, couples)
    near = np.abs(np.subtract(crop, whole)) <= SNAP_PX
    crop = Edges(*np.where(near, whole, crop).tolist())
    gain = _evidence(crop, couples) - _evidence(whole, couples)
    slack = np.abs(np.subtract(crop, whole)).max()
    if slack <= MAX_SLACK_PX or gain.mean() < MIN_GAIN or np.median(gain) <= 0:
        crop = whole
    correlation = float(np.sqrt(1 - np.exp(-np.median(_evidence(crop, couples)))))
    is_found = correlation >= MIN_CORRELATION
    shares = Edges(*np.divide(crop, (width, height) * 2).tolist())
    return Found(shares if is_found and crop is not whole else WHOLE, correlation, is_found)


def _search(pairs: Sequence[Pair]) -> Edges:
    """Return the best crop among offsets and scales of small images at equal times."""
    import cv2

    (rows, columns), (height, width) = pairs[0][0].shape[1:3], pairs[0][1].shape[1:3]
    small = _COARSE_PX / width
    wide, high = _COARSE_PX, max(round(height * small), 1)
    couples = [
        (_gray(one), _resized(_gray(true[place]), high, wide))
        for video, true in pairs
        for one, place in [*zip(video, places(len(video), len(true)), strict=True)][::_EVERY]
    ]
    square = rows * wide / (columns * high)  # height of a crop by its width, as shares
    best, best_crop = -np.inf, WHOLE.pixels(height, width)
    for share in np.geomspace(_MIN_SHARE, 1.1 * max(1.0, 1 / square), 28):
        for ratio in [*np.linspace(0.92, 1.08, 5) * square, 0.97, 1.0, 1.03]:
            size = round(share * wide), round(share * ratio * high)
            if min(size) < 16 or share * ratio > 1.1 * max(1.0, square):
                continue
            margin = [max(edge - whole, 0) + edge // 10 for edge, whole in
                      zip(size, (wide, high), strict=True)]  # fmt: skip
            total = 0.0
            for one, true in couples:
                border = (margin[1], margin[1], margin[0], margin[0])
                around = cv2.copyMakeBorder(true, *border, cv2.BORDER_CONSTANT, value=0)
                template = _resized(one, size[1], size[0])
                total += cv2.matchTemplate(around, template, cv2.TM_CCOEFF_NORMED)
            top, left = np.unravel_index(np.argmax(total), np.shape(total))
            if (value := np.max(total)) > best:
                best = value
                left, top = int(left) - margin[0], int(top) - margin[1]
                best_crop = Edges(left / small, top / small, (left + size[0]) / small,
                             (top + size[1]) / small)  # fmt: skip
    return best_crop


class _Couple(NamedTuple):
    """Gray image of a method and the recorded one, as large as the fine search needs."""

    image: Float[np.ndarray, "h w"]
    true: Float[np.ndarray, "i j"]
    scale: tuple[float, float]
    """Pixels of `true` by recorded pixels, along columns and rows."""


def _matched(pair: Pair, crops: Sequence[Edges]) -> _Couple:
    """Return the frame of a method, and the recorded frame, that are most similar in a crop."""
    video, true = pair
    height, width = true.shape[1:3]
    wide = min(_FINE_PX, width)
    high = round(height * wide / width)
    trues = [_resized(_gray(frame), high, wide) for frame in true]
    scale = (wide / width, high / height)
    couples = []
    for frame in video:
        gray = _gray(frame)
        for crop in crops:
            across, down = (crop.right - crop.left) * scale[0], (crop.bottom - crop.top) * scale[1]
            image = _resized(gray, max(round(down), 16), max(round(across), 16))
            couples += [(crop, _Couple(image, other, scale)) for other in trues]
    return max(couples, key=lambda candidate: _correlation(*candidate))[1]


def _evidence(crop: Edges, couples: Sequence[_Couple]) -> Float[np.ndarray, " n"]:
    """Return -log(1 - r^2) of each clip; an equal image counts as r = 0.9999."""
    r = np.array([_correlation(crop, couple) for couple in couples])
    return -np.log(1 - np.clip(r, 0, 0.9999) ** 2)


def _correlation(crop: Edges, couple: _Couple) -> float:
    """Return the correlation of an image with the crop it may show, inside the recorded image."""
    import cv2

    image, true, (x, y) = couple
    rows, columns = image.shape
    across, down = (crop.right - crop.left) * x / columns, (crop.bottom - crop.top) * y / rows
    left, top = crop.left * x + (across - 1) / 2, crop.top * y + (down - 1) / 2
    if across <= 0 or down <= 0:
        return 0.0
    matrix = np.array([[across, 0, left], [0, down, top]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    seen = cv2.warpAffine(
        true, matrix, (columns, rows), flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    offset, step = np.array([left, top]), np.array([across, down])
    first = np.ceil(-offset / step - 1e-6).clip(0).astype(int)
    end = np.floor((np.array(true.shape[::-1]) - 1 - offset) / step + 1e-6).astype(int) + 1
    inside = slice(first[1], max(end[1], 0)), slice(first[0], max(end[0], 0))
    a, b = image[inside], seen[inside]
    if a.size < image.size // 4:
        return 0.0
    a, b = a - a.mean(), b - b.mean()
    strength = float((a * a).sum() * (b * b).sum())
    return float((a * b).sum()) / strength**0.5 if strength > 1e-6 else 0.0


def _refine(start: Edges, couples: Sequence[_Couple]) -> Edges:
    """Return the crop in pixels that has the most evidence near a first guess."""
    from scipy.optimize import minimize

    size = np.array([start.right - start.left, start.bottom - start.top] * 2)
    origin, steps = np.array(start), 0.02 * size

    def cost(x: np.ndarray) -> float:
        return -float(_evidence(Edges(*(origin + x * steps)), couples).sum())

    simplex = np.vstack([np.zeros(4), np.eye(4)])
    for _ in range(2):  # restarted once, since a simplex may collapse
        options = {"initial_simplex": simplex, "xatol": 2e-3, "fatol": 1e-5, "maxfev": 400}
        minimum = minimize(cost, simplex[0], method="Nelder-Mead", options=options).x
        simplex = np.vstack([minimum, minimum + 0.3 * np.eye(4)])
    return Edges(*(origin + simplex[0] * steps).tolist())


def places(count: int, of: int) -> list[int]:
    """Return `count` evenly spaced places of `of`, some repeated if there are fewer."""
    return np.rint(np.linspace(0, of - 1, count)).astype(int).tolist()


def _gray(frame: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    return frame.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)


def _resized(image: Float[np.ndarray, "h w"], height: int, width: int) -> np.ndarray:
    import cv2

    how = cv2.INTER_AREA if height * width < image.size else cv2.INTER_LINEAR
    return cv2.resize(image, (width, height), interpolation=how)
