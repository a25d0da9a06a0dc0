"""The gate on measured figures, and figures of reconstructions with known geometry."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.perception.video.cameras.gate import GateConfig, Reconstruction, measure, refusals

GOOD = {
    "registered": 1.0, "gap": 0.0, "points": 1683.0, "focal_px": 329.0, "radial": 0.01,
    "view_deg": 103.0, "error_px": 0.73, "depth_spread": 1.8, "angle_deg": 3.0, "step": 3.2,
    "shared": 120.0,
}  # fmt: skip


def line(count: int = 10, *, step: float = 0.1) -> Reconstruction:
    """Return cameras on a line parallel to x that all see points at depths 2 to 4."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-1, -1, 2], [1, 1, 4], size=(200, 3))
    poses = np.tile(np.eye(3, 4), (count, 1, 1))
    poses[:, 0, 3] = -step * np.arange(count)
    viewers, observed = (x.ravel() for x in np.mgrid[:count, :200])
    return Reconstruction(
        frames=np.arange(count, dtype=np.int32),
        camera_from_world=poses,
        focal_px=320.0,
        radial=0.0,
        points=points,
        error_px=np.full(200, 0.5),
        observed_in=viewers.astype(np.int32),
        observed=observed.astype(np.int32),
        pixels_px=np.zeros((count * 200, 2)),
    )


def figures(found: Reconstruction, frames: int = 10) -> dict[str, float]:
    return measure(found, frames=frames, images=10, height=480, width=640)


def test_figures_of_a_real_reconstruction_pass() -> None:
    assert refusals(GOOD, GateConfig()) == ()


def test_a_degenerate_reconstruction_with_all_frames_and_a_small_error_is_refused() -> None:
    degenerate = GOOD | {"error_px": 1.11, "depth_spread": 4e15}
    assert "depth spreads by a factor of 4e+15" in refusals(degenerate, GateConfig())[0]


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("registered", 0.85, "85% of the frames"),
        ("gap", 6.0, "6 frames in a row"),
        ("radial", -0.48, "radial distortion is -0.48"),
        ("angle_deg", 0.9, "triangulation angle is 0.90"),
        ("step", 21.0, "longest step is 21"),
        ("view_deg", 121.0, "view is 121 degrees"),
        ("view_deg", 40.0, "view is 40 degrees"),
        ("shared", 3.0, "share 3 points"),
    ],
)
def test_each_figure_alone_is_enough_to_refuse(name: str, value: float, reason: str) -> None:
    (found,) = refusals(GOOD | {name: value}, GateConfig())
    assert reason in found


def test_the_view_of_a_calibrated_camera_is_not_judged() -> None:
    assert refusals(GOOD | {"view_deg": 30.0}, GateConfig(), calibrated=True) == ()


def test_figures_follow_from_the_geometry() -> None:
    found = figures(line())
    assert found["registered"] == 1
    assert found["gap"] == 0
    assert found["step"] == pytest.approx(1)
    assert found["shared"] == 200
    assert found["view_deg"] == pytest.approx(90)
    assert found["depth_spread"] == pytest.approx(3.9 / 2.1, rel=0.03)
    point = line().points
    first, last = point, point - [0.9, 0, 0]
    cosine = (first * last).sum(1) / np.linalg.norm(first, axis=1) / np.linalg.norm(last, axis=1)
    assert found["angle_deg"] == pytest.approx(np.degrees(np.median(np.arccos(cosine))), rel=1e-6)


def test_a_camera_that_barely_moves_has_a_small_angle() -> None:
    assert figures(line(step=0.001))["angle_deg"] < 1


def test_missing_frames_are_counted_within_and_at_the_ends() -> None:
    found = line()
    assert figures(replace(found, frames=found.frames + 1), 11)["gap"] == 11
    assert figures(replace(found, frames=found.frames * 4), 37)["gap"] == 3
    assert figures(found, 12)["gap"] == 12


def test_steps_over_missing_frames_are_per_frame() -> None:
    found = line()
    poses = found.camera_from_world.copy()
    poses[5:, 0, 3] -= 0.4
    frames = np.where(np.arange(10) >= 5, np.arange(10) + 4, np.arange(10)).astype(np.int32)
    found = replace(found, camera_from_world=poses, frames=frames)
    assert figures(found, 14)["step"] == pytest.approx(1)


def test_an_empty_reconstruction_is_refused() -> None:
    found = line()
    empty = replace(
        found, frames=found.frames[:0], camera_from_world=found.camera_from_world[:0],
        points=found.points[:0], error_px=found.error_px[:0], observed=found.observed[:0],
        observed_in=found.observed_in[:0], pixels_px=found.pixels_px[:0],
    )  # fmt: skip
    assert refusals(figures(empty), GateConfig()) == ("only 0% of the frames were registered",)
