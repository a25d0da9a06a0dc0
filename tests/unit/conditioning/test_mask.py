"""Each rule of the mask against plain loops."""

import jax.numpy as jnp
import numpy as np
import pytest

from egosim_jax.conditioning import pack_mask
from egosim_jax.conditioning.mask import halve_mask
from egosim_jax.types import InputError, VideoGrid


@pytest.fixture(scope="module")
def frames():
    """A gray video in which any two selected pixels differ, but for chance."""
    return np.random.default_rng(0).integers(0, 256, (13, 32, 48), np.uint8)


def test_the_whole_rule_on_a_random_video(frames):
    packed = pack_mask(frames)
    padded = [*frames, frames[-1], frames[-1], frames[-1], frames[-1]][: 4 * 4 + 1]
    assert packed.shape == (4, 4, 6, 4)
    for f in range(4):
        source = padded[int(f * len(padded) / 4)]
        for i in range(4):
            for j in range(6):
                for dh in range(2):
                    for dw in range(2):
                        row = int((2 * i + dh) * 32 / 8)
                        column = int((2 * j + dw) * 48 / 12)
                        unobserved = f > 0 and source[row, column] / 255 > 0.5
                        assert packed[f, i, j, 2 * dh + dw] == unobserved


@pytest.mark.parametrize(("gray", "generate"), [(0, 0), (127, 0), (128, 1), (255, 1)])
def test_the_threshold_is_one_half_of_white(gray, generate):
    packed = pack_mask(np.full((5, 16, 16), gray, np.uint8))
    assert (packed[1] == generate).all()


def test_a_single_channel_holds_the_pixel_of_the_cell_in_the_frame_of_its_latent(frames):
    packed = pack_mask(frames, packing="single", channels=1)
    expected = frames[::4, ::8, ::8, None] > 127
    np.testing.assert_array_equal(packed[1:], expected[1:])
    assert packed[0].max() == 0


def test_channels_in_time_hold_the_four_frames_that_a_latent_frame_encodes(frames):
    packed = pack_mask(frames, packing="time")
    for latent in range(1, 4):
        for channel in range(4):
            source = frames[4 * (latent - 1) + 1 + channel, ::8, ::8]
            np.testing.assert_array_equal(packed[latent, ..., channel], source > 127)
    assert packed[0].max() == 0


def test_another_codec_has_other_cells(frames):
    grid = VideoGrid(temporal_stride=2, spatial_stride=4, patch=2)
    packed = pack_mask(frames, grid=grid)
    assert packed.shape == (7, 8, 12, 4)
    np.testing.assert_array_equal(packed[3, 2, 5].reshape(2, 2), frames[6, 8:12:2, 20:24:2] > 127)


def test_a_constant_mask_is_zero_and_refuses_holes(frames):
    packed = pack_mask(frames // 2, packing="observed", channels=3)
    assert packed.shape == (4, 4, 6, 3)
    assert packed.max() == 0
    with pytest.raises(InputError, match=r"% of the pixels were not observed: .*--prior static"):
        pack_mask(frames, packing="observed", channels=3)


@pytest.mark.parametrize(("shape", "message"), [((62, 16, 16), r"4k\+1"), ((5, 16, 20), "16 x 20")])
def test_a_video_without_whole_latent_cells_is_refused(shape, message):
    with pytest.raises(InputError, match=message):
        pack_mask(np.zeros(shape, np.uint8))


@pytest.mark.parametrize(("packing", "channels"), [("space", 4), ("time", 4), ("single", 1)])
def test_half_a_mask_is_the_packed_mask_of_every_second_pixel(frames, packing, channels):
    whole = pack_mask(frames, packing=packing, channels=channels)
    half = pack_mask(frames[:, ::2, ::2], packing=packing, channels=channels)
    assert half.any()
    halved = halve_mask(jnp.asarray(whole, jnp.float32), packing)
    np.testing.assert_array_equal(halved, half)
