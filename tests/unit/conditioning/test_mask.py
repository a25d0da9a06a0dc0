"""Each rule of the mask against plain loops."""

import numpy as np
import pytest

from egosim_jax.conditioning import pack_mask
from egosim_jax.types import InputError, VideoGrid


@pytest.fixture(scope="module")
def frames():
    """A gray video in which any two selected pixels differ, but for chance."""
    return np.random.default_rng(0).integers(0, 256, (13, 32, 48), np.uint8)


def one_pixel(frame, row, column, shape=(61, 32, 48)):
    frames = np.zeros(shape, np.uint8)
    frames[frame, row, column] = 255
    return frames


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


def test_latent_frame_i_is_decided_by_pixel_frame_4i():
    for frame in range(1, 61):
        packed = pack_mask(one_pixel(frame, 0, 0))
        expected = [int(4 * i == frame) for i in range(16)]
        assert packed.max(axis=(1, 2, 3)).tolist() == expected, frame


def test_without_padding_the_frames_are_those_of_the_continuous_runner():
    frames = np.zeros((61, 16, 16), np.uint8)
    chosen = [0, 3, 7, 11, 15, 19, 22, 26, 30, 34, 38, 41, 45, 49, 53, 57]
    frames[chosen] = 255
    assert pack_mask(frames, padding="none").min(axis=(1, 2, 3)).tolist() == [0] + [1] * 15
    frames = 255 - frames
    assert pack_mask(frames, padding="none").max() == 0


@pytest.mark.parametrize("dh", [0, 1])
@pytest.mark.parametrize("dw", [0, 1])
def test_channel_2dh_plus_dw_holds_pixel_8i_plus_4dh_8j_plus_4dw(dh, dw):
    packed = pack_mask(one_pixel(8, 8 * 3 + 4 * dh, 8 * 5 + 4 * dw))
    assert np.argwhere(packed).tolist() == [[2, 3, 5, 2 * dh + dw]]


def test_pixels_between_the_selected_ones_do_not_count():
    frames = np.full((5, 16, 16), 255, np.uint8)
    frames[:, ::4, ::4] = 0
    assert pack_mask(frames).max() == 0


def test_a_length_that_the_vae_cannot_encode_is_refused():
    with pytest.raises(InputError, match=r"4k\+1"):
        pack_mask(np.zeros((62, 16, 16), np.uint8))


def test_a_size_without_whole_latent_cells_is_refused():
    with pytest.raises(InputError, match="16 x 20"):
        pack_mask(np.zeros((5, 16, 20), np.uint8))


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
