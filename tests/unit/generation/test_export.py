"""Conditions of an action as files."""

import numpy as np
import pytest

from egosim_jax.data.clips import load_triplet
from egosim_jax.data.metadata import read_metadata
from egosim_jax.generation.export import write_conditions
from egosim_jax.types import InputError, VideoSpec
from egosim_jax.worlds.tabletop import make_sequence, to_action, to_triplet
from egosim_jax.worlds.tabletop.clips import POINT_PX

SPEC = VideoSpec(frames=5, height=48, width=80, fps=8)


def test_the_files_are_read_as_the_clip_of_the_same_action(tmp_path):
    clip = next(make_sequence(3, spec=SPEC))
    path = write_conditions(tmp_path, clip.state, to_action(clip), fps=8, point_px=POINT_PX)
    (files,) = read_metadata(path)
    loaded, expected = load_triplet(files, SPEC), to_triplet(clip)
    assert loaded.prompt == expected.prompt
    np.testing.assert_array_equal(loaded.mask > 127, expected.mask > 127)
    for name in ("prior", "hands"):
        error = np.abs(getattr(loaded, name).astype(int) - getattr(expected, name))
        assert error.mean() < 8  # of the video codec


def test_clips_of_several_calls_are_in_one_table(tmp_path):
    clip = next(make_sequence(3, spec=SPEC))
    for video_id in ("clip_1", "clip_2", "clip_1"):
        path = write_conditions(tmp_path, clip.state, to_action(clip), fps=8, video_id=video_id)
    assert [files.video_id for files in read_metadata(path)] == ["clip_1", "clip_2"]


def test_an_id_outside_the_folder_is_refused(tmp_path):
    clip = next(make_sequence(3, spec=SPEC))
    with pytest.raises(InputError, match=r"video_id '\.\./evil' is not a valid file name"):
        write_conditions(tmp_path / "to", clip.state, to_action(clip), fps=8, video_id="../evil")
    assert not list(tmp_path.rglob("*"))
