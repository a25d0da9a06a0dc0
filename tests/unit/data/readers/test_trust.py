"""Unknown facts of a source are unknown in its recording, or the user is asked."""

from fractions import Fraction

import h5py
import numpy as np
import pytest

from egosim_jax.data.readers.agibot import AgiBot
from egosim_jax.data.readers.egosim import EgoSimClips
from egosim_jax.data.readers.nerfstudio import Nerfstudio
from egosim_jax.data.readers.record3d import Record3D
from tests.captures import encode
from tests.unit.data.readers import test_agibot, test_egosim, test_nerfstudio, test_record3d

PLACEHOLDERS = {
    "identity": np.eye(4),
    "origin_of_opengl": np.diag([1.0, -1, -1, 1]),
    "one_meter_up": np.array([[1.0, 0, 0, 0], [0, 1, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]]),
}


def nerfstudio(root, world):
    test_nerfstudio.write_capture(root, world)
    return Nerfstudio(source=root, fps=10.0, metric=True)


def record3d(root, world):
    test_record3d.write_capture(root.with_suffix(".r3d"), world)
    return Record3D(source=root.with_suffix(".r3d"))


def write_agibot(root, world):
    test_agibot.write_episode(root, world, parts=False)
    return AgiBot(source=root), next(root.rglob("head_color.mp4"))


def write_egosim(root, world):
    test_egosim.write_clip(root / "fold", world)
    return EgoSimClips(source=root), root / "fold/video_16fps.mp4"


@pytest.mark.parametrize("write", [nerfstudio, record3d])
@pytest.mark.parametrize("pose", PLACEHOLDERS)
def test_placeholder_poses_are_unknown(world, tmp_path, imported, write, pose):
    world.poses[:] = PLACEHOLDERS[pose]
    recording = imported(write(tmp_path / "scan", world))[0]["scan"]
    assert recording.world_from_camera is None
    assert not recording.metric
    assert "placeholders" in recording.provenance["poses"]
    np.testing.assert_allclose(recording.intrinsics_px, world.intrinsics, atol=1e-9)


@pytest.mark.parametrize("write", [nerfstudio, record3d])
def test_poses_that_jitter_are_known(world, tmp_path, imported, write):
    world.poses[:] = np.eye(4)
    world.poses[:, 0, 3] = 1e-4 * np.random.default_rng(0).normal(size=world.frames)
    recording = imported(write(tmp_path / "scan", world))[0]["scan"]
    np.testing.assert_allclose(recording.world_from_camera, world.poses, atol=1e-9)


@pytest.mark.parametrize("write", [write_agibot, write_egosim])
def test_intrinsics_of_pixels_that_are_not_square_are_ambiguous(world, tmp_path, imported, write):
    reader, video = write(tmp_path / "set", world)
    encode(video, world.video[:, :, :96], aspect=Fraction(4, 3))
    done, problems = imported(reader)
    assert not done
    assert "setsar=1" in next(iter(problems.values()))


def write_openings(root, world, values, command=None):
    test_agibot.write_episode(root, world, parts=False)
    with h5py.File(next(root.rglob("*.h5")), "a") as file:
        file["state/effector/position"][...] = values[:, None] * np.ones(2)
        if command is not None:
            file["action/effector/position"][...] = command[:, None] * np.ones(2)


RAMP = np.linspace(0, 1, 12)


@pytest.mark.parametrize(
    ("values", "command", "message"),
    [
        (RAMP, 1 - RAMP, "open_share"),
        (0 * RAMP, 1 - RAMP, "open_share"),
        (1000 * RAMP, 1 - RAMP, "at most 150"),
        (-90 * RAMP, RAMP, "open_share"),
        (100 * RAMP, 0 * RAMP, "do not move together"),
        (100 + 0 * RAMP, RAMP, "do not move together"),
        (100 * RAMP, (np.arange(12) % 2).astype(float), "do not move together"),
    ],
)
def test_openings_of_an_unknown_unit_or_sign_are_asked_for(
    world, tmp_path, imported, values, command, message
):
    write_openings(tmp_path / "set", world, values, command)
    done, problems = imported(AgiBot(source=tmp_path / "set"))
    assert not done
    assert message in next(iter(problems.values()))
    assert "--opening" in next(iter(problems.values()))


@pytest.mark.parametrize(
    ("values", "opening", "expected"),
    [
        (RAMP, "open_share", 0.12 * RAMP),
        (RAMP, "closed_share", 0.12 * (1 - RAMP)),
        (RAMP, "open_mm", 0.001 * RAMP),
        (100 * RAMP, "closed_mm", 0.12 - 0.1 * RAMP),
        (100 * RAMP, None, 0.1 * RAMP),
    ],
)
def test_openings_are_what_the_user_says(world, tmp_path, imported, values, opening, expected):
    write_openings(tmp_path / "set", world, values)
    done, problems = imported(AgiBot(source=tmp_path / "set", opening=opening))
    assert not problems
    joints = next(iter(done.values())).joints_m
    found = np.linalg.norm(joints[:, 0, 1] - joints[:, 0, 2], axis=1)
    np.testing.assert_allclose(found, expected, atol=1e-9)
