"""Configuration of an annotation: rules for the clips, and an estimator for each stage.

An estimator is given as `NAME`, or as `NAME=FOLDER` with the weights of a network:

    masks     geometry, sam3=FOLDER, grounded-sam3=FOLDER, grounded-sam2=FOLDER,
              grounded-edgetam=FOLDER                     perception.video.silhouettes, networks
    cameras   ladder, depth-anything-3=FOLDER             perception.video.cameras, networks
    depth     sweep, depth-anything=FOLDER, depth-pro=FOLDER, depth-anything-3=FOLDER, files=FOLDER
    caption   any text, or qwen=FOLDER

Focal length, rung, scale and side are estimated unless they are given.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, cast, get_args

from egosim_jax.annotate.frames import Sampling
from egosim_jax.annotate.prepare import Cutting, check_length
from egosim_jax.io.bounded import quote
from egosim_jax.perception.video.estimates import (
    CameraEstimator,
    Captioner,
    ChosenRung,
    DepthEstimator,
    HandEstimator,
    Segmenter,
)
from egosim_jax.rendering import PriorKind, RendererName
from egosim_jax.types import InputError, check_seed

Side = Literal["auto", "left", "right"]
DType = Literal["float32", "bfloat16", "float16"]
_DEPTH = {
    "sweep": "perception.video.depth:SweptDepth",
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
    """Segmentation network; None: silhouettes are drawn from the hands."""
    captioner: Captioner | None = None
    """Caption network; None: captions come from the recording or the command."""

    def prepare(self) -> None:
        """Fetch missing weights now. Raises `InputError` if a package is missing."""
        from egosim_jax.perception.video.cameras import CameraLadder
        from egosim_jax.perception.video.cameras.colmap import require_pycolmap
        from egosim_jax.perception.video.hands import LandmarkHands
        from egosim_jax.perception.video.hands.litert import fetch_weights

        for settings in vars(self).values():
            if isinstance(settings, LandmarkHands):
                fetch_weights(settings.weights, offline=settings.offline)
            elif isinstance(settings, CameraLadder) and settings.rung not in ("static", "rotation"):
                require_pycolmap()
            elif (check := getattr(settings, "check_installed", None)) is not None:
                check()


@dataclass(frozen=True, kw_only=True)
class AnnotateConfig:
    """Configuration of an annotation; equal configurations give equal annotations."""

    sampling: Sampling = field(default_factory=Sampling)
    """Size, frame rate and length of the clips."""
    cutting: Cutting = field(default_factory=Cutting)
    """Rules for shots, windows and quality."""
    hand_weights: Path | None = None
    """Folder of the hand networks; fetched at first use if not given."""
    offline: bool = False
    """Never download: raise `InputError` if files are missing."""
    side: Side = "auto"
    """Side of all hands; auto: as detected."""
    masks: str = "geometry"
    """Estimator of the silhouettes of hands, arms and objects."""
    detector: Path | None = None
    """Folder of Grounding DINO, which detects the objects for a tracker."""
    device: str = "auto"
    """Device of the networks: cpu, cuda, cuda:N, or auto for the first GPU if there is one."""
    dtype: DType = "float32"
    """Floating-point type of the networks."""
    phrases: tuple[str, ...] = ()
    """Names of the objects to segment, if no network finds them."""
    cameras: str = "ladder"
    """Camera estimator; cameras in the recording take precedence."""
    focal_px: float | None = None
    """Focal length in pixels of the video."""
    rung: ChosenRung | None = None
    """Rung of the camera ladder to use, instead of trying all."""
    depth: str = "sweep"
    """Depth estimator; depth in the recording takes precedence."""
    depth_unit_m: float | None = None
    """Length in meters of a unit of depth files, instead of the recording's or the suffix's."""
    scale: float | None = None
    """Meters per unit of the cameras."""
    camera_height_m: float | None = None
    """Height in meters of the camera above the surface in front of it; determines the scale."""
    state: Literal["first", "fused"] = "first"
    """Scene of the prior: from the first frame, or fused from key frames."""
    caption: str | None = None
    """Caption of all clips, or a network that writes captions."""
    renderer: RendererName = "jax"
    """Renderer of prior and hands."""
    prior: PriorKind = "static"
    """Places of the objects in the prior: as in the first frame, or predicted from the hands."""
    split: str = "train"
    """Value of the metadata column `split`."""
    seed: int = 0
    """Random seed."""

    def __post_init__(self) -> None:
        """Check all settings before any video is read."""
        check_seed(self.seed)
        check_length(self.sampling.num_frames, cut=self.cutting.clips)
        for name, low in (
            ("focal_px", 1),
            ("depth_unit_m", 0),
            ("scale", 0),
            ("camera_height_m", 0),
        ):
            value = getattr(self, name)
            if value is not None and not low < value < 1e6:
                option = name.removesuffix("_px").removesuffix("_m").replace("_", "-")
                raise InputError(f"--{option} is {value:g}: it must be above {low} and finite.")
        if self.scale is not None and self.camera_height_m is not None:
            raise InputError("--scale and --camera-height both determine the scale: choose one.")
        if self.rung is not None and self.rung not in get_args(ChosenRung):
            raise InputError(f"--rung must be one of {', '.join(get_args(ChosenRung))}.")
        if _find(_CAMERAS, self.cameras, "--cameras")[1] and (self.rung or self.focal_px):
            raise InputError(
                "--rung and --focal are options of --cameras ladder, not of a camera network. "
                "Omit them."
            )
        _find(_DEPTH, self.depth, "--depth")
        _check_detector(self.masks, self.detector, "--masks")

    @property
    def depth_files(self) -> Path | None:
        """Folder of given depth maps, if any."""
        name, folder = _find(_DEPTH, self.depth, "--depth")
        return folder if name == "files" else None

    @property
    def caption_text(self) -> str | None:
        """Caption given as text, if any."""
        return None if self._captioner else self.caption

    @property
    def _captioner(self) -> bool:
        return (self.caption or "").partition("=")[0] in _CAPTIONS and "=" in (self.caption or "")

    def build(self) -> Estimators:
        """Return the estimators; this imports heavy libraries, but loads no network yet."""
        from egosim_jax.perception.video.cameras import CameraLadder
        from egosim_jax.perception.video.hands import LandmarkHands

        where: dict[str, Any] = {"device": self.device, "dtype": self.dtype}
        segmenter = captioner = None
        cameras: CameraEstimator = CameraLadder(rung=self.rung)
        name, folder = _find(_CAMERAS, self.cameras, "--cameras")
        if folder is not None:
            cameras = cast(CameraEstimator, _import(_CAMERAS[name])(folder, **where))
        if _find(_MASKS, self.masks, "--masks")[1] is not None:
            segmenter = build_segmenter(self.masks, self.detector, **where)
        if self._captioner:
            name, folder = _find(_CAPTIONS, self.caption or "", "--caption")
            captioner = cast(Captioner, _import(_CAPTIONS[name])(folder, **where))
        name, folder = _find(_DEPTH, self.depth, "--depth")
        if name == "files":  # for frames without a depth map
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


def build_segmenter(
    masks: str, detector: Path | None, *, option: str = "--masks", **where: Any
) -> Segmenter:
    """Return the network of a text such as sam3=FOLDER; `where` has its device and dtype."""
    _check_detector(masks, detector, option)
    name, folder = _find(_MASKS, masks, option)
    folders = [folder] if detector is None else [detector, folder]
    return cast(Segmenter, _import(_MASKS[name])(*folders, **where))


def build_depth(depth: str, *, option: str = "--depth", **where: Any) -> DepthEstimator:
    """Return the depth network of a text such as depth-pro=FOLDER, for single images."""
    name, folder = _find(_DEPTH, depth, option)
    if folder is None or name == "files":
        raise InputError(f"{option} {quote(depth)} must be a network and its folder.")
    return cast(DepthEstimator, _import(_DEPTH[name])(folder, **where))


def _check_detector(masks: str, detector: Path | None, option: str) -> None:
    """Raise `InputError` unless a tracker has a detector, and nothing else has one."""
    name, _ = _find(_MASKS, masks, option)
    if name.startswith("grounded-") != (detector is not None):
        raise InputError(
            f"{option} grounded-...=FOLDER and --detector FOLDER belong together: the detector "
            "finds the objects that the tracker follows. Give both, or neither."
        )


def _find(names: dict[str, str], text: str, option: str) -> tuple[str, Path | None]:
    """Return name and folder of an estimator. Raises `InputError` listing the known ones."""
    name, equals, folder = text.partition("=")
    bare = name in _BARE
    if name not in names or bool(equals) == bare or (equals and not folder):
        shown = ", ".join(n if n in _BARE else f"{n}=FOLDER" for n in names)
        raise InputError(f"{option} {quote(text)} must be one of {shown}.")
    if equals and not Path(folder).is_dir():
        raise InputError(f"{option} {quote(text)}: {quote(folder)} is not a folder.")
    return name, Path(folder) if equals else None


def _import(place: str) -> Any:
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(f"egosim_jax.{module}"), name)
