"""Grounding DINO: boxes of objects named by phrases, in single images.

Checkpoints: IDEA-Research/grounding-dino-tiny and -base (Apache-2.0). Source: Liu et al.,
Grounding DINO, 2023.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from jaxtyping import Float

from egosim_jax.perception.networks.checkpoint import Network, load_network
from egosim_jax.perception.networks.worker import Run
from egosim_jax.state.filter import box_iou
from egosim_jax.types import InputError
from egosim_jax.types.arrays import Video

if TYPE_CHECKING:
    import torch

MAX_PHRASE = 80
"""Maximum length of a phrase in characters."""


@dataclass(frozen=True, kw_only=True)
class Detection:
    """Detected object in one frame."""

    phrase: str
    """Phrase that names the object."""
    score: float
    """Confidence from 0 to 1."""
    box_px: tuple[float, float, float, float]
    """First column and row, last column and row, in pixels."""


@dataclass(frozen=True)
class GroundingDino(Network):
    """Detector of objects named by phrases."""

    needs: ClassVar[str] = "Grounding DINO (IDEA-Research/grounding-dino-tiny)"
    model_types: ClassVar[tuple[str, ...]] = ("grounding-dino",)
    files: ClassVar[tuple[str, ...]] = ("preprocessor_config.json", "tokenizer_config.json")

    _: KW_ONLY
    threshold: float = 0.35
    """Minimum score of a detection."""
    max_overlap: float = 0.7
    """Maximum overlap (IoU) of two detections of a phrase; the lower score is dropped."""

    def __call__(self, frames: Video, phrases: Sequence[str]) -> list[list[Detection]]:
        """Return the detections in each frame, best first."""
        phrases = clean_phrases(phrases)
        reply, _ = self.ask({"frames": frames}, phrases=phrases)
        detections: list[list[Detection]] = []
        for scores, boxes in zip(reply["scores"], reply["boxes_px"], strict=True):
            best = scores.argmax(axis=1)
            kept: list[Detection] = []
            for query in np.argsort(-scores.max(axis=1), kind="stable"):
                score = float(scores[query, best[query]])
                if score <= self.threshold:
                    break
                left, top, right, bottom = (float(value) for value in boxes[query])
                one = Detection(
                    phrase=phrases[best[query]],
                    score=score,
                    box_px=(left, top, right, bottom),
                )
                same = [other for other in kept if other.phrase == one.phrase]
                if all(box_iou(one.box_px, o.box_px) <= self.max_overlap for o in same):
                    kept.append(one)
            detections.append(kept)
        return detections


def clean_phrases(phrases: Sequence[str]) -> list[str]:
    """Return unique phrases in lower case without full stops.

    Raises `InputError` without any phrase, and for a phrase that is too long.
    """
    clean = [" ".join(p.lower().replace(".", " ").split()) for p in phrases]
    unique = list(dict.fromkeys(filter(None, clean)))
    if not unique or max(map(len, unique)) > MAX_PHRASE:
        raise InputError(
            f"{len(unique)} phrases, of up to {max(map(len, unique), default=0)} characters: there "
            f"must be at least one phrase, of at most {MAX_PHRASE}. Name the objects. (--phrases)"
        )
    return unique


def load(folder: str, device: str, dtype: str) -> Run:
    """Load the network, its image processor and its tokenizer in a worker."""
    import torch
    from transformers import (
        BertTokenizer,
        GroundingDinoForObjectDetection,
        GroundingDinoImageProcessorPil,
        GroundingDinoProcessor,
    )

    network = load_network(GroundingDinoForObjectDetection, folder, device, dtype)
    images = GroundingDinoImageProcessorPil.from_pretrained(folder, local_files_only=True)
    tokenizer: Any = BertTokenizer.from_pretrained(folder, local_files_only=True)
    processor: Any = GroundingDinoProcessor(images, tokenizer)
    full_stop = tokenizer.convert_tokens_to_ids(".")
    max_tokens = network.config.max_text_len

    def count(phrase: str) -> int:
        return len(tokenizer.tokenize(phrase))

    def run(arrays: Mapping[str, np.ndarray], options: Mapping[str, Any]):
        scores, boxes = [], []
        for frame in arrays["frames"]:
            texts = groups(options["phrases"], count, max_tokens)
            parts = [_detect(frame, group) for group in texts]
            filled = np.zeros((sum(len(s) for s, _ in parts), len(options["phrases"])))
            row = column = 0
            for block, _ in parts:
                height, width = block.shape
                filled[row : row + height, column : column + width] = block
                row, column = row + height, column + width
            scores.append(filled)
            boxes.append(np.concatenate([box for _, box in parts]))
        return {"scores": np.stack(scores), "boxes_px": np.stack(boxes)}, None

    def _detect(frame: np.ndarray, phrases: Sequence[str]):
        inputs = processor(images=frame, text=". ".join(phrases) + ".", return_tensors="pt")
        inputs = inputs.to(network.device)
        inputs["pixel_values"] = inputs["pixel_values"].to(network.dtype)
        with torch.inference_mode():
            output = network(**inputs)
        scores = output.logits[0].float().sigmoid()
        scored = phrase_scores(scores, inputs["input_ids"][0], full_stop)
        height, width = frame.shape[:2]
        center, size = output.pred_boxes[0].float().cpu().split(2, dim=-1)
        corners = torch.cat([center - size / 2, center + size / 2], dim=-1)
        return scored.cpu().numpy(), (corners * torch.tensor([width, height] * 2)).numpy()

    return run


def groups(
    phrases: Sequence[str], count: Callable[[str], int], max_tokens: int
) -> Iterator[Sequence[str]]:
    """Yield the phrases in groups whose texts have at most `max_tokens` tokens.

    A text has one token at its start, a full stop after each phrase, and one token at its end.
    """
    group: list[str] = []
    for phrase in phrases:
        if group and 2 + sum(count(p) + 1 for p in (*group, phrase)) > max_tokens:
            yield group
            group = []
        group.append(phrase)
    yield group


def phrase_scores(
    tokens: torch.Tensor, text: torch.Tensor, full_stop: int
) -> Float[torch.Tensor, "q p"]:
    """Return the score of each phrase for each query: the maximum over the phrase's tokens.

    `tokens` has the scores `q t` of a text's tokens. The text starts with one special token, and
    each phrase ends with a full stop.
    """
    import torch

    ends = torch.nonzero(text == full_stop)[:, 0].tolist()
    starts = [1, *(end + 1 for end in ends[:-1])]
    columns = [tokens[:, a:b].amax(dim=1) for a, b in zip(starts, ends, strict=True)]
    return torch.stack(columns, dim=1)
