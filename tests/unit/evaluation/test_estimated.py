"""Measures from estimates, with estimators of known results."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from egosim_jax.data.metadata import read_metadata
from egosim_jax.data.windows import Window
from egosim_jax.evaluation.estimated import (
    OBJECT_MASK,
    cameras,
    depth,
    hand_region,
    hands,
    regions,
)
from egosim_jax.evaluation.measures import GroundTruth
from egosim_jax.io.video import read_video
from egosim_jax.io.writing import write_video
from egosim_jax.perception.video.estimates import CameraEstimate, DepthEstimate, HandTracks, Verdict
from egosim_jax.types import Cameras


@pytest.fixture
def truth(clips):
    """Ground truth of the first clip: 9 frames, 48x32."""
    files = read_metadata(clips)[0]
    frames = read_video(files.target).frames
    return GroundTruth(frames=frames, first=1, window=Window(files, 0, files.video_id))


def test_regions_count_their_pixels_alone(truth):
    drawn = np.zeros_like(truth.frames)
    drawn[:, 10:14, 20:30] = 255
    write_video(truth.window.files.hands, drawn, 16, crf=0)
    region = hand_region(truth)
    # A margin of one pixel around 4 x 10.
    assert region[0].sum() == pytest.approx(6 * 12, abs=4)
    video = np.where(region[..., None], truth.frames, 255 - truth.frames)
    scores = regions().against(truth)(video)
    assert scores["hand_psnr"] == 100  # equal near the hands
    assert np.isnan(scores["object_psnr"])  # there is no mask


def test_an_object_mask_next_to_the_prior_makes_the_object_region(truth):
    mask = np.zeros_like(truth.frames)
    mask[:, 8:16, 16:32] = 255
    write_video(truth.window.files.prior.parent / OBJECT_MASK, mask, 16, crf=0)
    video = truth.frames.copy()
    video[:, 9:15, 17:31] ^= 1
    score = regions().against(truth)(video)["object_psnr"]
    # 6 x 14 of 8 x 16 pixels are off by one level.
    assert score == pytest.approx(10 * np.log10(255**2 / (6 * 14 / (8 * 16))), abs=0.01)


def test_other_masks_and_hands_make_other_cached_scores(truth):
    window = truth.window
    found = [regions().settings(window)]
    mask = np.zeros_like(truth.frames)
    write_video(window.files.prior.parent / OBJECT_MASK, mask, 16)
    found.append(regions().settings(window))
    paths = [cameras(cameras_by_level).settings(window)]
    write_video(window.files.hands, mask + 9, 16)
    found.append(regions().settings(window))
    paths.append(cameras(cameras_by_level).settings(window))
    assert len(set(map(str, found))) == 3
    assert len(set(map(str, paths))) == 2


def depth_of(scale, metric):
    """Return an estimator whose depth is the green level in some unit."""

    def estimate(frames, moving, cameras, wanted):
        depth = scale * (1 + frames[list(wanted)][..., 1].astype(np.float32))
        return DepthEstimate(
            frames=np.asarray(wanted, np.int32),
            depth_m=depth,
            confident=np.ones(depth.shape, bool),
            metric=metric,
        )

    return estimate


@pytest.mark.parametrize(("metric", "expected"), [(True, 10.0), (False, 0.0)])
def test_metric_depth_is_not_rescaled(truth, metric, expected):
    dark = truth.frames.copy()
    dark[..., 1] = 99
    truth = GroundTruth(frames=dark, first=1, window=truth.window)
    video = dark.copy()
    video[..., 1] = 109  # depth 110 instead of 100
    scores = depth(depth_of(1.0, metric)).against(truth)(video)
    assert scores["depth_error"] == pytest.approx(expected, abs=1e-4)


def cameras_by_level(frames, moving, **_):
    """Return cameras that move by the mean blue level; None for a black video."""
    if not frames.any():
        cameras = None
    else:
        poses = np.tile(np.eye(4), (len(frames), 1, 1))
        poses[:, 0, 3] = frames[..., 2].mean(axis=(1, 2))
        intrinsics = np.array([[40.0, 0, 24], [0, 40.0, 16], [0, 0, 1]])
        cameras = Cameras(world_from_camera=poses, intrinsics_px=intrinsics, height=32, width=48)
    verdict = Verdict(rung="incremental", reason="", figures={})
    return CameraEstimate(cameras=cameras, metric=False, verdict=verdict)


def test_camera_paths_are_compared_up_to_scale(truth):
    levels = np.arange(9, dtype=np.uint8) * 10
    frames = np.broadcast_to(levels[:, None, None, None], truth.frames.shape).copy()
    truth = GroundTruth(frames=frames, first=1, window=truth.window)
    score = cameras(cameras_by_level).against(truth)
    same = score(frames * 2)
    assert [same[key] for key in sorted(same)] == pytest.approx([0, 0, 0], abs=1e-6)
    assert np.isnan(score(np.zeros_like(frames))["camera_error"])


def test_a_camera_that_jitters_by_a_micrometer_has_no_translation_error(truth):
    def jittering(frames, moving, **_):
        estimate = cameras_by_level(frames, moving)
        poses = estimate.cameras.world_from_camera * 1.0
        poses[:, :3, 3] = 1e-6 * np.random.default_rng(0).normal(size=(len(poses), 3))
        cameras = replace(estimate.cameras, world_from_camera=poses)
        return replace(estimate, cameras=cameras)

    scores = cameras(jittering).against(truth)(truth.frames)
    assert np.isnan([scores["camera_error"], scores["camera_ate"]]).all()


def test_hands_are_compared_from_the_first_counted_frame(truth):
    def detect(frames):
        hands = np.full((len(frames), 2, 21, 2), np.nan)
        corners = np.array([[5, 5], [15, 5], [15, 15], [5, 15]])
        hands[:, 0] = corners[np.arange(21) % 4] + frames[:, 0, 0, 0].astype(float)[:, None, None]
        return SimpleNamespace(joints_px=hands)

    assert set(HandTracks.__dataclass_fields__) >= {"joints_px"}
    black = np.zeros_like(truth.frames)
    black[0] = 200
    truth = GroundTruth(frames=black, first=1, window=truth.window)
    video = np.full_like(black, 3)
    scores = hands(detect).against(truth)(video)
    assert scores["keypoint_error"] == pytest.approx(100 * 3 * 2**0.5 / 48)
    assert scores["hand_recall"] == 1
    assert scores["hand_iou"] == pytest.approx(8 * 8 / (2 * 11 * 11 - 8 * 8))
