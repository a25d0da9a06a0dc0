"""The oracle returns the ground truth in the state's coordinates; archives store it."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.geometry import look_at
from egosim_jax.perception import archive
from egosim_jax.perception.oracle import OracleConfig
from egosim_jax.types import Clip, InputError, VideoSpec
from egosim_jax.worlds.tabletop import make_sequence, observation_of, to_action


@pytest.fixture(scope="module")
def clips():
    return list(make_sequence(3, spec=VideoSpec(frames=5, height=48, width=80, fps=8), clips=2))


def oracle(clip):
    return OracleConfig().build({clip.number: observation_of(clip)})


def asked(clip):
    return Clip(frames=clip.frames, fps=8), to_action(clip), clip.state


def test_hands_are_negative_and_the_room_is_background(clips):
    found = oracle(clips[0])(*asked(clips[0]))
    assert found.object_ids.min() < 0
    known = set(np.unique(found.object_ids[found.object_ids > 0]).tolist())
    assert known <= set(clips[0].state.names)
    assert ((found.object_ids < 0) == (clips[0].ids >= 100)).all()


def test_paths_begin_at_the_pose_in_the_state(clips):
    clip = clips[0]
    target = clip.body_ids[clip.target]
    before = look_at(np.ones(3), np.zeros(3), up=np.array([0, 0, 1.0]))
    state = replace(clip.state, world_from_object={target: before})
    found = oracle(clip)(Clip(frames=clip.frames, fps=8), to_action(clip), state)
    assert set(found.world_from_object) == {target}
    path, truth = found.world_from_object[target], clip.world_from_body[clip.target]
    np.testing.assert_allclose(path[0], before, atol=1e-12)
    moved = path @ np.linalg.inv(path[0])
    np.testing.assert_allclose(moved, truth @ np.linalg.inv(truth[0]), atol=1e-12)


def test_an_archive_keeps_everything(clips, tmp_path):
    found = oracle(clips[1])(*asked(clips[1]))
    found = replace(found, interacted_frames={10: np.array([False, True, True, False, False])})
    archive.save(tmp_path / "perceived.npz", found)
    again = archive.load(tmp_path / "perceived.npz")
    for name in ("frames", "depth_m", "object_ids"):
        np.testing.assert_array_equal(getattr(again, name), getattr(found, name))
    for name in ("world_from_object", "interacted_frames"):
        one, other = getattr(again, name), getattr(found, name)
        assert one.keys() == other.keys()
        for number in one:
            np.testing.assert_array_equal(one[number], other[number])
    np.testing.assert_array_equal(again.cameras.world_from_camera, found.cameras.world_from_camera)
    assert (again.step, again.names) == (found.step, found.names)


def test_a_file_that_is_not_an_archive_is_named(tmp_path):
    path = tmp_path / "perceived.npz"
    np.savez(path, about=np.zeros(3, np.uint8))
    with pytest.raises(InputError, match="not those expected"):
        archive.load(path)
