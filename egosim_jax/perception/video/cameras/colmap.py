"""Structure from motion by pycolmap in a child process.

pycolmap and OpenCV crash in one process. So the images are written to a temporary folder here,
and each step runs in a child with a time limit (`io/untrusted/isolated.py`). The child
imports this module, which therefore must not import OpenCV by itself.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from egosim_jax.io.untrusted.colmap import Model, to_arrays
from egosim_jax.io.untrusted.isolated import Child, ChildError
from egosim_jax.perception.video.cameras.flow import Background
from egosim_jax.perception.video.cameras.gate import Reconstruction
from egosim_jax.types import InputError

T = TypeVar("T")
Mapper = Literal["incremental", "global"]


class ColmapError(RuntimeError):
    """Raised when a step of COLMAP crashed, failed or took too long."""


@dataclass(frozen=True, kw_only=True)
class ColmapConfig:
    """Settings of structure from motion."""

    features: int = 4096
    """Most SIFT features of an image."""
    peak_threshold: float = 0.0067
    """Minimum contrast of a feature."""
    overlap: int = 10
    """Following images that each one is matched with."""
    init_angle_deg: float = 2.0
    """Least triangulation angle of the first two images."""
    init_inliers: int = 50
    """Fewest inliers of the first two images."""
    focal_guess: float = 0.45
    """Focal length where self-calibration begins, in longer sides of the image."""
    threads: int = -1
    """Threads; 1 makes the result reproducible, -1 takes all processors."""
    seed: int = 0
    """Seed of the random samples."""
    timeout_s: float = 1800.0
    """Time after which a step is ended, in seconds."""


def require_pycolmap() -> None:
    """Raise `InputError` unless pycolmap is installed."""
    if find_spec("pycolmap") is None:
        raise InputError(
            "Cameras of this video cannot be reconstructed: pycolmap is not installed. It comes "
            "with the extra video: pip install 'egosim-jax[video]'; or give the cameras, or force "
            "the rung static or rotation."
        )


@dataclass(frozen=True)
class Scene:
    """Matched images of a video, ready to be reconstructed in several ways."""

    folder: Path
    frames: tuple[int, ...]
    reduction: float
    config: ColmapConfig
    child: Child

    def match(self) -> None:
        """Extract and match features. Raises `ColmapError` if the child process fails."""
        self._run("features", match_features)

    def reconstruct(self, mapper: Mapper, *, focal_px: float | None = None) -> Reconstruction:
        """Return cameras and points; self-calibrated if no focal length is given.

        Raises `ColmapError` if the child process fails.
        """
        focal = None if focal_px is None else focal_px / self.reduction
        model = self._run(mapper, reconstruct, mapper, focal)
        images, camera = model.images, next(iter(model.cameras.values()), None)
        focal, _, _, radial = camera.parameters if camera else (0.0,) * 4
        pixels = np.concatenate([np.zeros((0, 2)), *(image.pixels_px for image in images)])
        return Reconstruction(
            frames=np.array([self.frames[int(Path(i.name).stem)] for i in images], np.int32),
            camera_from_world=np.array([i.camera_from_world[:3] for i in images]).reshape(-1, 3, 4),
            focal_px=focal * self.reduction,
            radial=radial,
            points=model.points,
            error_px=model.error_px * self.reduction,
            observed_in=np.repeat(
                np.arange(len(images), dtype=np.int32), [len(i.observed) for i in images]
            ),
            observed=np.concatenate([np.zeros(0, np.int32), *(i.observed for i in images)]),
            pixels_px=(pixels + 0.5) * self.reduction - 0.5,
        )

    def _run(self, name: str, step: Callable[..., T], *arguments: Any) -> T:
        """Return the result of a step in the child process."""
        limit = self.config.timeout_s
        try:
            return self.child.call(step, self.folder, self.config, *arguments, timeout_s=limit)
        except TimeoutError:
            raise ColmapError(
                f"COLMAP's step {name} took longer than {limit:g} s and was ended. Give it more "
                "time, or a shorter or smaller video. (timeout_s)"
            ) from None
        except MemoryError:
            raise ColmapError(f"COLMAP's step {name} ran out of memory.") from None
        except ChildError as error:
            raise ColmapError(f"COLMAP's step {name} {error}") from error


@contextmanager
def open_scene(
    video: Background, frames: tuple[int, ...], *, config: ColmapConfig
) -> Iterator[Scene]:
    """Write some frames of a video to a temporary folder, which is removed at the end."""
    import cv2

    require_pycolmap()
    with (
        tempfile.TemporaryDirectory(prefix="egosim_cameras_") as name,
        closing(Child()) as child,
    ):
        folder = Path(name)
        for part in ("images", "masks"):
            (folder / part).mkdir()
        for index, frame in enumerate(frames):
            image, mask = f"images/{index:06d}.png", f"masks/{index:06d}.png.png"
            done = cv2.imwrite(str(folder / image), video.gray[frame])
            if not (done and cv2.imwrite(str(folder / mask), video.still[frame])):
                raise OSError(f"The image {folder / image} could not be written.")
        yield Scene(folder, frames, video.reduction, config, child)


def match_features(folder: Path, config: ColmapConfig) -> None:
    """Extract SIFT features of all images and match those that are near in time.

    This runs in the child.
    """
    pycolmap = _pycolmap(config)
    reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL", mask_path=folder / "masks")
    reader.default_focal_length_factor = config.focal_guess
    extraction = pycolmap.FeatureExtractionOptions(num_threads=config.threads, use_gpu=False)
    extraction.sift.max_num_features = config.features
    extraction.sift.peak_threshold = config.peak_threshold
    pycolmap.extract_features(
        folder / "database.db", folder / "images", camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader, extraction_options=extraction, device=pycolmap.Device.cpu,
    )  # fmt: skip
    matching = pycolmap.FeatureMatchingOptions(num_threads=config.threads, use_gpu=False)
    pairing = pycolmap.SequentialPairingOptions(overlap=config.overlap, num_threads=config.threads)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = config.seed
    pycolmap.match_sequential(
        folder / "database.db", matching_options=matching, pairing_options=pairing,
        verification_options=verification, device=pycolmap.Device.cpu,
    )  # fmt: skip


def reconstruct(
    folder: Path, config: ColmapConfig, mapper: Mapper, focal_px: float | None
) -> Model:
    """Return the reconstruction that registers most images; without one, an empty model.

    This runs in the child.
    """
    pycolmap = _pycolmap(config)
    database, output = folder / "database.db", folder / f"model_{mapper}"
    output.mkdir(exist_ok=True)
    if focal_px is not None:
        _set_focal(pycolmap, database, focal_px)
    if mapper == "incremental":
        options = pycolmap.IncrementalPipelineOptions(
            num_threads=config.threads, random_seed=config.seed, extract_colors=False,
            ba_refine_focal_length=focal_px is None,
        )  # fmt: skip
        options.mapper.init_min_tri_angle = config.init_angle_deg
        options.mapper.init_min_num_inliers = config.init_inliers
        options.mapper.abs_pose_refine_focal_length = focal_px is None
        run = pycolmap.incremental_mapping
    else:
        options = pycolmap.GlobalPipelineOptions(
            num_threads=config.threads, random_seed=config.seed
        )
        options.mapper.bundle_adjustment.refine_focal_length = focal_px is None
        run = pycolmap.global_mapping
    models = run(database, folder / "images", output, options=options)
    empty = pycolmap.Reconstruction()
    return to_arrays(max(models.values(), key=lambda m: m.num_reg_images(), default=empty))


def _pycolmap(config: ColmapConfig) -> Any:
    """Return pycolmap with the seed of the config; it logs warnings."""
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING)
    pycolmap.set_random_seed(config.seed)
    return pycolmap


def _set_focal(pycolmap: Any, database: Path, focal_px: float) -> None:
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            camera.params = [focal_px, *list(camera.params)[1:3], 0.0]
            camera.has_prior_focal_length = True
            opened.update_camera(camera)
