"""X-CLIP in its worker gives the similarity of transformers, and ranks candidates."""

import numpy as np
import pytest
import torch

from egosim_jax.generation import rank
from egosim_jax.perception.networks import close_workers
from egosim_jax.perception.networks.xclip import XClip
from tests.unit.perception.networks import tiny

pytestmark = pytest.mark.slow
TEXTS = ("a cup on the box", "an open drawer")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    yield tiny.xclip(tmp_path_factory.mktemp("xclip"))
    close_workers()


@pytest.fixture(scope="module")
def videos():
    return np.random.default_rng(0).integers(0, 256, (2, 7, 32, 32, 3)).astype(np.uint8)


def test_the_similarity_is_the_cosine_of_what_transformers_embeds(folder, videos):
    import transformers as hf

    network = hf.XCLIPModel.from_pretrained(folder).eval()
    images = torch.from_numpy(videos[0][[0, 2, 4, 6]]).movedim(-1, 1).float() / 255
    mean, std = (torch.tensor(x)[:, None, None] for x in ([0.5, 0.4, 0.3], [0.2, 0.3, 0.25]))
    tokens = tiny.clip_tokenizer()(TEXTS[0], return_tensors="pt")
    with torch.inference_mode():
        output = network(pixel_values=((images - mean) / std)[None], **tokens)
    video, text = output.video_embeds[0], output.text_embeds.reshape(-1)
    want = float(video @ text / (video.norm() * text.norm()))
    assert XClip(folder)(videos[0], TEXTS[0]) == pytest.approx(want, abs=1e-5)


def test_candidates_are_ranked_by_a_text(folder, videos):
    score = rank.by_text(TEXTS[1], folder)
    found = {name: [score(video)] for name, video in zip("ab", videos, strict=True)}
    assert found["a"] != found["b"]
    best = rank.order(found)[0].name
    assert best == max(found, key=lambda name: found[name])
