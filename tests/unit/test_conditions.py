"""Conditions of an action as files."""

import numpy as np

from egosim_jax.conditions import write_conditions
from egosim_jax.data.clips import load_triplet
from egosim_jax.data.metadata import read_metadata
from egosim_jax.types import VideoSpec
from egosim_jax.worlds.tabletop import make_sequence, to_action, to_triplet

SPEC = VideoSpec(frames=5, height=48, width=80, fps=8)


def test_the_files_are_read_as_the_clip_of_the_same_action(tmp_path):
    clip = next(make_sequence(3, spec=SPEC))
    path = write_conditions(tmp_path, clip.state, to_action(clip), fps=8)
    (files,) = read_metadata(path)
    loaded, expected = load_triplet(files, SPEC), to_triplet(clip)
    assert loaded.prompt == expected.prompt
    np.testing.assert_array_equal(loaded.mask > 127, expected.mask > 127)
    for name in ("prior", "hands"):
        error = np.abs(getattr(loaded, name).astype(int) - getattr(expected, name))
        assert error.mean() < 8  # of the video codec
