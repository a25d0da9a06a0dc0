"""Configuration of an annotation: rules for clips, and the estimator of each stage.

An estimator is written `NAME`, or `NAME=FOLDER` for a network's weights:

    masks     geometry, sam3=FOLDER, grounded-sam3=FOLDER, grounded-sam2=FOLDER,
              grounded-edgetam=FOLDER                     perception.silhouettes, networks
    cameras   ladder, depth-anything-3=FOLDER             perception.cameras, networks
    depth     sweep, depth-anything=FOLDER, depth-pro=FOLDER, depth-anything-3=FOLDER, files=FOLDER
    caption   any text, or qwen=FOLDER

Every choice that the stages would make can be given instead: focal length, rung, scale, side.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, cast, get_args

from egosim_jax.annotate.frames import Sampling
from egosim_jax.annotate.prepare import Cutting, check_length
from egosim_jax.io.bounded import quote
from egosim_jax.perception.estimates import (
    CameraEstimator,
    Captioner,
    ChosenRung,
    DepthEstimator,
    HandEstimator,
    Segmenter,
)
from egosim_jax.rendering import RendererName
from egosim_jax.types import InputError, check_seed

Side = Literal["auto", "left", "right"]
DType = Literal["float32", "bfloat16", "float16"]
_DEPTH = {
    "sweep": "perception.depth:SweptDepth",
    "depth-anything": "perception.networks.depth_anything:DepthAnything",
    "depth-pro": "perception.networks.depth_pro:DepthPro",
    "depth-anything-3": "perception.networks.depth_anything_3:DepthAnything3",
    "files": "",
}
_MASKS = {
    "geometry": "",
    "sam3": "perception.networks.sam3:Sam3",
    "grounded-sam3": "perception.networks.grounded:GroundedSam3",
    "grounded-sam2": "perception.networks.grounded:GroundedSam2",
    "grounded-edgetam": "perception.networks.grounded:GroundedEdgeTam",
}
_CAMERAS = {
    "ladder": "",
    "depth-anything-3": "perception.networks.depth_anything_3:DepthAnything3Cameras",
}
_CAPTIONS = {"qwen": "perception.networks.qwen3_vl:Qwen3VL"}
_BARE = ("sweep", "geometry", "ladder")
"""Estimators without weights."""


@dataclass(frozen=True, kw_only=True)
class Estimators:
    """Estimators of the stages, built from a configuration."""

    hands: HandEstimator
    cameras: CameraEstimator
    depth: DepthEstimator
    segmenter: Segmenter | None = None
    """None for silhouettes drawn from the hands."""
    captioner: Captioner | None = None
    """None for captions from the recording or the command."""

    def prepare(self) -> None:
        """Fetch what is fetched at the first use; raise `InputError` naming missing packages."""
        from egosim_jax.perception.cameras import CameraLadder
        from egosim_jax.perception.cameras.colmap import require_pycolmap
        from egosim_jax.perception.hands import LandmarkHands
        from egosim_jax.perception.hands.litert import fetch_weights

        for part in vars(self).values():
            if isinstance(part, LandmarkHands):
                fetch_weights(part.weights, offline=part.offline)
            elif isinstance(part, CameraLadder) and part.rung not in ("static", "rotation"):
                require_pycolmap()
            elif (check := getattr(part, "check_installed", None)) is not None:
                check()


@dataclass(frozen=True, kw_only=True)
class AnnotateConfig:
    """Configuration of an annotation; equal ones make equal annotations."""

    sampling: Sampling = field(default_factory=Sampling)
    """Size, rate and length of the clips."""
    cutting: Cutting = field(default_factory=Cutting)
    """Shots, windows and quality."""
    hand_weights: Path | None = None
    """Folder of the hand networks; fetched at first use if not given."""
    offline: bool = False
    """Refuse to fetch anything."""
    side: Side = "auto"
    """Side of all hands; auto: as the landmarks say."""
    masks: str = "geometry"
    """Silhouettes of hands, arms and objects."""
    detector: Path | None = None
    """Folder of Grounding DINO, which finds what a tracker follows."""
    device: str = "auto"
    """Device of the networks: cpu, cuda, cuda:N, or auto for the first GPU if there is one."""
    dtype: DType = "float32"
    """Floating-point type of the networks."""
    phrases: tuple[str, ...] = ()
    """Objects to segment, where no network names them."""
    cameras: str = "ladder"
    """Camera estimator; the recording's cameras are used instead where it has some."""
    focal_px: float | None = None
    """Focal length in pixels of the video."""
    rung: ChosenRung | None = None
    """Rung of the ladder of camera estimation to use instead of trying them."""
    depth: str = "sweep"
    """Depth estimator; the recording's depth is used instead where it has some."""
    scale: float | None = None
    """Meters per unit of the cameras."""
    camera_height_m: float | None = None
    """Height of the camera above the surface in front of it, from which the scale follows."""
    state: Literal["first", "fused"] = "first"
    """Scene of the prior: seen in the first frame alone, or fused from key frames."""
    caption: str | None = None
    """Caption, or a network that writes it."""
    renderer: RendererName = "jax"
    """Renderer of prior and hands."""
    split: str = "train"
    """Value of the column split."""
    seed: int = 0
    """Seed of what is random."""

    def __post_init__(self) -> None:
        """Check everything that can be checked before a video is read."""
        check_seed(self.seed)
        check_length(self.sampling.num_frames, cut=self.cutting.clips)
        for name, low in (("focal_px", 1), ("scale", 0), ("camera_height_m", 0)):
            value = getattr(self, name)
            if value is not None and not low < value < 1e6:
                option = name.removesuffix("_px").removesuffix("_m").replace("_", "-")
                raise InputError(f"--{option} is {value:g}: it must be above {low} and finite.")
        if self.scale is not None and self.camera_height_m is not None:
            raise InputError("--scale and --camera-height both give the scale: choose one.")
        if self.rung is not None and self.rung not in get_args(ChosenRung):
            raise InputError(f"--rung must be one of {', '.join(get_args(ChosenRung))}.")
        if _find(_CAMERAS, self.cameras, "--cameras")[1] and (self.rung or self.focal_px):
            raise InputError(
                "--rung and --focal are options of --cameras ladder: a network that estimates "
                "cameras takes neither. Omit them."
            )
        _find(_DEPTH, self.depth, "--depth")
        name, _ = _find(_MASKS, self.masks, "--masks")
        if name.startswith("grounded-") != (self.detector is not None):
            raise InputError(
                "--masks grounded-...=FOLDER and --detector FOLDER belong together: the detector "
                "finds what the tracker follows."
            )

    @property
    def depth_files(self) -> Path | None:
        """Folder of depth maps made by others."""
        name, folder = _find(_DEPTH, self.depth, "--depth")
        return folder if name == "files" else None

    @property
    def caption_text(self) -> str | None:
        """Caption that was given as text."""
        return None if self._captioner else self.caption

    @property
    def _captioner(self) -> bool:
        return (self.caption or "").partition("=")[0] in _CAPTIONS and "=" in (self.caption or "")

    def build(self) -> Estimators:
        """Return the estimators; heavy libraries are imported here, networks loaded later."""
        from egosim_jax.perception.cameras import CameraLadder
        from egosim_jax.perception.hands import LandmarkHands

        where: dict[str, Any] = {"device": self.device, "dtype": self.dtype}
        segmenter = captioner = None
        cameras: CameraEstimator = CameraLadder(rung=self.rung)
        name, folder = _find(_CAMERAS, self.cameras, "--cameras")
        if folder is not None:
            cameras = cast(CameraEstimator, _import(_CAMERAS[name])(folder, **where))
        name, folder = _find(_MASKS, self.masks, "--masks")
        if folder is not None:
            folders = [folder] if self.detector is None else [self.detector, folder]
            segmenter = cast(Segmenter, _import(_MASKS[name])(*folders, **where))
        if self._captioner:
            name, folder = _find(_CAPTIONS, self.caption or "", "--caption")
            captioner = cast(Captioner, _import(_CAPTIONS[name])(folder, **where))
        name, folder = _find(_DEPTH, self.depth, "--depth")
        if name == "files":  # frames without a map are estimated
            name, folder = "sweep", None
        kind = _import(_DEPTH[name])
        depth = kind() if folder is None else kind(folder, **where)
        return Estimators(
            hands=LandmarkHands(weights=self.hand_weights, offline=self.offline),
            cameras=cameras,
            depth=cast(DepthEstimator, depth),
            segmenter=segmenter,
            captioner=captioner,
        )


def _find(known: dict[str, str], text: str, option: str) -> tuple[str, Path | None]:
    """Return name and folder of an estimator. Raises `InputError` naming all that are known."""
    name, equals, folder = text.partition("=")
    bare = name in _BARE
    if name not in known or bool(equals) == bare or (equals and not folder):
        shown = ", ".join(n if n in _BARE else f"{n}=FOLDER" for n in known)
        raise InputError(f"{option} {quote(text)} must be one of {shown}.")
    if equals and not Path(folder).is_dir():
        raise InputError(f"{option} {quote(text)}: {quote(folder)} is not a folder.")
    return name, Path(folder) if equals else None


def _import(place: str) -> Any:
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(f"egosim_jax.{module}"), name)
