"""Methods of a table: folders of clips from any model, and baselines without a model.

A method returns a video of a window at a requested length and size. The baselines make it from the
clip's own files.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from egosim_jax.data.clip_files import is_safe_id
from egosim_jax.data.transforms import resize_image
from egosim_jax.data.windows import Window
from egosim_jax.evaluation.metrics.image import fit_colors
from egosim_jax.io.bounded import quote_path, quote_text
from egosim_jax.io.video import read_video
from egosim_jax.types import InputError

MAX_BORDER_PX = 8
"""Maximum number of extra rows or columns of a video that is cropped instead of resized."""
FIT = (
    "Pillow LANCZOS, the image, or the part of it inside the compared crop, stretched to the size "
    "of the comparison; a video that exceeds the size of the whole by at most "
    f"{MAX_BORDER_PX} rows and columns has a border, and is cropped to its center"
)


class Edges(NamedTuple):
    """Edges of a part of an image, in shares of its width and height."""

    left: float
    top: float
    right: float
    bottom: float

    def common(self, other: Edges) -> Edges:
        """Return the intersection; it may be empty."""
        return Edges(*map(max, self[:2], other[:2]), *map(min, self[2:], other[2:]))

    def pixels(self, height: int, width: int) -> Edges:
        """Return the edges in pixels of an image."""
        return Edges(*np.multiply(self, (width, height) * 2).tolist())

    def whole_pixels(self, height: int, width: int) -> Edges:
        """Return the largest crop inside that has whole pixels of an image."""
        edges = np.round(self.pixels(height, width), 2)
        inside = np.concatenate([np.ceil(edges[:2]), np.floor(edges[2:])])
        return Edges(*(inside / ((width, height) * 2)).tolist())

    def within(self, other: Edges) -> Edges:
        """Return this crop in shares of the crop `other`."""
        left, top, right, bottom = other
        size = np.array([right - left, bottom - top] * 2)
        return Edges(*((np.array(self) - [left, top, left, top]) / size).tolist())


WHOLE = Edges(0.0, 0.0, 1.0, 1.0)
"""The whole image."""


class Shape(NamedTuple):
    """Number of frames, size and crop at which videos are compared."""

    frames: int
    height: int
    width: int
    crop: Edges = WHOLE
    """Part of the recorded image that is compared."""

    @property
    def whole(self) -> tuple[int, int]:
        """Height and width of the whole image at the scale of the comparison."""
        left, top, right, bottom = self.crop
        return round(self.height / (bottom - top)), round(self.width / (right - left))


@dataclass(frozen=True, kw_only=True)
class Folder:
    """Clips in a folder: {id}.mp4, there or in a subfolder named after the dataset or split."""

    path: Path
    """Folder of generated clips."""
    name: str
    """Key of the folder in reports."""
    title: str
    """Name of the folder in tables."""
    suffix: str = ""
    """Suffix of the file names before .mp4."""
    optional: bool = False
    """True if clips may be missing."""
    seed_of: str | None = None
    """Method whose clips of one seed the folder has; scores are averaged over its seeds."""
    crops: dict[str, Edges] = field(default_factory=dict)
    """Part of the recorded image that the clips show, by their ids; the whole by default."""

    @property
    def row(self) -> str:
        """Key of the row that has the scores."""
        return self.seed_of or self.name

    @classmethod
    def parse_all(cls, texts: Sequence[str]) -> list[Folder]:
        """Parse folders; several that are given as one NAME=DIR have seeds of one method.

        Raises `InputError`.
        """
        folders = [cls.parse(text) for text in texts]
        given = Counter(f.name for f, text in zip(folders, texts, strict=True) if "=" in text)
        paths = {name: {f.path.resolve() for f in folders if f.name == name} for name in given}
        seen: Counter[str] = Counter()
        for place, folder in enumerate(folders):
            name = folder.name
            count = given[name]
            if count > 1 and count == len(paths[name]) == sum(f.row == name for f in folders):
                seen[name] += 1
                folders[place] = replace(
                    folder, name=f"{name}_{seen[name]}", title=f"{name}, mean of {count} seeds",
                    seed_of=name,
                )  # fmt: skip
        return folders

    @classmethod
    def parse(cls, text: str) -> Folder:
        """Parse NAME=DIR or DIR, whose last part is then the name. Raises `InputError`."""
        name, equals, path = text.rpartition("=")
        folder = Path(path)
        name = name if equals else folder.resolve().name
        if not is_safe_id(name) or "/" in name:
            raise InputError(
                f"{quote_text(name)!r} does not name a method: a name has letters, digits, '.', "
                "'_' and '-'. Give NAME=DIR. (--generated)"
            )
        if not folder.is_dir():
            raise InputError(f"There is no folder {quote_path(folder)}. (--generated)")
        return cls(path=folder, name=name, title=name)

    def file(self, window: Window) -> Path:
        """Return the path of a window's clip; in the folder itself if no subfolder has it."""
        name = f"{window.output_id}{self.suffix}.mp4"
        columns = (window.files.extra.get(column, "") for column in ("dataset", "split"))
        below = [self.path / value / name for value in columns if is_safe_id(value)]
        return next((path for path in below if path.is_file()), self.path / name)

    def sources(self, window: Window) -> tuple[Path, ...]:
        """Return the clip."""
        return (self.file(window),)

    def video(self, window: Window, shape: Shape, target: np.ndarray) -> np.ndarray:
        """Return the clip, fitted to the shape."""
        shown = self.crops.get(window.output_id, WHOLE)
        return read_at(self.file(window), shape, 0, border=True, shown=shown)


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """A video without a model, from the prior or the ground truth."""

    name: Literal["prior", "prior_fit", "still"]
    """Key of the baseline in reports."""
    title: str
    """Name of the baseline in tables."""

    def sources(self, window: Window) -> tuple[Path, ...]:
        """Return the files, other than the ground truth, on which the video depends."""
        return () if self.name == "still" else (window.files.prior,)

    def video(self, window: Window, shape: Shape, target: np.ndarray) -> np.ndarray:
        """Return the first frame at all frames, or the prior over the window's frames."""
        if self.name == "still":
            return np.broadcast_to(target[:1], target.shape)
        prior = read_at(window.files.prior, shape, window.start)
        return fit_colors(prior, target) if self.name == "prior_fit" else prior


