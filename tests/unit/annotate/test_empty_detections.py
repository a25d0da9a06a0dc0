"""Estimators that find nothing, or something in one frame: a result or a named rule, no IndexError.

Each stage of an annotation, and each function below it, gets no hands, no points or no depth.
"""

from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import pytest

from egosim_jax.annotate.hand_tracks import drop_flashes, hold_hands, visible
from egosim_jax.annotate.scene import to_triplet
from egosim_jax.perception.classical import ClassicalConfig
from egosim_jax.perception.video.depth import SweptDepth
from egosim_jax.perception.video.depth.triangulate import triangulate_frames
from egosim_jax.perception.video.estimates import CameraEstimate, SparsePoints, Verdict
from egosim_jax.perception.video.hands import LandmarkHands, lift
from egosim_jax.perception.video.plate import clean_plate
from egosim_jax.perception.video.silhouettes import track_silhouettes
from egosim_jax.types import Action, Clip, InputError
from tests.hands import PaintedHands, hand_px, paint
from tests.scenes import pinhole
from tests.unit.annotate.stubs import StubDepth, StubHands, config, textured_video
from tests.unit.annotate.test_stages import stages_of

SHAPE = (9, 48, 80)
NOWHERE = np.zeros(SHAPE, bool)


def still_cameras(shift=0.0):
    poses = np.tile(np.eye(4), (SHAPE[0], 1, 1))
    poses[:, 0, 3] = shift * np.arange(SHAPE[0])
    return pinhole(poses, 50.0, 48, 80)


@pytest.mark.parametrize(("frames", "side"), [(0, "auto"), (1, "left"), (2, "auto")])
def test_all_stages_run_on_few_hands(tmp_path, frames, side):
    settings = config(side=side, hands_until=frames / 9)
    settings = replace(settings, cutting=_without_rule(settings.cutting))
    record = stages_of(tmp_path, settings)
    seen = visible(record.require("hands"))
    assert seen.sum() == frames
    triplet, figures = to_triplet(record, settings)
    predicted, _ = to_triplet(record, replace(settings, prior="predicted"))
    assert predicted.extra["prior_kind"] == "predicted"
    np.testing.assert_array_equal(predicted.prior, triplet.prior)  # these hands move nothing
    assert triplet.hands.any() == (frames > 0)
    assert np.isfinite(list(figures.values())).all()
    assert "hand" in record.require("prompt")


def _without_rule(cutting):
    return replace(cutting, quality=replace(cutting.quality, min_hands=0.0))


@dataclass(frozen=True)
class NoDepth(StubDepth):
    """Depth that is unknown everywhere, or known in one pixel."""

    known: int = 0

    def __call__(self, frames, moving, estimate, wanted):
        found = super().__call__(frames, moving, estimate, wanted)
        depth = np.full_like(found.depth_m, np.inf)
        depth.reshape(len(wanted), -1)[:, : self.known] = 2.0
        return replace(found, depth_m=depth, confident=np.isfinite(depth))


@pytest.mark.parametrize(("known", "state"), [(0, "first"), (1, "first"), (1, "fused")])
def test_a_clip_without_depth_is_refused_with_a_reason(tmp_path, known, state, monkeypatch):
    settings = config(state=state)
    parts = replace(settings.build(), depth=NoDepth(None, known))
    monkeypatch.setattr(type(settings), "build", lambda self: parts)
    if not known:
        with pytest.raises(InputError, match="depth"):
            stages_of(tmp_path, settings)
        return
    assert len(stages_of(tmp_path, settings).require("state").points_m) >= 1


class Blind(PaintedHands):
    """Networks that find no palm, or a palm without a hand."""

    def __init__(self, palm):
        super().__init__()
        self.palm = palm

    def palms(self, image):
        return super().palms(image) if self.palm else (
            np.zeros((2016, 18), np.float32), np.full(2016, -50, np.float32)
        )  # fmt: skip

    def landmarks(self, image):
        joints, _, right, meters = super().landmarks(image)
        return joints, 0.0, right, meters


