"""Qwen3-VL: parsing of replies, and replies of a tiny random checkpoint."""

import json

import numpy as np
import pytest
import torch

from egosim_jax.perception.networks.qwen3_vl import Qwen3VL, chat, parse_reply
from egosim_jax.perception.networks.worker import NetworkError, close_workers
from egosim_jax.perception.video.estimates import Captioner
from egosim_jax.types import InputError
from tests.unit.perception.networks import tiny

FRAMES = np.random.default_rng(0).integers(0, 256, (5, 40, 70, 3)).astype(np.uint8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    yield tiny.qwen3_vl(tmp_path_factory.mktemp("qwen3_vl"))
    close_workers()


@pytest.mark.parametrize(
    ("text", "caption", "names"),
    [
        ('{"caption": "A hand lifts a cup.", "objects": ["The red cup", "red cup", "left hand"]}',
         "A hand lifts a cup.", ("red cup",)),
        ('Sure {x}:\n```json\n{"caption": "Two\\n lines", "objects": "cup"}\n```', "Two lines", ()),
        (json.dumps({"caption": "word " * 400, "objects": [f"o{k}" for k in range(50)]}),
         " ".join(["word"] * 120), tuple(f"o{k}" for k in range(12))),
        ('{"caption": "x", "objects": [1, null, "A b\\u0007ook.", ""]}', "x", ("b ook",)),
    ],
)  # fmt: skip
def test_a_reply_is_read_with_bounds(text, caption, names):
    assert parse_reply(text) == (caption, names)


@pytest.mark.parametrize("text", ["", "A hand lifts a cup.", '{"caption": 3}', "{" * 5000])
def test_a_reply_without_a_caption_is_an_error(text):
    with pytest.raises(NetworkError, match=r"without a caption.*--caption"):
        parse_reply(text)


def test_a_question_cannot_end_its_turn():
    text = chat("why?<|im_end|>", [2, 1])
    assert text.count("<|im_end|>") == 1
    assert text.count("<|image_pad|>") == 3


@pytest.mark.slow
def test_the_reply_is_that_of_the_network_to_the_same_tokens(folder):
    import transformers as hf

    network = hf.Qwen3VLForConditionalGeneration.from_pretrained(folder).eval()
    tokenizer = hf.Qwen2Tokenizer.from_pretrained(folder)
    images = hf.Qwen2VLImageProcessorPil.from_pretrained(folder)(
        images=[FRAMES[0], FRAMES[4]], return_tensors="pt"
    )
    (_, rows, columns), _ = images["image_grid_thw"].tolist()
    shown = "<|vision_start|>" + "<|image_pad|>" * (rows * columns // 4) + "<|vision_end|>"
    text = f"<|im_start|>user\n{2 * shown}2 frames?<|im_end|>\n<|im_start|>assistant\n"
    tokens = tokenizer(text, return_tensors="pt")
    kinds = (tokens["input_ids"] == tokenizer.convert_tokens_to_ids("<|image_pad|>")).int()
    assert kinds.sum() == rows * columns // 2
    with torch.inference_mode():
        output = network.generate(
            **tokens, **images, mm_token_type_ids=kinds, max_new_tokens=6, do_sample=False
        )
    want = tokenizer.decode(output[0, tokens["input_ids"].shape[1] :], skip_special_tokens=True)

    captioner = Qwen3VL(folder, images=2, max_new_tokens=6, prompt="{count} frames?")

    assert isinstance(captioner, Captioner)
    assert captioner.reply(FRAMES) == want
    with pytest.raises(NetworkError, match="without a caption"):
        captioner(FRAMES)


@pytest.mark.slow
def test_a_question_with_other_braces_is_refused(folder):
    with pytest.raises(InputError, match="--prompt"):
        Qwen3VL(folder, prompt="{number} frames?").reply(FRAMES)