Method = Folder | Baseline
"""A row of a table."""


def autoencoded(path: Path) -> Folder:
    """Return the method of the {id}_vae.mp4 in a folder: an upper bound for its model."""
    title = "ground truth through the autoencoder"
    return Folder(path=path, name="vae", title=title, suffix="_vae", optional=True)


BASELINES: dict[str, Baseline] = {
    "prior": Baseline(name="prior", title="prior"),
    "prior_fit": Baseline(name="prior_fit", title="prior, colors fitted to the ground truth"),
    "still": Baseline(name="still", title="first frame of the ground truth, repeated"),
}
"""Baselines without a model, by name."""


def check_names(methods: Sequence[Method]) -> None:
    """Raise `InputError` if two methods have the same name."""
    names = [method.name for method in methods]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise InputError(
            f"Several methods are named {', '.join(repeated)}: each row of a table needs a name. "
            "Give NAME=DIR; several folders of one NAME are seeds of one method. (--generated)"
        )


def read_at(
    path: Path, shape: Shape, start: int, *, border: bool = False, shown: Edges = WHOLE
) -> UInt8[np.ndarray, "f h w 3"]:
    """Read frames from `start`, fitted to a shape. Raises `InputError` if there are too few.

    The images show the part `shown` of the recorded image. With `border`, a narrow border around
    them is cropped instead of resized.
    """
    fit = partial(_fit, shape=shape, border=border, shown=shown)
    frames = read_video(path, start=start, stop=start + shape.frames, each=fit).frames
    if len(frames) < shape.frames:
        raise InputError(
            f"{path} has {len(frames)} frames from frame {start} on: {shape.frames} are needed. "
            "Give the complete video."
        )
    return frames


def _fit(frame: np.ndarray, *, shape: Shape, border: bool, shown: Edges) -> np.ndarray:
    if border:
        frame = without_border(frame, *shape.whole)
    if shape.crop == shown:
        return resize_image(frame, shape.height, shape.width)
    height, width = frame.shape[:2]
    edges = shape.crop.within(shown).pixels(height, width)
    box = np.clip(edges, 0, (width, height) * 2).tolist()
    size, how = (shape.width, shape.height), Image.Resampling.LANCZOS
    return np.asarray(Image.fromarray(frame).resize(size, how, box=box))


def without_border(frame: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return the center of an image that exceeds a size by a narrow border; else the image."""
    rows, columns = frame.shape[0] - height, frame.shape[1] - width
    if not (0 <= rows <= MAX_BORDER_PX and 0 <= columns <= MAX_BORDER_PX):
        return frame
    top, left = rows // 2, columns // 2
    return frame[top : top + height, left : left + width]
