"""An own robot: a URDF of 7 joints with a mimic gripper, its mesh and its description."""

import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

AXES = ("0 0 1", "0 1 0", "0 0 1", "0 1 0", "0 0 1", "0 1 0", "0 0 1")
LENGTHS = (0.15, 0.1, 0.15, 0.1, 0.1, 0.1, 0.08)
JOINTS = tuple(f"j{n}" for n in range(1, 8))
MIMIC = '<mimic joint="finger1" multiplier="1"/>'
LIMIT = '<limit lower="-2.8" upper="2.8" velocity="2" effort="9"/>'
DESCRIPTION = """
model = "arm.urdf"
base = "base_link"
joints = ["j1", "j2", "j3", "j4", "j5", "j6", "j7"]

[gripper]
joints = ["finger1", "finger2"]
closing_sign = -1
largest_opening_m = 0.08
tips = [{frame = "left", offset_m = [0.0, 0.0, 0.05]}, {frame = "right_tip"}]
"""
RECORDING = """
[recording]
angle_unit = "degrees"
gripper = "gripper.pos"
gripper_closed = 0
gripper_open = 100
"""


@dataclass
class Texts:
    """Parts of the URDF, for tests that change them."""

    limits: dict[str, str] = field(default_factory=dict)
    kinds: dict[str, str] = field(default_factory=dict)
    mimic: str = MIMIC
    mesh: str = "package://my_arm/meshes/hand.stl"
    scale: str = "0.001 0.001 0.001"
    more: str = ""


def urdf(texts: Texts) -> str:
    parts = ['<link name="base_link"><visual><geometry><box size=".1 .1 .1"/></geometry></visual>'
             "</link>"]  # fmt: skip
    parent, height = "base_link", 0.1
    for joint, axis, length in zip(JOINTS, AXES, LENGTHS, strict=True):
        kind = texts.kinds.get(joint, "revolute")
        link = f"link_{joint}"
        parts.append(
            f'<link name="{link}"><collision><origin xyz="0 0 {length / 2}"/><geometry>'
            f'<cylinder radius="0.03" length="{length}"/></geometry></collision></link>'
            f'<joint name="{joint}" type="{kind}"><parent link="{parent}"/><child link="{link}"/>'
            f'<origin xyz="0 0 {height}" rpy="0.1 0 0"/><axis xyz="{axis}"/>'
            f"{texts.limits.get(joint, LIMIT)}</joint>"
        )
        parent, height = link, length
    parts.append(
        '<link name="hand"><visual><geometry>'
        f'<mesh filename="{texts.mesh}" scale="{texts.scale}"/></geometry></visual></link>'
        f'<joint name="flange" type="fixed"><parent link="{parent}"/><child link="hand"/>'
        f'<origin xyz="0 0 {height}" rpy="0 0 0.7"/></joint>'
    )
    limit = '<limit lower="0" upper="0.04" velocity="0.1" effort="9"/>'
    for number, (side, sign) in enumerate((("left", 1), ("right", -1)), start=1):
        parts.append(
            f'<link name="{side}"><collision><origin xyz="0 {sign * 0.005} 0.03"/><geometry>'
            '<box size="0.02 0.01 0.06"/></geometry></collision></link>'
            f'<joint name="finger{number}" type="prismatic"><parent link="hand"/>'
            f'<child link="{side}"/><origin xyz="0 0 0.05"/><axis xyz="0 {sign} 0"/>{limit}'
            f"{texts.mimic if number == 2 else ''}</joint>"
        )
    parts.append(
        '<link name="right_tip"/><joint name="tip" type="fixed"><parent link="right"/>'
        '<child link="right_tip"/><origin xyz="0 0 0.05"/></joint>'
    )
    return f'<?xml version="1.0"?><robot name="arm">{"".join(parts)}{texts.more}</robot>'


def write_stl(path: Path, size_mm: float = 60.0) -> None:
    """Write a box as STL, in millimeters."""
    corners = size_mm * (np.indices((2, 2, 2)).reshape(3, 8).T - 0.5)
    faces = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
             (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    body = b"".join(
        struct.pack("<12fH", 0, 0, 0, *corners[list(face)].ravel(), 0) for face in faces
    )
    path.write_bytes(bytes(80) + struct.pack("<I", len(faces)) + body)


def write_arm(folder: Path, texts: Texts | None = None, description: str = DESCRIPTION) -> Path:
    """Write the robot, and return the path of its description."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "arm.urdf").write_text(urdf(texts or Texts()))
    write_stl(folder / "meshes/hand.stl")
    path = folder / "my_arm.toml"
    path.write_text(description + '[packages]\nmy_arm = "."\n')
    return path
