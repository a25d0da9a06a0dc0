"""Records, tables and masks: written and read back, or computed in another way, all agree."""

import csv
import tempfile
from pathlib import Path

import ml_dtypes
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from egosim_jax.conditioning.mask import pack_mask
from egosim_jax.data.metadata import read_metadata
from egosim_jax.data.records import Record, from_bytes, to_bytes

DTYPES = [np.uint8, np.int32, np.int64, np.float16, np.float32, np.bool_, ml_dtypes.bfloat16]
names = st.text("abcdefghijklmnopqrstuvwxyz_0123456789", min_size=1, max_size=12)
texts = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=40)


@st.composite
def any_array(draw):
    shape = draw(arrays.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=5))
    data = np.random.default_rng(draw(st.integers(0, 2**32 - 1))).standard_normal(shape) * 100
    return np.asarray(data.astype(draw(st.sampled_from(DTYPES))))


@given(st.dictionaries(names, any_array(), max_size=4), st.dictionaries(names, texts, max_size=4))
def test_a_record_is_read_as_it_was_written(contents, metadata):
    back = from_bytes(to_bytes(Record(arrays=contents, metadata=metadata)))
    assert back.metadata == metadata
    assert back.arrays.keys() == contents.keys()
    for name, array in contents.items():
        assert back.arrays[name].dtype == array.dtype
        assert back.arrays[name].shape == array.shape
        assert back.arrays[name].tobytes() == array.tobytes()


prompts = texts.filter(lambda text: text.strip().lower() not in ("", "nan"))


@given(st.dictionaries(names, prompts, min_size=1, max_size=5))
def test_a_table_is_read_as_it_was_written(rows):
    columns = ["video_id", "prompt", "ego_prior_video", "hand_keypoint_video", "first_frame"]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "metadata.csv"
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(columns)
            writer.writerows([key, text, "p.mp4", "h.mp4", "f.png"] for key, text in rows.items())
        clips = read_metadata(path)
    assert {clip.video_id: clip.prompt for clip in clips} == rows


@given(st.integers(0, 4), st.integers(1, 3), st.integers(1, 3), st.integers(0, 2**32 - 1))
def test_a_packed_mask_is_that_of_a_loop(groups, rows, columns, seed):
    shape = (4 * groups + 1, 8 * rows, 8 * columns)
    frames = np.random.default_rng(seed).integers(0, 256, shape).astype(np.uint8)
    packed = pack_mask(frames)
    assert packed.shape == (groups + 1, rows, columns, 4)
    for index in np.ndindex(packed.shape):
        f, i, j, channel = index
        gray = frames[4 * f, 8 * i + 4 * (channel // 2), 8 * j + 4 * (channel % 2)]
        assert packed[index] == (f > 0 and gray > 127)
