"""Undistorted frames and pixels versus a pinhole camera in the rendered room."""

import numpy as np
import pytest

from egosim_jax.perception.video.cameras.lens import pinhole_focal, undistort, undistort_pixels
from egosim_jax.perception.video.estimates import CameraEstimate, Lens, Verdict
from egosim_jax.types import InputError
from tests.scenes import pinhole
from tests.unit.perception.video.cameras.room import FOCAL, HEIGHT, WIDTH, path, render

VERDICT = Verdict(rung="incremental", reason="a test", figures={})


def estimate(lens: Lens | None) -> CameraEstimate:
    focal = FOCAL if lens is None else pinhole_focal(lens, height=HEIGHT, width=WIDTH)
    cameras = pinhole(1, focal, HEIGHT, WIDTH)
    return CameraEstimate(cameras=cameras, metric=False, verdict=VERDICT, lens=lens)


@pytest.mark.parametrize("radial", [-0.08, 0.08])
def test_undistorted_frames_are_those_of_a_pinhole_camera(radial: float) -> None:
    found = estimate(Lens(focal_px=FOCAL, radial=radial))
    assert found.cameras is not None
    recorded = render(path(1), lens=found.lens)
    expected = render(found.cameras)
    gap = np.abs(undistort(recorded, found).astype(int) - expected)
    assert np.median(gap) <= 3
    assert np.median(np.abs(recorded.astype(int) - expected)) > 10
    border = np.concatenate([gap[0, 0], gap[0, -1], gap[0, :, 0], gap[0, :, -1]])
    assert np.median(border) <= 6


@pytest.mark.parametrize("radial", [-0.08, 0.08])
def test_every_undistorted_pixel_was_recorded_and_no_more_is_lost(radial: float) -> None:
    lens = Lens(focal_px=FOCAL, radial=radial)
    found = estimate(lens)
    edge = np.linspace(-0.5, WIDTH - 0.5, 201)
    top = np.stack([edge, np.full(201, -0.5)], axis=-1)
    side = np.stack([np.full(201, -0.5), np.linspace(-0.5, HEIGHT - 0.5, 201)], axis=-1)
    inside = undistort_pixels(np.concatenate([top, side]), found)
    beyond = np.maximum(-0.5 - inside[:, 0], -0.5 - inside[:, 1])
    assert beyond.min() == pytest.approx(0, abs=0.05)


def test_masks_keep_their_type_and_pixels_their_gaps() -> None:
    found = estimate(Lens(focal_px=FOCAL, radial=0.05))
    mask = np.zeros((1, HEIGHT, WIDTH), bool)
    mask[0, 100:140, 20:60] = True
    moved = undistort(mask, found)
    assert moved.dtype == bool
    joints = np.array([[39.5, 119.5], [np.nan, np.nan]])
    row, column = np.argwhere(moved[0]).mean(axis=0)
    straight = undistort_pixels(joints, found)
    assert straight[0] == pytest.approx([column, row], abs=0.6)
    assert np.isnan(straight[1]).all()


def test_nothing_changes_without_a_lens() -> None:
    frames = render(path(1))
    assert undistort(frames, estimate(None)) is frames


def test_frames_of_another_size_are_refused() -> None:
    with pytest.raises(InputError, match="sizes must be the same"):
        undistort(np.zeros((1, 8, 8, 3), np.uint8), estimate(Lens(focal_px=FOCAL, radial=0.1)))
