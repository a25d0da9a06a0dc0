"""The classical estimators on a video of a textured room with known cameras."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from egosim_jax.annotate.clip import ANNOTATION
from egosim_jax.annotate.config import AnnotateConfig, Estimators
from egosim_jax.data.clips import check_clip
from egosim_jax.data.metadata import read_metadata
from egosim_jax.geometry import umeyama
from egosim_jax.io.bounded import read_json
from egosim_jax.io.untrusted.npz import read_arrays
from egosim_jax.io.video import read_video
from tests.unit.annotate.stubs import StubHands, write
from tests.unit.annotate.test_run import annotate
from tests.unit.perception.video.cameras import room

ARRAYS = {"world_from_camera": "float64", "intrinsics_px": "float64", "joints_m": "float64"}


@dataclass(frozen=True, kw_only=True)
class RoomConfig(AnnotateConfig):
    """The real estimators, except for hands: the room shows no hands."""

    def build(self) -> Estimators:
        """Return the estimators."""
        return replace(super().build(), hands=StubHands(1.0, None))


@pytest.mark.slow
def test_cameras_depth_and_prior_of_a_moving_camera_are_right(tmp_path):
    cameras = room.path(21, move=np.array([0.5, 0.1, 0.2]), turn_deg=np.array([0.0, -8.0, 0.0]))
    path = write(tmp_path / "room.mp4", room.render(cameras))
    out = tmp_path / "out"
    report = annotate([path], out, RoomConfig())
    assert report["clips"]["done"] == 1, report["annotations"]
    (files,) = read_metadata(out / "metadata.csv")
    assert check_clip(files, None) == []
    about = read_json(out / "room" / ANNOTATION)
    assert about["cameras"]["rung"] == "incremental"
    assert about["cameras"]["focal_px"] == pytest.approx(room.FOCAL, rel=0.05)
    found = read_arrays(out / "room/action.npz", ARRAYS)["world_from_camera"]
    centers, true = found[:, :3, 3], cameras.world_from_camera[:, :3, 3]
    motion = umeyama(centers, true, scaled=True)
    aligned = centers @ motion[:3, :3].T + motion[:3, 3]
    assert np.linalg.norm(aligned - true, axis=1).max() < 0.02 * np.ptp(true, axis=0).max()
    assert about["prior"]["seen"] > 0.8
    gain = about["prior"]["psnr_background"] - about["prior"]["psnr_first_frame"]
    assert gain > 4
    still = read_video(path).frames
    repeated = ((still[1:].astype(float) - still[0]) ** 2).mean(axis=(1, 2, 3))
    assert about["prior"]["psnr_first_frame"] == pytest.approx(
        10 * np.log10(255**2 / repeated).mean(), abs=1.5
    )


@pytest.mark.slow
def test_a_fixed_camera_is_static_and_its_prior_is_the_first_frame(tmp_path):
    frames = np.repeat(room.render(room.path(1)), 17, axis=0)
    frames[:, 120:220, 20:130] = np.random.default_rng(0).integers(0, 255, (17, 100, 110, 3))
    path = write(tmp_path / "still.mp4", frames)
    report = annotate([path], tmp_path / "out", RoomConfig())
    assert report["clips"]["done"] == 1, report["annotations"]
    about = report["annotations"][0]
    assert about["cameras"]["rung"] == "static"
    prior = read_video(tmp_path / "out/still/ego_prior_video.mp4").frames
    assert np.abs(prior[-1].astype(int) - prior[0]).mean() < 1
