"""Structure from motion in child processes: COLMAP by pycolmap, of which no crash reaches us.

pycolmap and OpenCV crash in one process. So the images are written to a temporary folder here,
each step runs in a process that never imports OpenCV (`colmap_child.py`), with a time limit, and
its result is an npz file. COLMAP has the center of the first pixel at (0.5, 0.5); what is read
back has it at (0, 0), and pixels of the size that the video was given in.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np

from egosim_jax.io.untrusted.npz import read_arrays
from egosim_jax.perception.cameras.flow import Background
from egosim_jax.perception.cameras.gate import Reconstruction
from egosim_jax.types import InputError, check_counts, check_seed

CHILD = Path(__file__).with_name("colmap_child.py")
Mapper = Literal["incremental", "global"]
_RESULT = {
    "frames": "int32", "camera_from_world": "float64", "camera": "float64", "points": "float64",
    "error_px": "float64", "observations": "float64",
}  # fmt: skip


class ColmapError(RuntimeError):
    """Raised when a step of COLMAP crashed, failed or took too long."""


@dataclass(frozen=True, kw_only=True)
class ColmapConfig:
    """Settings of structure from motion."""

    features: int = 4096
    """Most SIFT features of an image."""
    peak_threshold: float = 0.0067
    """Least contrast of a feature."""
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

    def __post_init__(self) -> None:
        """Check the counts and limits."""
        counts = ("features", "overlap", "init_inliers")
        check_counts({name: getattr(self, name) for name in counts})
        check_seed(self.seed, name="seed")
        if min(self.timeout_s, self.focal_guess, self.init_angle_deg, self.peak_threshold) <= 0:
            raise InputError(f"Settings of COLMAP must be positive: {self}.")
        if self.threads == 0 or self.threads < -1:
            raise InputError(f"threads must be -1 (all) or at least 1, not {self.threads}.")


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
    height: int
    width: int
    config: ColmapConfig

    def reconstruct(self, mapper: Mapper, *, focal_px: float | None = None) -> Reconstruction:
        """Return cameras and points; self-calibrated if no focal length is given.

        Raises `ColmapError` if the child process fails.
        """
        job = self._job(mapper)
        job["focal_px"] = None if focal_px is None else focal_px / self.reduction
        result = self.folder / f"result_{mapper}_{focal_px is not None}.npz"
        _run(job | {"result": str(result)}, self.config)
        try:
            return self._read(read_arrays(result, _RESULT))
        except InputError as error:
            raise ColmapError(f"COLMAP's result cannot be read: {error}") from error

    def match(self) -> None:
        """Extract and match features. Raises `ColmapError` if the child process fails."""
        _run(self._job("features"), self.config)

    def _job(self, step: str) -> dict[str, Any]:
        names = ("features", "peak_threshold", "overlap", "init_angle_deg", "init_inliers",
                 "threads", "seed")  # fmt: skip
        (output := self.folder / f"model_{step}").mkdir(exist_ok=True)
        return {
            "step": step,
            "database": str(self.folder / "database.db"),
            "images": str(self.folder / "images"),
            "masks": str(self.folder / "masks"),
            "output": str(output),
            "focal_factor": self.config.focal_guess,
            **{name: getattr(self.config, name) for name in names},
        }

    def _read(self, arrays: dict[str, np.ndarray]) -> Reconstruction:
        """Return a result with frames of the video, and its pixels: centers at integers."""
        focal, _, _, radial = arrays["camera"]
        seen = arrays["observations"]
        numbers = arrays["frames"]
        return Reconstruction(
            frames=np.asarray(self.frames, np.int32)[numbers],
            camera_from_world=arrays["camera_from_world"],
            focal_px=float(focal) * self.reduction,
            radial=float(radial),
            points=arrays["points"],
            error_px=arrays["error_px"] * self.reduction,
            observed_in=np.searchsorted(numbers, seen[:, 0]).astype(np.int32),
            observed=seen[:, 1].astype(np.int32),
            pixels_px=seen[:, 2:] * self.reduction - 0.5,
        )


@contextmanager
def open_scene(
    video: Background,
    frames: tuple[int, ...],
    *,
    height: int,
    width: int,
    config: ColmapConfig,
) -> Iterator[Scene]:
    """Write some frames of a video to a temporary folder, which is removed at the end."""
    import cv2

    require_pycolmap()
    with tempfile.TemporaryDirectory(prefix="egosim_cameras_") as name:
        folder = Path(name)
        for part in ("images", "masks"):
            (folder / part).mkdir()
        for index, frame in enumerate(frames):
            image, mask = f"images/{index:06d}.png", f"masks/{index:06d}.png.png"
            done = cv2.imwrite(str(folder / image), video.gray[frame])
            if not (done and cv2.imwrite(str(folder / mask), video.still[frame])):
                raise OSError(f"The image {folder / image} could not be written.")
        yield Scene(folder, frames, video.reduction, height, width, config)


def _run(job: dict[str, Any], config: ColmapConfig) -> None:
    """Run a step in a child process and its process group; end all of it after the time limit."""
    path = Path(job["output"]).with_suffix(".json")
    path.write_text(json.dumps(job))
    log = path.with_suffix(".log")
    with log.open("wb") as errors:
        child = subprocess.Popen(  # noqa: S603
            [sys.executable, "-P", str(CHILD), str(path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            start_new_session=True,
        )
    try:
        code = child.wait(timeout=config.timeout_s)
    except subprocess.TimeoutExpired:
        raise ColmapError(
            f"COLMAP's step {job['step']} took longer than {config.timeout_s:g} s and was ended. "
            "Give it more time, or a shorter or smaller video. (timeout_s)"
        ) from None
    finally:
        with suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)
        child.wait()
        if child.stdin is not None:
            child.stdin.close()
    if code:
        raise ColmapError(f"COLMAP's step {job['step']} {_ending(code)}: {_last_line(log)}")


def _ending(code: int) -> str:
    """Return how a process ended, in words."""
    if code > 0:
        return f"failed with exit code {code}"
    with suppress(ValueError):
        return f"was ended by {signal.Signals(-code).name}"
    return f"was ended by signal {-code}"


def _last_line(log: Path) -> str:
    """Return the last line of a log that says something, of at most 300 characters."""
    lines = log.read_bytes()[-20_000:].decode("utf-8", "replace").splitlines()
    lines = [line.strip() for line in lines if line.strip() and not line.startswith("    @")]
    return lines[-1][:300] if lines else "no message"
