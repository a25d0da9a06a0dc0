"""Perception of generated clips by networks: the pipeline `networks` of the closed loop.

Cameras and hand joints are those that the generator was given. A segmenter finds what the state's
names and the phrases given name, hands and arms too; a depth network's maps are aligned with the
state where nothing has moved; objects are followed by features inside their masks. What is fused
into the state is what changed: moved and new objects, the surfaces that they hid, and what the
state did not know. Elsewhere depth is unknown, and the state stays as it was.

With the networks on the generator's GPU, leave memory to them: XLA_PYTHON_CLIENT_MEM_FRACTION.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Int32

from egosim_jax.perception.classical import HandMasks, take_action
from egosim_jax.perception.estimates import (
    CameraEstimate,
    DepthEstimator,
    Segmenter,
    Verdict,
)
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
from egosim_jax.perception.networks.mask_tracking import TrackMasks
from egosim_jax.perception.networks.sam3 import Sam3
from egosim_jax.perception.pipeline import Observation, Pipeline, find_interactions
from egosim_jax.perception.registry import register
from egosim_jax.rendering.reference import render
from egosim_jax.state.filter import is_hand
from egosim_jax.types import Action, Clip, InputError, SceneState, View, check_counts

POINT_PX = 2
"""Size of the points with which the state is rendered, in pixels."""
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
    """Segmentation of what phrases name."""
    phrases: tuple[str, ...] = ()
    """Names of objects besides those of the state."""
    hands: tuple[str, ...] = ("hand", "arm")
    """Phrases for hands and arms."""
    min_overlap: float = 0.25
    """Least overlap (IoU), in the frame where it is largest, with the object of the state."""

    def __call__(
        self, clip: Clip, action: Action, state: SceneState, so_far: Observation
    ) -> Observation:
        """Set `object_ids` and `names`; where nothing is found, hands that were set before stay."""
        cameras, hands = (so_far.require(name, "Segment") for name in ("cameras", "object_ids"))
        objects = [name for name in (*state.names.values(), *self.phrases) if not is_hand(name)]
        if not objects:
            raise InputError(
                "The state has no names of objects: segmentation needs at least one phrase. Name "
                "what may be moved, such as --phrases 'cup. book'. (--perception)"
            )
        found, names = self.segmenter(clip.frames, (*dict.fromkeys(objects), *self.hands))
        view = render(state, cameras, point_px=POINT_PX)
        numbers = self._match(found, names, view, state)
        ids = hands.copy()
        for number, name in names.items():
            ids[found == number] = numbers.get(number, -1) if not is_hand(name) else -abs(number)
        new = {n: names[k] for k, n in numbers.items() if n not in state.names}
        return replace(so_far, object_ids=ids.astype(np.int32), names=new)

    def _match(
        self,
        found: Int32[np.ndarray, "f h w"],
        names: Mapping[int, str],
        view: View,
        state: SceneState,
    ) -> dict[int, int]:
        """Return the state's id of each found instance, the best pairs first; new ids for others.

        An object of the same name is preferred to one that overlaps as much.
        """
        known = np.unique(view.object_ids[view.object_ids > 0]).tolist()
        pairs = []
        for instance in [n for n, name in names.items() if not is_hand(name)]:
            for number in known:
                overlap = _largest_iou(found == instance, view.object_ids == number)
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
    """Stage that sets depth by a depth network, aligned with the state where nothing has moved."""

    estimator: DepthEstimator
    """Network that estimates depth."""
    alignment: DepthAlignment = field(default_factory=DepthAlignment)
    """Alignment of each frame with the state's rendering."""

    def __call__(
        self, clip: Clip, action: Action, state: SceneState, so_far: Observation
    ) -> Observation:
        """Set `depth_m`; infinite in frames whose depth does not agree with the state's."""
        cameras, ids = (so_far.require(name, "EstimateDepth") for name in ("cameras", "object_ids"))
        estimate = CameraEstimate(
            cameras=cameras,
            metric=True,
            verdict=Verdict(rung="given", reason="cameras of the action", figures={}),
        )
        found = self.estimator(clip.frames, ids < 0, estimate, range(len(clip.frames)))
        view = render(state, cameras, point_px=POINT_PX)
        static = (ids == 0) & (view.object_ids == 0)
        maps = zip(found.depth_m, view.depth_m, static, strict=True)
        depth = np.stack([self.alignment(*three) for three in maps])
        return replace(so_far, depth_m=depth)


