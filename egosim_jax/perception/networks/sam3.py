"""SAM 3: segmentation and tracking of all objects named by phrases, by one network.

Checkpoint: facebook/sam3 (SAM license; access on request). Its processor needs torchvision, and
its non-maximum suppression needs a compiled kernel from a hub; this module replaces both. Source:
Carion et al., SAM 3: Segment Anything with Concepts, 2025.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from egosim_jax.perception.networks.checkpoint import Network, load_network
from egosim_jax.perception.networks.grounding_dino import clean_phrases
from egosim_jax.perception.networks.pixels import PixelSettings, resize_maps
from egosim_jax.perception.networks.tracking import SAM3_PIXELS, new_session
from egosim_jax.perception.networks.worker import Run
from egosim_jax.perception.video.estimates import HandTracks
from egosim_jax.state.filter import is_hand
from egosim_jax.types.arrays import IdMaps, Video

if TYPE_CHECKING:
    import torch

MAX_TOKENS = 32
"""Length of a phrase in tokens, as in the network's training."""


@dataclass(frozen=True)
class Sam3(Network):
    """Segmentation and tracking of named objects by SAM 3; a `Segmenter`."""

    needs: ClassVar[str] = "SAM 3 (facebook/sam3)"
    model_types: ClassVar[tuple[str, ...]] = ("sam3_video",)
    files: ClassVar[tuple[str, ...]] = ("tokenizer_config.json",)

    def __call__(
        self, frames: Video, phrases: Sequence[str], hands: HandTracks | None = None
    ) -> tuple[IdMaps, Mapping[int, str]]:
        """Return instance ids and their names; ids of hands and arms are negative.

        Known hands are not used, because the network's prompts are phrases.
        """
        phrases = clean_phrases(phrases)
        reply, instances = self.ask({"frames": frames}, phrases=phrases)
        names = {
            (-1 if is_hand(phrase) else 1) * number: phrase
            for number, phrase in enumerate(instances, start=1)
        }
        signs = np.array([0, *(np.sign(number) for number in names)], np.int32)
        return reply["labels"] * signs[reply["labels"]], names


def load(folder: str, device: str, dtype: str) -> Run:
    """Load the network and its tokenizer in a worker."""
    import torch
    from transformers import CLIPTokenizer, Sam3VideoInferenceSession, Sam3VideoModel
    from transformers.models.sam3_video import modeling_sam3_video

    modeling_sam3_video.cv_utils_kernel = MaskTools()
    network: Any = load_network(Sam3VideoModel, folder, device, dtype)
    tokenizer: Any = CLIPTokenizer.from_pretrained(folder, local_files_only=True)
    pixels = PixelSettings.read(Path(folder), SAM3_PIXELS)

    def run(arrays: Mapping[str, np.ndarray], options: Mapping[str, Any]):
        frames = arrays["frames"]
        height, width = frames.shape[1:3]
        session = new_session(Sam3VideoInferenceSession, network, frames, pixels)
        for phrase in options["phrases"]:
            number = session.add_prompt(phrase)
            text = tokenizer(
                phrase, return_tensors="pt", padding="max_length", max_length=MAX_TOKENS,
                truncation=True,
            ).to(network.device)  # fmt: skip
            session.prompt_input_ids[number] = text["input_ids"]
            session.prompt_attention_masks[number] = text["attention_mask"]
        labels = np.zeros(frames.shape[:3], np.int32)
        numbers: dict[int, int] = {}
        phrase_of: dict[int, str] = {}
        with torch.inference_mode():
            for output in network.propagate_in_video_iterator(session):
                for instance, mask in visible_masks(output, session, (height, width)):
                    label = numbers.setdefault(instance, len(numbers) + 1)
                    labels[output.frame_idx][mask] = label
                for instance, prompt in session.obj_id_to_prompt_id.items():
                    phrase_of[instance] = session.prompts[prompt]  # before it forgets the object
        return {"labels": labels}, [phrase_of[number] for number in numbers]

    return run


def visible_masks(output: Any, session: Any, size: tuple[int, int]) -> list[tuple[int, np.ndarray]]:
    """Return the objects of a frame and their masks `h w`, in ascending order of tracker score.

    Where masks overlap, the last one wins. Objects that the network suppressed are omitted.
    """
    hidden = {*(output.suppressed_obj_ids or ()), *session.hotstart_removed_obj_ids}
    scores = output.obj_id_to_tracker_score or {}
    masks = []
    for number in sorted(output.obj_id_to_mask, key=lambda n: (float(scores.get(n, 0.0)), n)):
        if number not in hidden:
            mask = resize_maps(output.obj_id_to_mask[number], size)[0] > 0
            if mask.any():
                masks.append((number, mask.cpu().numpy()))
    return masks


class MaskTools:
    """CPU version of the two kernel functions that SAM 3's postprocessing calls."""

    @staticmethod
    def generic_nms(
        ious: torch.Tensor, scores: torch.Tensor, threshold: float, *, use_iou_matrix: bool
    ) -> torch.Tensor:
        """Return the indices of detections without too much overlap with a higher score."""
        import torch

        kept: list[int] = []
        overlaps = ious.cpu().numpy()
        for index in torch.argsort(scores, descending=True, stable=True).tolist():
            if not kept or overlaps[index, kept].max() <= threshold:
                kept.append(index)
        return torch.tensor(kept, dtype=torch.long, device=ious.device)

    @staticmethod
    def cc_2d(masks: torch.Tensor, *, get_counts: bool) -> tuple[torch.Tensor, torch.Tensor]:
        """Return label and area in pixels of the connected component at each pixel of each mask."""
        import cv2
        import torch

        labels = np.zeros(masks.shape, np.int32)
        areas = np.zeros(masks.shape, np.int32)
        for place in np.ndindex(*masks.shape[:-2]):
            components: Any = cv2.connectedComponentsWithStats(
                masks[place].cpu().numpy(), connectivity=8
            )
            labels[place] = components[1]
            sizes = components[2][:, cv2.CC_STAT_AREA]
            areas[place] = np.where(components[1] > 0, sizes[components[1]], 0)
        return torch.from_numpy(labels).to(masks.device), torch.from_numpy(areas).to(masks.device)
