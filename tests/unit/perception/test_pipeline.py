"""Stages see earlier results, and errors name the missing field of a pipeline."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from egosim_jax.perception.pipeline import Observation, Pipeline, find_interactions
from egosim_jax.types import Clip, InputError
from tests.scenes import pinhole, state_of, without_hands

SIZE = (3, 8, 10)
CAMERAS = pinhole(SIZE[0], 9.0, *SIZE[1:])
POSE = np.diag([-1.0, -1, 1, 1])


def asked():
    poses, names = {1: POSE}, {1: "cup in hand"}
    state = state_of(np.zeros((1, 3)), step=4, names=names, world_from_object=poses)
    return Clip(frames=np.zeros((*SIZE, 3), np.uint8), fps=8), without_hands(CAMERAS), state


def poses(clip, action, state, so_far):
    return replace(so_far, cameras=action.cameras, names={})


def masks(clip, action, state, so_far):
    ids = np.zeros(SIZE, np.int32)
    ids[:, 2:4, 2:4] = 1
    return replace(so_far, object_ids=ids)


def tracks(clip, action, state, so_far):
    """One motion for each id that segmentation found."""
    numbers = np.unique(so_far.require("object_ids", "tracks"))
    still = np.tile(np.eye(4), (SIZE[0], 1, 1))
    still[:, 0, 3] = np.arange(SIZE[0])
    return replace(so_far, motions={n: still for n in numbers.tolist() if n > 0})


@dataclass(frozen=True)
class DepthFromScale:
    """Depth that needs the cameras."""

    meters: float
    shape: tuple[int, ...] = SIZE

    def __call__(self, clip, action, state, so_far):
        so_far.require("cameras", "DepthFromScale")
        depth = np.full(self.shape, self.meters, np.float32)
        depth[0] = np.nan
        return replace(so_far, depth_m=depth)


STAGES = (poses, masks, tracks, DepthFromScale(0.5), find_interactions)


def test_a_finished_observation_becomes_a_perceived():
    found = Pipeline(stages=STAGES)(*asked())
    assert found.step == 5
    assert found.depth_m.dtype == np.float32
    assert np.isinf(found.depth_m[0]).all()
    assert (found.depth_m[1:] == 0.5).all()
    assert found.object_ids.dtype == np.int32
    np.testing.assert_array_equal(found.world_from_object[1][0], POSE)
    np.testing.assert_array_equal(found.world_from_object[1][2, :3, 3], [2, 0, 0])
    np.testing.assert_array_equal(found.interacted_frames[1], [True] * SIZE[0])


@pytest.mark.parametrize(
    ("missing", "message"),
    [
        (0, "DepthFromScale needs cameras"),
        (1, "tracks needs object_ids"),
        (2, "Perceived needs motions"),
        (3, "find_interactions needs depth_m"),
        (4, "Perceived needs interacted_frames"),
    ],
)
def test_a_missing_field_is_named_with_its_user(missing, message):
    stages = tuple(stage for number, stage in enumerate(STAGES) if number != missing)
    with pytest.raises(InputError, match=f"{message}, which no stage before it has set"):
        Pipeline(stages=stages)(*asked())


def test_a_stage_of_another_size_is_named():
    stages = (*STAGES[:3], DepthFromScale(0.5, (3, 8, 9)))
    with pytest.raises(InputError, match=r"DepthFromScale returned depth_m of shape \(3, 8, 9\)"):
        Pipeline(stages=stages)(*asked())


def test_stages_do_not_change_the_record_before_them():
    before = Observation()
    after = poses(*asked(), before)
    assert before == Observation()
    assert after.cameras is CAMERAS