def keep_changes(clip: Clip, action: Action, state: SceneState, so_far: Observation) -> Observation:
    """Set depth to infinite where the state already has what is seen, and at hands and arms.

    Kept are objects that moved or are new, the surfaces where a moved object was, and what the
    state has no points for.
    """
    cameras, ids, depth, motions, interacted = (
        so_far.require(name, "keep_changes")
        for name in ("cameras", "object_ids", "depth_m", "motions", "interacted_frames")
    )
    view = render(state, cameras, point_px=POINT_PX)
    known = np.unique(state.object_ids)
    changed = {*motions, *interacted, *np.setdiff1d(ids[ids > 0], known).tolist()}
    kept = np.isin(ids, list(changed)) | ~np.isfinite(view.depth_m)
    kept |= np.isin(view.object_ids, list(changed)) & (ids == 0)
    kept &= ids >= 0
    return replace(so_far, depth_m=np.where(kept, depth, np.inf).astype(np.float32))


@register("networks")
@dataclass(frozen=True, kw_only=True)
class NetworksConfig:
    """Perception by networks: depth, segmentation and tracking, from local checkpoints."""

    depth: Literal["depth-anything", "depth-pro", "depth-anything-3"] = "depth-anything"
    """Depth network of the pipeline."""
    depth_folder: Path
    """Folder of its checkpoint."""
    masks: Literal["grounded-sam2", "grounded-sam3", "grounded-edgetam", "sam3"] = "grounded-sam2"
    """Segmentation: Grounding DINO with a tracker, or SAM 3 alone."""
    masks_folder: Path
    """Folder of the checkpoint of SAM 2, SAM 3 or EdgeTAM."""
    detector_folder: Path | None = None
    """Folder of Grounding DINO, if `masks` is grounded."""
    phrases: str = ""
    """Names of objects besides those of the state, with full stops in between."""
    hand_phrases: str = "hand. arm."
    """Phrases for hands and arms."""
    device: str = "cpu"
    """Device of the networks: cpu, cuda, cuda:N or auto; the generator may need all of a GPU."""
    dtype: DType = "float32"
    """Floating-point type of the networks."""
    timeout_s: float = 1800.0
    """Longest time of a network for one clip in seconds."""
    every: int = 16
    """Objects are looked for in every so many frames, if `masks` is grounded."""
    threshold: float = 0.35
    """Least score of a detection, if `masks` is grounded."""
    hands: HandMasks = field(default_factory=HandMasks)
    """Drawing of hands and arms where segmentation finds nothing."""
    alignment: DepthAlignment = field(default_factory=DepthAlignment)
    """Alignment of depth with the state."""
    tracking: TrackMasks = field(default_factory=TrackMasks)
    """Tracking of objects inside their masks."""

    def __post_init__(self) -> None:
        """Check the numbers, the phrases, and that the folders are those of the networks chosen."""
        check_counts({"every": self.every})
        if not all(is_hand(phrase) for phrase in _split(self.hand_phrases)):
            raise InputError(
                f"hand_phrases {self.hand_phrases!r} must each name a hand or an arm. "
                "(--hand-phrases)"
            )
        self._networks()

    def build(self, ground_truth: Mapping[int, Observation] | None = None) -> Pipeline:
        """Return the pipeline; the ground truth is not used.

        Raises `InputError` if a package of the workers is not installed.
        """
        depth, masks = self._networks()
        for network in (depth, masks):
            network.check_installed()
        segment = Segment(
            segmenter=masks, phrases=_split(self.phrases), hands=_split(self.hand_phrases)
        )
        estimate = EstimateDepth(estimator=depth, alignment=self.alignment)
        stages = (take_action, self.hands, segment, estimate, self.tracking)
        return Pipeline(stages=(*stages, find_interactions, keep_changes))

    def _networks(
        self,
    ) -> tuple[DepthAnything | DepthPro | DepthAnything3, Grounded | Sam3]:
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
    """Return the phrases of a text that has full stops in between."""
    return tuple(filter(None, (" ".join(phrase.split()) for phrase in phrases.split("."))))


def _largest_iou(a: Bool[np.ndarray, "f h w"], b: Bool[np.ndarray, "f h w"]) -> float:
    """Return the largest intersection over union of two masks in one frame."""
    both, either = (a & b).sum(axis=(1, 2)), (a | b).sum(axis=(1, 2))
    return float((both / np.maximum(either, 1)).max())
