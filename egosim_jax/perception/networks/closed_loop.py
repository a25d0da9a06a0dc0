"""Pipeline `networks`: perception of generated clips by networks, in the closed loop.

Cameras and hand joints are the generator's inputs. The stages then run in this order:

    HandMasks      draws hands and arms from the joints
    TrackObjects   predicts the motion of the objects, and judges it by the clip's colors
    Segment        segments hands, arms, and the objects named by the state and by phrases
    EstimateDepth  aligns a depth network's maps with the state at static pixels
    keep_changes   keeps depth of moved and new objects, revealed surfaces, and unknown regions

Elsewhere depth is unknown, and the state does not change.

If the networks share the generator's GPU, reserve memory by XLA_PYTHON_CLIENT_MEM_FRACTION.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from egosim_jax.perception.classical import HandMasks, take_action
from egosim_jax.perception.clip.object_motion import TrackObjects
from egosim_jax.perception.networks.align_depth import DepthAlignment
from egosim_jax.perception.networks.checkpoint import DType
from egosim_jax.perception.networks.depth_anything import DepthAnything
from egosim_jax.perception.networks.depth_anything_3 import DepthAnything3
from egosim_jax.perception.networks.depth_pro import DepthPro
from egosim_jax.perception.networks.grounded import (
    Grounded,
    GroundedEdgeTam,
    GroundedSam2,
    GroundedSam3,
)
from egosim_jax.perception.networks.sam3 import Sam3
from egosim_jax.perception.pipeline import Observation, Pipeline, find_interactions
from egosim_jax.perception.registry import register
from egosim_jax.perception.video.estimates import CameraEstimate, DepthEstimator, Segmenter, Verdict
from egosim_jax.rendering import POINT_PX
from egosim_jax.rendering.reference import render
from egosim_jax.state.filter import is_hand
from egosim_jax.types import Action, Clip, InputError, SceneState, View, check_counts
from egosim_jax.types.arrays import IdMaps, Masks

DEPTH_NETWORKS = {
    "depth-anything": DepthAnything,
    "depth-pro": DepthPro,
    "depth-anything-3": DepthAnything3,
}
GROUNDED = {
    "grounded-sam2": GroundedSam2,
    "grounded-sam3": GroundedSam3,
    "grounded-edgetam": GroundedEdgeTam,
}


@dataclass(frozen=True, kw_only=True)
class Segment:
    """Stage that sets object ids, in the state's numbering, and the names of new objects."""

    segmenter: Segmenter
    """Segmentation of objects named by phrases."""
    phrases: tuple[str, ...] = ()
    """Names of objects that the state does not have."""
    hands: tuple[str, ...] = ("hand", "arm")
    """Phrases for hands and arms."""
    min_overlap: float = 0.25
    """Minimum overlap (IoU) with an object of the state, in the best frame."""

    def __call__(
        self, clip: Clip, action: Action, state: SceneState, so_far: Observation
    ) -> Observation:
        """Set `object_ids` and `names`. Hands of an earlier stage stay where nothing is found."""
        cameras, hands = (so_far.require(name, "Segment") for name in ("cameras", "object_ids"))
        objects = [name for name in (*state.names.values(), *self.phrases) if not is_hand(name)]
        if not objects:
            raise InputError(
                "The state has no names of objects: segmentation needs at least one phrase. Name "
                "movable objects, such as --phrases 'cup. book'. (--perception)"
            )
        labels, names = self.segmenter(clip.frames, (*dict.fromkeys(objects), *self.hands))
        view = render(state, cameras, point_px=POINT_PX)
        numbers = self._match(labels, names, view, state)
        ids = hands.copy()
        for number, name in names.items():
            ids[labels == number] = numbers.get(number, -1) if not is_hand(name) else -abs(number)
        new = {n: names[k] for k, n in numbers.items() if n not in state.names}
        names = {**(so_far.names or {}), **new}
        return replace(so_far, object_ids=ids.astype(np.int32), names=names)

    def _match(
        self, labels: IdMaps, names: Mapping[int, str], view: View, state: SceneState
    ) -> dict[int, int]:
        """Return the state's id of each found instance, or a new id.

        Pairs are matched greedily, by overlap plus 1 for the same name.
        """
        numbers = np.unique(view.object_ids[view.object_ids > 0]).tolist()
        pairs = []
        for instance in [n for n, name in names.items() if not is_hand(name)]:
            for number in numbers:
                overlap = _largest_iou(labels == instance, view.object_ids == number)
                if overlap >= self.min_overlap:
                    same = state.names.get(number, "").lower() == names[instance].lower()
                    pairs.append((same + overlap, instance, number))
        matched: dict[int, int] = {}
        for _, instance, number in sorted(pairs, reverse=True):
            if instance not in matched and number not in matched.values():
                matched[instance] = number
        free = 1 + max([0, *state.names, *np.unique(state.object_ids).tolist()])
        for instance, name in sorted(names.items()):
            if instance not in matched and not is_hand(name):
                matched[instance], free = free, free + 1
        return matched


@dataclass(frozen=True, kw_only=True)
class EstimateDepth:
    """Stage that sets depth by a depth network, aligned with the state at static pixels."""

    estimator: DepthEstimator
    """Depth network."""
    alignment: DepthAlignment = field(default_factory=DepthAlignment)
    """Alignment of each frame with the state's rendering."""

    def __call__(
        self, clip: Clip, action: Action, state: SceneState, so_far: Observation
    ) -> Observation:
        """Set `depth_m`; infinite in frames whose depth disagrees with the state's."""
        cameras, ids = (so_far.require(name, "EstimateDepth") for name in ("cameras", "object_ids"))
        estimate = CameraEstimate(
            cameras=cameras,
            metric=True,
            verdict=Verdict(rung="given", reason="cameras of the action", figures={}),
        )
        estimated = self.estimator(clip.frames, ids < 0, estimate, range(len(clip.frames)))
        view = render(state, cameras, point_px=POINT_PX)
        static = (ids == 0) & (view.object_ids == 0)
        maps = zip(estimated.depth_m, view.depth_m, static, strict=True)
        depth = np.stack([self.alignment(*three) for three in maps])
        return replace(so_far, depth_m=depth)


