"""Depth and cameras from files of another program, at the size of the video."""

import numpy as np
import pytest

from egosim_jax.geometry import invert, look_at, pixel_rays, project, transform
from egosim_jax.perception.networks.depth_files import DepthFiles
from egosim_jax.types import InputError
from tests.unit.perception.posed import UNKNOWN_CAMERAS

HEIGHT, WIDTH, FRAMES = 8, 12, 3
SMALL = np.array([[5.0, 0, 2.5], [0, 5, 1.5], [0, 0, 1]])
POSES = np.stack(
    [look_at(np.array([0.1 * k, 0, -1.0]), np.zeros(3), up=np.array([0, 1.0, 0])) for k in range(3)]
)


@pytest.fixture
def folder(tmp_path):
    for frame in range(FRAMES):
        depth = np.full((HEIGHT // 2, WIDTH // 2), 1.0 + frame, np.float32)
        depth[0, 0], depth[0, 1] = 0, np.nan
        np.save(tmp_path / f"depth_{frame:06d}.npy", depth)
        np.save(tmp_path / f"intrinsics_{frame:06d}.npy", SMALL.astype(np.float32))
        np.save(tmp_path / f"extrinsics_{frame:06d}.npy", invert(POSES[frame])[:3])
    return tmp_path


def read(folder, wanted=(0,)):
    frames = np.zeros((FRAMES, HEIGHT, WIDTH, 3), np.uint8)
    return DepthFiles(folder)(frames, frames[..., 0] > 0, UNKNOWN_CAMERAS, wanted)


def test_depth_is_resized_and_unknown_pixels_stay_unknown(folder):
    found = read(folder, [2, 0])
    assert found.metric
    assert found.depth_m.shape == (2, HEIGHT, WIDTH)
    assert found.depth_m[:, 4, 4].tolist() == [3, 1]
    assert not np.isfinite(found.depth_m[:, :2, :4]).any()
    np.testing.assert_array_equal(found.confident, np.isfinite(found.depth_m))


def test_cameras_see_the_same_directions_in_the_larger_image(folder):
    found = DepthFiles(folder).cameras(FRAMES, height=HEIGHT, width=WIDTH).cameras
    np.testing.assert_allclose(found.world_from_camera, POSES, atol=1e-6)
    edge = transform(np.eye(4), np.array([[-2.5 - 0.5, -1.5 - 0.5, 5.0]]))  # the outer corner
    u, v = project(found.intrinsics_px, edge)
    np.testing.assert_allclose([u[0], v[0]], [-0.5, -0.5], atol=1e-6)
    rays = pixel_rays(found.intrinsics_px, height=HEIGHT, width=WIDTH)
    small = pixel_rays(SMALL, height=HEIGHT // 2, width=WIDTH // 2)
    np.testing.assert_allclose(
        rays.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean((1, 3)), small, atol=1e-6
    )


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (None, "cannot be read"),
        (np.zeros(3), r"\(height, width\)"),
        (np.array([["a"]]), "not an array of numbers"),
        (b"\x93NUMPY\x03", "not an array of numbers"),
    ],
)
def test_other_files_are_refused(folder, value, message):
    path = folder / "depth_000000.npy"
    if value is None:
        path.unlink()
    elif isinstance(value, bytes):
        path.write_bytes(value)
    else:
        np.save(path, value)
    with pytest.raises(InputError, match=message):
        read(folder)


def test_a_pickle_is_refused(folder):
    np.save(folder / "depth_000000.npy", np.array([[{}]]), allow_pickle=True)
    with pytest.raises(InputError, match="not an array of numbers"):
        read(folder)


def test_cameras_of_another_shape_are_refused(folder):
    np.save(folder / "intrinsics_000001.npy", np.ones(4))
    with pytest.raises(InputError, match=r"frame 1 have the shapes \(4,\)"):
        DepthFiles(folder).cameras(FRAMES, height=HEIGHT, width=WIDTH)
