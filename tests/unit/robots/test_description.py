"""Descriptions of robots: the documented ones are read, and unclear ones are refused by name."""

import re
from pathlib import Path

import pytest

from egosim_jax.robots.description import read_description
from egosim_jax.types import InputError
from tests.unit.robots.own_arm import DESCRIPTION, RECORDING

PAGE = Path(__file__).parents[3] / "docs" / "robot.md"


def read(folder, text):
    path = folder / "arm.toml"
    path.write_text(text)
    return read_description(path)


def test_the_documented_description_is_read(tmp_path):
    blocks = re.findall(r"^```toml\n(.*?)^```", PAGE.read_text("utf-8"), re.M | re.S)
    assert len(blocks) == 2
    described = read(tmp_path, "\n".join(blocks))
    assert described.title == "SO-101"
    assert described.model == tmp_path / "so101_new_calib.urdf"
    assert described.gripper.tips[0].offset_m == (-0.01, -0.075, 0.019)
    assert described.gripper.tips[1].offset_m == (0.0, 0.0, 0.0)
    assert described.recording is not None
    assert described.recording.angle_unit == "degrees"
    assert described.camera is not None
    assert described.camera.base_from_camera[2, 3] == 0.5


def test_defaults_are_the_files_name_and_folder(tmp_path):
    described = read(tmp_path, DESCRIPTION)
    assert (described.name, described.title, described.speeds) == ("arm", "arm", ())
    assert described.camera is None
    assert described.gripper.speed_m_s == 0.1


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        ("closing_sign = -1", "closing_sign = 0.5", "closing_sign is 0.5"),
        ("closing_sign = -1", "closing_sign = true", "closing_sign is True"),
        ("= 0.08", "= 0", "largest_opening_m is 0"),
        ("= 0.08", "= nan", "largest_opening_m is nan"),
        ('"j7"]', '"j6"]', "different names"),
        ('"j7"]', '"finger1"]', "'finger1' more than once"),
        ('"j7"]', '"j7"]\nspeeds = [1.0]', "speeds is a list of 1: it must be a list of 7"),
        ('"j7"]', '"j7"]\nlimits = 3', "limits is 3"),
        ("tips =", "tip =", "no gripper.tips"),
        (', {frame = "right_tip"}', "", "two tables"),
        ("frame =", "link =", "no gripper.tips[0].frame"),
        ("base =", "Base =", "has no base"),
        ("[gripper]", "[gripper]\napproach = [0, 0, 0]", "approach is 0"),
        ("[gripper]", "[limits]\nj1 = [2, 1]\n[gripper]", "limits.j1"),
        ("[gripper]", "gripper = ", "not valid TOML"),
        ("[gripper]", f"{RECORDING.replace('degrees', 'deg')}\n[gripper]", "angle_unit is 'deg'"),
        ("[gripper]", f"{RECORDING.replace('100', '0')}\n[gripper]", "gripper_open is 0"),
    ],
)
def test_a_wrong_value_is_named(tmp_path, right, wrong, said):
    assert right in DESCRIPTION
    with pytest.raises(InputError) as caught:
        read(tmp_path, DESCRIPTION.replace(right, wrong, 1))
    assert said in str(caught.value)
    assert str(caught.value).isprintable()


def test_bytes_that_are_no_text_are_refused(tmp_path):
    (tmp_path / "a.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="not valid TOML"):
        read_description(tmp_path / "a.toml")
    (tmp_path / "b.toml").write_text("a = " + "[" * 100_000)
    with pytest.raises(InputError):
        read_description(tmp_path / "b.toml")
