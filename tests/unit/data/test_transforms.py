"""Records to pixels at the model's size."""

import numpy as np
import pytest

from egosim_jax.data.clips import load_triplet
from egosim_jax.data.metadata import read_metadata
from egosim_jax.data.pack import encoded_record, triplet_record
from egosim_jax.data.transforms import (
    DecodeWindow,
    decode_record,
    fit_length,
    resize_video,
    video_shape,
)
from egosim_jax.types import InputError, VideoSpec

SPEC = VideoSpec(frames=5, height=16, width=32)
NAMES = ("target", "prior", "hands", "mask", "first_frame")


@pytest.fixture
def files(clips):
    return read_metadata(clips)[0]


def test_a_packed_clip_decodes_to_what_inference_reads(files):
    triplet = load_triplet(files, SPEC, start=2)
    frames = triplet_record(load_triplet(files, VideoSpec(frames=9, height=16, width=32)))
    for record in (encoded_record(files), frames):
        assert video_shape(record.arrays)[0] == 9
        decoded = decode_record(record.arrays, SPEC, start=2)
        for name in NAMES:
            np.testing.assert_array_equal(decoded[name], getattr(triplet, name))


def test_packing_keeps_the_files_as_they_are(files):
    arrays = encoded_record(files).arrays
    for name in NAMES:
        assert arrays[name].tobytes() == getattr(files, name).read_bytes()


def test_a_window_beyond_the_end_is_refused(files):
    with pytest.raises(InputError, match="target ends before frame 11"):
        decode_record(encoded_record(files).arrays, SPEC, start=6)


def test_a_clip_shorter_than_the_window_is_refused(files):
    window = DecodeWindow(VideoSpec(frames=13, height=16, width=32))
    with pytest.raises(InputError, match="9 frames are fewer than the window's 13"):
        window.random_map(encoded_record(files).arrays, np.random.default_rng(0))


def test_a_video_of_the_right_size_is_not_touched():
    video = np.random.default_rng(0).integers(0, 256, (2, 16, 32, 3)).astype(np.uint8)
    assert resize_video(video, 16, 32) is video


@pytest.mark.parametrize(("count", "expected"), [(2, [0, 1]), (3, [0, 1, 2]), (5, [0, 1, 2, 2, 2])])
def test_a_length_is_fitted_by_cutting_or_repeating_the_last_frame(count, expected):
    np.testing.assert_array_equal(fit_length(np.arange(3, dtype=np.uint8), count), expected)
