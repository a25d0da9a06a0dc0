"""COLMAP reconstructions: images with poses, intrinsics and triangulated points.

A folder with a sparse model (itself, or in sparse/0 or sparse/) and the images in images/. The
images in order of their names are the frames of a video, at a rate that the user gives. The
longest run of registered images without gaps is the recording. One camera must have taken all
images, or cameras that are equal within 1 %, whose median is used. Distorted images are remapped,
and so are the pixels that observe points. The unit is arbitrary, so that `metric` is False.
Conventions: `io/untrusted/colmap.py`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import tyro

from egosim_jax.data.readers import Entry, inside, make_id, make_rate, natural_order, require
from egosim_jax.data.readers.images import (
    MAX_IMAGES,
    describe_run,
    longest_run,
    read_posed,
    write_images,
)
from egosim_jax.data.readers.lenses import MAX_SPREAD, Lens, Remap
from egosim_jax.data.recording import Recording
from egosim_jax.data.scene_points import ScenePoints
from egosim_jax.geometry import invert
from egosim_jax.io.bounded import quote_path, quote_text
from egosim_jax.io.untrusted.colmap import Camera, Image, Model, read_model
from egosim_jax.types import InputError

CAMERA_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE")
"""Camera models that are read."""
IMAGES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff")


@dataclass(frozen=True, kw_only=True)
class Colmap:
    """COLMAP reconstruction: images, cameras and points."""

    dataset: ClassVar[str] = "colmap"
    source: Annotated[Path, tyro.conf.Positional]
    """Folder of the reconstruction: a sparse model, or one that has it in sparse/0."""
    fps: float
    """Frame rate of the images in order of their names, which the model does not know."""
    images: Path | None = None
    """Folder of the images, by default images/ next to the model."""

    def find(self) -> Iterator[Entry]:
        """List the one model of the source."""
        require("pycolmap")
        folder = next(
            (
                path
                for path in (self.source, self.source / "sparse" / "0", self.source / "sparse")
                if (path / "images.bin").exists() or (path / "images.txt").exists()
            ),
            None,
        )
        if folder is None:
            raise InputError(
                f"{self.source} has no images.bin or images.txt, in it or in sparse/0: it must be "
                "a COLMAP model."
            )
        yield Entry(
            recording_id=make_id([self.source.resolve().name]),
            read=partial(self._read, folder),
            source=folder,
            options={"--fps": str(self.fps)},
        )

    def _read(self, model_folder: Path, folder: Path) -> Recording:
        fps = make_rate(self.fps)
        model = read_model(model_folder)
        root = self.images or self._find_images(model_folder)
        by_name = {image.name: image for image in model.images}
        names = [
            str(path.relative_to(root))
            for path in sorted(root.rglob("*"), key=natural_order)
            if path.suffix.lower() in IMAGES
        ][:MAX_IMAGES]
        run = longest_run(names, by_name.__contains__)
        images = [by_name[names[index]] for index in run]
        if not images:
            raise InputError(
                f"{quote_path(root)} has none of the model's {len(by_name)} images: their names "
                "are relative to it, and in text files have no spaces. (--images)"
            )
        paths = [inside(root, image.name, what="an image of the model") for image in images]
        lens = one_lens([model.cameras[image.camera_id] for image in images])
        pixels = (read_posed(path, lens) for path in paths)
        recording, remap = write_images(folder, pixels, lens, fps)
        return replace(
            recording,
            world_from_camera=invert(np.stack([image.camera_from_world for image in images])),
            intrinsics_px=(remap or lens).intrinsics_px,
            points=_points(model, images, remap),
            provenance={
                "images": f"{len(images)} of {len(names)}, {len(by_name)} registered",
                "lens": "pinhole" if remap is None else "remapped",
                **describe_run(names, run),
            },
        )

    def _find_images(self, folder: Path) -> Path:
        near = [parent / "images" for parent in (self.source, folder, *list(folder.parents)[:2])]
        found = next((path for path in near if path.is_dir()), None)
        if found is None:
            raise InputError(f"{self.source} has no folder images/ near the model. (--images)")
        return found


def one_lens(cameras: Sequence[Camera]) -> Lens:
    """Return the median lens of all images. Raises `InputError` if their cameras differ."""
    first, table = cameras[0], [camera.parameters for camera in cameras]
    kinds = {(camera.model, camera.height, camera.width) for camera in cameras}
    median = np.median(table, axis=0) if len(kinds) == 1 else np.zeros(0)
    if len(kinds) > 1 or (np.ptp(table, axis=0) > MAX_SPREAD * np.maximum(abs(median), 1)).any():
        raise InputError(
            f"The images are of {len(set(cameras))} different cameras, by more than "
            f"{MAX_SPREAD:.0%} of a parameter: one camera must have taken all. Reconstruct with a "
            "single camera (--ImageReader.single_camera 1), or split the images."
        )
    return make_lens(replace(first, parameters=tuple(median.tolist())))


def make_lens(camera: Camera) -> Lens:
    """Return the lens of a camera, with pixel centers at integers."""
    if camera.model not in CAMERA_MODELS:
        raise InputError(
            f"The camera model {quote_text(camera.model)} is not read; {', '.join(CAMERA_MODELS)} "
            "are. Undistort the images with COLMAP first."
        )
    one_focal = camera.model.startswith("SIMPLE") or camera.model == "RADIAL"
    focal = camera.parameters[:1] if one_focal else ()
    fx, fy, cx, cy, *k = *focal, *camera.parameters
    fisheye = camera.model == "OPENCV_FISHEYE"
    return Lens(
        model="fisheye" if fisheye else "brown",
        coefficients=tuple(k) if fisheye else (*k, 0.0, 0.0, 0.0, 0.0, 0.0)[:5],
        intrinsics_px=np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]]),
        height=camera.height,
        width=camera.width,
    )


def _points(model: Model, images: list[Image], remap: Remap | None) -> ScenePoints | None:
    """Return the model's points with the pixels that observe them."""
    if not len(model.points):
        return None
    frames, indices, pixels = [], [], []
    for frame, image in enumerate(images):
        moved = image.pixels_px if remap is None else remap.move(image.pixels_px)
        good = np.isfinite(moved).all(axis=1)
        pixels.append(moved[good])
        indices.append(image.observed[good])
        frames.append(np.full(int(good.sum()), frame))
    return ScenePoints(
        points_m=model.points.astype(np.float32),
        colors=model.colors,
        error_px=model.error_px.astype(np.float32),
        frames=np.concatenate(frames).astype(np.int32),
        indices=np.concatenate(indices),
        pixels_px=np.concatenate(pixels).astype(np.float32),
    )