def keep_changes(clip: Clip, action: Action, state: SceneState, so_far: Observation) -> Observation:
    """Set depth to infinite where the state is already correct, and at hands and arms.

    Depth is kept at moved and new objects, at surfaces where a moved object was, and where the
    state has no points.
    """
    cameras, ids, depth, motions, interacted = (
        so_far.require(name, "keep_changes")
        for name in ("cameras", "object_ids", "depth_m", "motions", "interacted_frames")
    )
    view = render(state, cameras, point_px=POINT_PX)
    numbers = np.unique(state.object_ids)
    changed = {*motions, *interacted, *np.setdiff1d(ids[ids > 0], numbers).tolist()}
    kept = np.isin(ids, list(changed)) | ~np.isfinite(view.depth_m)
    kept |= np.isin(view.object_ids, list(changed)) & (ids == 0)
    kept &= ids >= 0
    return replace(so_far, depth_m=np.where(kept, depth, np.inf).astype(np.float32))


@register("networks")
@dataclass(frozen=True, kw_only=True)
class NetworksConfig:
    """Perception by networks for depth, segmentation and tracking, from local checkpoints."""

    reads_ground_truth: ClassVar[bool] = False
    depth: Literal["depth-anything", "depth-pro", "depth-anything-3"] = "depth-anything"
    """Depth network of the pipeline."""
    depth_folder: Path
    """Folder of the depth network's checkpoint."""
    masks: Literal["grounded-sam2", "grounded-sam3", "grounded-edgetam", "sam3"] = "grounded-sam2"
    """Segmentation by Grounding DINO with a tracker, or by SAM 3 alone."""
    masks_folder: Path
    """Folder of the checkpoint of SAM 2, SAM 3 or EdgeTAM."""
    detector_folder: Path | None = None
    """Folder of Grounding DINO, for grounded `masks`."""
    phrases: str = ""
    """Names of objects that the state does not have, separated by full stops."""
    hand_phrases: str = "hand. arm."
    """Phrases for hands and arms, separated by full stops."""
    device: str = "cpu"
    """Device of the networks: cpu, cuda, cuda:N or auto; the generator may fill a GPU."""
    dtype: DType = "float32"
    """Floating-point type of the networks."""
    timeout_s: float = 1800.0
    """Timeout of each network for one clip in seconds."""
    every: int = 16
    """Interval of frames between detections, for grounded `masks`."""
    threshold: float = 0.35
    """Minimum score of a detection, for grounded `masks`."""
    hands: HandMasks = field(default_factory=HandMasks)
    """Drawing of hands and arms, used where segmentation finds nothing."""
    alignment: DepthAlignment = field(default_factory=DepthAlignment)
    """Alignment of depth with the state."""
    motion: TrackObjects = field(default_factory=TrackObjects)
    """Judgment of the predicted motion of objects."""

    def __post_init__(self) -> None:
        """Check the numbers and the phrases, and that each folder fits its network."""
        check_counts({"every": self.every})
        if not all(is_hand(phrase) for phrase in _split(self.hand_phrases)):
            raise InputError(
                f"hand_phrases {self.hand_phrases!r} must each name a hand or an arm. "
                "(--hand-phrases)"
            )
        self._networks()

    def build(self, ground_truth: Mapping[int, Observation] | None = None) -> Pipeline:
        """Return the pipeline; the ground truth is not used.

        Raises `InputError` if a worker's package is not installed.
        """
        depth, masks = self._networks()
        for network in (depth, masks):
            network.check_installed()
        segment = Segment(
            segmenter=masks, phrases=_split(self.phrases), hands=_split(self.hand_phrases)
        )
        estimate = EstimateDepth(estimator=depth, alignment=self.alignment)
        stages = (take_action, self.hands, self.motion, segment, estimate)
        return Pipeline(stages=(*stages, find_interactions, keep_changes))

    def _networks(self) -> tuple[DepthAnything | DepthPro | DepthAnything3, Grounded | Sam3]:
        common = {"device": self.device, "dtype": self.dtype, "timeout_s": self.timeout_s}
        depth = DEPTH_NETWORKS[self.depth](self.depth_folder, **common)
        if self.masks == "sam3":
            return depth, Sam3(self.masks_folder, **common)
        if self.detector_folder is None:
            raise InputError(
                f"masks {self.masks} needs a detector: give the folder of Grounding DINO "
                "(--detector-folder), or use sam3 alone (--masks)."
            )
        grounded = GROUNDED[self.masks]
        return depth, grounded(
            self.detector_folder,
            self.masks_folder,
            every=self.every,
            threshold=self.threshold,
            **common,
        )


def _split(phrases: str) -> tuple[str, ...]:
    """Return the phrases of a text, separated by full stops."""
    return tuple(filter(None, (" ".join(phrase.split()) for phrase in phrases.split("."))))


def _largest_iou(a: Masks, b: Masks) -> float:
    """Return the maximum over frames of the intersection over union of two masks."""
    both, either = (a & b).sum(axis=(1, 2)), (a | b).sum(axis=(1, 2))
    return float((both / np.maximum(either, 1)).max())