@pytest.mark.parametrize(("frames", "networks"), [(1, Blind(False)), (5, Blind(True))])
def test_networks_that_find_nothing_give_tracks_without_hands(frames, networks):
    video = paint([[hand_px(center=(160, 120))]] * frames)
    tracks = LandmarkHands(networks=networks)(video)
    assert tracks.joints_px.shape == (frames, 2, 21, 2)
    assert not visible(tracks).any()
    for values in (tracks.presence, tracks.filled, tracks.mirrored):
        assert not values.any()


@pytest.mark.parametrize(("frames", "visible_hands"), [(1, 1), (5, 0)])
def test_a_hand_in_the_first_frame_alone_is_a_false_detection_unless_it_is_the_only_one(
    frames, visible_hands
):
    hands = [[hand_px(center=(160, 120))], *([] for _ in range(frames - 1))]
    tracks = LandmarkHands(networks=PaintedHands())(paint(hands))
    assert visible(tracks).sum() == visible_hands


@pytest.mark.parametrize(
    "function",
    [
        lambda hands: drop_flashes(hands, Fraction(16)).presence,
        lambda hands: hold_hands(hands, Fraction(16)).presence,
        lambda hands: lift(hands, still_cameras().intrinsics_px)[..., 0, 0] > 0,
        lambda hands: track_silhouettes(
            np.zeros((len(hands.presence), 48, 80, 3), np.uint8), hands
        ),
    ],
    ids=["flashes", "hold", "lift", "silhouettes"],
)
def test_functions_of_tracks_take_tracks_without_hands(function):
    assert not function(StubHands(0.0, None)(np.zeros((*SHAPE, 3), np.uint8))).any()


@pytest.mark.parametrize("hidden", [False, True], ids=["flat", "hidden"])
def test_frames_without_corners_have_no_points_and_an_assumed_depth(hidden):
    frames = np.full((*SHAPE, 3), 128, np.uint8)
    moving = NOWHERE | hidden
    cameras = still_cameras(0.02)
    assert triangulate_frames(frames, moving, cameras, [0, 4]) is None
    none = SparsePoints(
        points_m=np.zeros((0, 3)),
        error_px=np.zeros(0),
        frames=np.zeros(0, np.int32),
        indices=np.zeros(0, np.int32),
        pixels_px=np.zeros((0, 2)),
    )
    for points in (None, none):
        verdict = Verdict(rung="given", reason="given", figures={})
        estimate = CameraEstimate(cameras=cameras, metric=True, verdict=verdict, points=points)
        found = SweptDepth()(frames, moving, estimate, [0, 4])
        assert np.isfinite(found.depth_m).all()
        assert "0 points" in found.reason or "does not change" in found.reason


@pytest.mark.parametrize("moving", [NOWHERE, ~NOWHERE], ids=["no hand", "only hands"])
@pytest.mark.parametrize("depth_m", [2.0, np.inf])
def test_a_plate_of_nothing_or_everything_hidden(moving, depth_m):
    frames = textured_video(9, shift=0)
    plate = clean_plate(frames, moving, still_cameras(), np.full(SHAPE[1:], depth_m))
    assert plate.image.shape == frames[0].shape
    assert not plate.seen.any()


@pytest.mark.parametrize("frames", [0, 1], ids=["no hand", "one frame"])
def test_perception_of_a_clip_without_hands_moves_nothing(frames, tmp_path):
    state = stages_of(tmp_path, config(hands_until=1.0)).require("state")
    joints = np.full((9, 1, 21, 3), np.nan)
    video = np.repeat(textured_video(1), 9, axis=0)
    if frames:
        local = lift(StubHands(1 / 9, None)(video), still_cameras().intrinsics_px)
        joints[:frames, 0] = local[:frames, 1]
    action = Action(cameras=still_cameras(), joints_m=joints, kind="human", prompt="look")
    found = ClassicalConfig().build()(Clip(frames=video, fps=16), action, state)
    assert not found.world_from_object
