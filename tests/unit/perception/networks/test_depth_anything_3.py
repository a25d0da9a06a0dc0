"""Calls of Depth Anything 3, with a small package that has the same interface."""

import json

import numpy as np
import pytest
import torch  # noqa: F401

from egosim_jax.geometry import invert
from egosim_jax.perception.networks.depth_anything_3 import DepthAnything3, DepthAnything3Cameras
from egosim_jax.perception.networks.worker import close_workers
from egosim_jax.perception.video.estimates import CameraEstimate, Verdict
from egosim_jax.types import InputError
from tests.scenes import pinhole
from tests.unit.perception.video.cameras import room

PACKAGE = """
from pathlib import Path
from types import SimpleNamespace
import numpy as np, torch

class DepthAnything3(torch.nn.Module):
    @classmethod
    def from_pretrained(cls, folder, *, local_files_only, strict):
        assert local_files_only and strict
        network = cls()
        network.folder = Path(folder)
        return network

    def inference(self, image, extrinsics=None, intrinsics=None, process_res=504):
        assert all(frame.dtype == np.uint8 for frame in image)
        depth = np.stack([np.full((5, 7), frame.mean()) for frame in image])
        if extrinsics is not None:  # the distance of each camera, to be seen in the result
            assert extrinsics.shape == (len(image), 4, 4) and intrinsics.shape == (len(image), 3, 3)
            depth = depth + 100 * np.linalg.norm(extrinsics[:, :3, 3], axis=1)[:, None, None]
        cameras = {"extrinsics": None, "intrinsics": None}
        if (known := self.folder / "cameras.npz").exists():  # of images of half the size
            cameras = dict(np.load(known))
            height, width = image[0].shape[:2]
            depth = np.ones((len(image), height // 2, width // 2))
        return SimpleNamespace(depth=depth, is_metric=1, **cameras)
"""
FRAMES = np.repeat(np.arange(10, dtype=np.uint8), 8 * 12 * 3).reshape(10, 8, 12, 3)
STILL = np.zeros(FRAMES.shape[:3], bool)


def estimate(step=None, *, metric=False):
    cameras = None
    if step is not None:
        poses = np.stack([np.eye(4)] * 10)
        poses[:, 0, 3] = step * np.arange(10)
        cameras = pinhole(poses, 12.0, 8, 12)
    verdict = Verdict(rung="given", reason="", figures={})
    return CameraEstimate(cameras=cameras, metric=metric, verdict=verdict)


@pytest.fixture
def network(tmp_path, monkeypatch):
    package = tmp_path / "path" / "depth_anything_3"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "api.py").write_text(PACKAGE)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "path"))
    for kind in (DepthAnything3, DepthAnything3Cameras):
        monkeypatch.setattr(kind, "packages", ("torch",))
    (tmp_path / "config.json").write_text(json.dumps({"model_name": "da3nested-giant-large"}))
    (tmp_path / "model.safetensors").write_bytes(b"weights")
    yield DepthAnything3(tmp_path, context=3)
    close_workers()


@pytest.mark.slow
def test_wanted_frames_get_depth_in_the_unit_of_moving_cameras(network):
    found = network(FRAMES, STILL, estimate(0.5), [7, 2])
    assert found.frames.tolist() == [7, 2]
    np.testing.assert_allclose(found.depth_m[:, 4, 5], [7 + 350, 2 + 100])
    assert found.depth_m.shape == (2, 8, 12)
    assert not found.metric
    for still in (estimate(), estimate(0.0)):
        found = network(FRAMES, STILL, still, [3])
        assert found.depth_m[0, 4, 5] == pytest.approx(3)
        assert found.metric


@pytest.mark.slow
def test_cameras_are_accepted_if_followed_corners_meet_in_them(network, tmp_path):
    true = room.path(9, move=np.array([0.4, 0.0, 0.1]))
    frames = room.render(true)
    still = np.zeros(frames.shape[:3], bool)
    estimator = DepthAnything3Cameras(tmp_path)
    with pytest.raises(InputError, match="gives depth alone"):
        estimator(frames, still)

    def seen(cameras):
        half = cameras.intrinsics_px.copy()
        half[:2] /= 2
        half[:2, 2] -= 0.25
        known = {
            "extrinsics": invert(cameras.world_from_camera)[:, :3],
            "intrinsics": np.repeat(half[None], len(frames), axis=0),
        }
        np.savez(tmp_path / "cameras.npz", **known)
        return estimator(frames, still)

    found = seen(true)
    assert (found.verdict.rung, found.metric) == ("network", True)
    expected = invert(true.world_from_camera[:1]) @ true.world_from_camera
    np.testing.assert_allclose(found.cameras.world_from_camera, expected, atol=1e-6)
    np.testing.assert_allclose(found.cameras.intrinsics_px, true.intrinsics_px, atol=1e-6)
    wrong = room.path(9, move=np.array([0.0, 0.4, 0.1]))
    refused = seen(wrong)
    assert refused.cameras is None
    assert "pixels, above 2" in refused.verdict.reason


def test_another_folder_and_a_missing_package_are_refused(network, monkeypatch):
    monkeypatch.setattr(DepthAnything3, "packages", ("depth_anything_3_that_is_not_there",))
    with pytest.raises(InputError, match=r"must be installed.*--no-deps depth-anything-3"):
        network(FRAMES, STILL, estimate(), [0])
    (network.folder / "config.json").write_text(json.dumps({"model_type": "depth_anything"}))
    with pytest.raises(InputError, match=r"is a checkpoint of 'depth_anything'.*model_name"):
        DepthAnything3(network.folder)
