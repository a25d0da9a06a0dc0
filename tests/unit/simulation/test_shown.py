"""Texts and images of data, as consoles and notebooks show them."""

import base64
import io
import re

import numpy as np
import pytest
from PIL import Image

import egosim_jax
from egosim_jax.types import Clip, VideoSpec
from egosim_jax.worlds.tabletop import make_sequence, to_episode

CLIP = Clip(frames=np.zeros((5, 16, 32, 3), np.uint8), fps=8)


@pytest.fixture(scope="module")
def episode():
    spec = VideoSpec(frames=5, height=48, width=80, fps=8)
    return to_episode([next(make_sequence(0, spec=spec, kind="human"))], fps=spec.fps)


def images(html):
    for data in re.findall(r"data:image/webp;base64,([^\"]+)", html):
        yield Image.open(io.BytesIO(base64.b64decode(data)))


def test_the_package_lists_its_public_names():
    assert dir(egosim_jax) == sorted([*egosim_jax.__all__, "__version__"])


def test_texts_have_the_sizes_of_arrays():
    assert repr(CLIP) == "Clip(frames=uint8[5, 16, 32, 3], fps=8)"


def test_long_data_have_short_texts(episode):
    for value in (episode, episode.state, episode.actions[0], episode.actions[0].cameras):
        text = repr(value)
        assert text.startswith(f"{type(value).__name__}(")
        assert len(text) < 2000
        assert "\n" not in text


def test_a_clip_moves_in_a_notebook():
    frames = np.stack([np.full((16, 32, 3), 50 * number, np.uint8) for number in range(5)])
    (image,) = images(Clip(frames=frames, fps=8)._repr_html_())
    assert (image.size, image.n_frames) == ((32, 16), 5)


def test_a_state_and_what_has_one_are_drawn(episode):
    for value in (episode.state, episode):
        (image,) = images(value._repr_html_())
        assert image.size == (1920, 480)
        assert np.asarray(image.convert("RGB")).std() > 1
