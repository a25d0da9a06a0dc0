"""Qwen3-VL: caption of a video, and names of the objects that the wearer moves.

Checkpoints: Qwen/Qwen3-VL-2B-Instruct, -4B- and -8B- (Apache-2.0). The input is key frames as
images, because the video processor needs torchvision. Source: Qwen team, Qwen3-VL technical report,
2025.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar

import numpy as np

from egosim_jax.perception.networks.checkpoint import Network, load_network
from egosim_jax.perception.networks.worker import NetworkError, Run
from egosim_jax.state.filter import is_hand
from egosim_jax.types import InputError
from egosim_jax.types.arrays import Video

MAX_CAPTION = 600
"""Maximum length of a caption in characters."""
MAX_NAMES, MAX_NAME = 12, 40
"""Maximum number of object names, and maximum length of a name in characters."""
PROMPT = (
    "These are {count} frames, in order, of a video that a person recorded with a camera on the "
    "head. Describe in one or two sentences what the hands do, with which objects, and where. Then "
    "name each object that the hands touch or move, as short as is unambiguous (color and noun). "
    'Reply with JSON only: {{"caption": "...", "objects": ["...", "..."]}}'
)
IMAGE = "<|vision_start|><|image_pad|><|vision_end|>"
TURN = "<|im_start|>user\n{content}<|im_end|>\n<|im_start|>assistant\n"
"""Chat template of the instruction-tuned checkpoints for one user turn."""
PAD = "<|image_pad|>"
ARTICLE = re.compile(r"^(a|an|the|some)\s+")


@dataclass(frozen=True)
class Qwen3VL(Network):
    """Captions and names of objects by Qwen3-VL; a `Captioner`."""

    needs: ClassVar[str] = "Qwen3-VL (Qwen/Qwen3-VL-4B-Instruct)"
    model_types: ClassVar[tuple[str, ...]] = ("qwen3_vl",)
    files: ClassVar[tuple[str, ...]] = ("preprocessor_config.json", "tokenizer_config.json")

    _: KW_ONLY
    images: int = 8
    """Number of input frames, evenly spaced."""
    max_new_tokens: int = 256
    """Maximum length of a reply in tokens."""
    prompt: str = PROMPT
    """Question; {count} is the number of frames."""

    def __call__(self, frames: Video) -> tuple[str, tuple[str, ...]]:
        """Return the caption and the names of moved objects.

        Raises `NetworkError` for a reply that has no caption.
        """
        return parse_reply(self.reply(frames))

    def reply(self, frames: Video) -> str:
        """Return the network's raw reply to the question about a video."""
        count = min(self.images, len(frames))
        chosen = np.linspace(0, len(frames) - 1, count).round().astype(int)
        try:
            question = self.prompt.format(count=count)
        except (KeyError, IndexError, ValueError) as error:
            raise InputError(
                f"The question cannot be filled in: {error!r}. Only {{count}} is replaced; write "
                "other braces twice. (--prompt)"
            ) from error
        _, text = self.ask(
            {"frames": frames[chosen]}, question=question, max_new_tokens=self.max_new_tokens
        )
        return text


def parse_reply(text: str) -> tuple[str, tuple[str, ...]]:
    """Return the caption and the object names in a reply, bounded and each on one line.

    Names are unique, in lower case and without articles. Names of hands are dropped. Raises
    `NetworkError` if the reply has no caption.
    """
    reply = _json_object(text)
    caption = reply.get("caption")
    if not isinstance(caption, str) or not (caption := _one_line(caption, MAX_CAPTION)):
        raise NetworkError(
            f"Qwen3-VL replied without a caption: {_one_line(text, 200)!r}. Give a caption "
            "(--caption), or use a larger checkpoint."
        )
    objects = reply.get("objects")
    names = [n for n in objects if isinstance(n, str)] if isinstance(objects, list) else []
    clean = [ARTICLE.sub("", _one_line(name, MAX_NAME).lower()).strip(" .") for name in names]
    kept = [name for name in dict.fromkeys(clean) if name and not is_hand(name)]
    return caption, tuple(kept[:MAX_NAMES])


def _json_object(text: str) -> dict[str, Any]:
    """Return the first JSON object with a caption in a text, or an empty one."""
    decoder = json.JSONDecoder()
    for start in (match.start() for match in re.finditer(r"\{", text)):
        try:
            value, _ = decoder.raw_decode(text, start)
        except (ValueError, RecursionError):
            continue
        if isinstance(value, dict) and "caption" in value:
            return value
    return {}


def _one_line(text: str, limit: int) -> str:
    """Return text on one line, without unprintable characters, cut between words at a limit."""
    line = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return line if len(line) <= limit else line[:limit].rpartition(" ")[0] or line[:limit]


def load(folder: str, device: str, dtype: str) -> Run:
    """Load the network, its image processor and its tokenizer in a worker."""
    import torch
    from transformers import (
        Qwen2Tokenizer,
        Qwen2VLImageProcessorPil,
        Qwen3VLForConditionalGeneration,
    )

    network: Any = load_network(Qwen3VLForConditionalGeneration, folder, device, dtype)
    processor = Qwen2VLImageProcessorPil.from_pretrained(folder, local_files_only=True)
    tokenizer: Any = Qwen2Tokenizer.from_pretrained(folder, local_files_only=True)

    def run(arrays: Mapping[str, np.ndarray], options: Mapping[str, Any]):
        images: Any = processor(images=list(arrays["frames"]), return_tensors="pt")
        grid = images["image_grid_thw"]
        tokens = (grid.prod(dim=1) // processor.merge_size**2).tolist()
        text = tokenizer(chat(options["question"], tokens), return_tensors="pt")
        pad = tokenizer.convert_tokens_to_ids(PAD)
        inputs = {
            "input_ids": text["input_ids"],
            "attention_mask": text["attention_mask"],
            "mm_token_type_ids": (text["input_ids"] == pad).int(),
            "pixel_values": images["pixel_values"].to(network.dtype),
            "image_grid_thw": grid,
        }
        with torch.inference_mode():
            output = network.generate(
                **{name: value.to(network.device) for name, value in inputs.items()},
                max_new_tokens=options["max_new_tokens"],
                do_sample=False,
            )
        new = output[:, text["input_ids"].shape[1] :]
        return {}, tokenizer.batch_decode(new, skip_special_tokens=True)[0]

    return run


def chat(question: str, image_tokens: Sequence[int]) -> str:
    """Return the text of one turn: images with their numbers of tokens, and a question."""
    shown = "".join(IMAGE.replace(PAD, count * PAD) for count in image_tokens)
    clean = question.replace("<|", "< |")  # a question must not end its turn
    return TURN.format(content=shown + clean)
