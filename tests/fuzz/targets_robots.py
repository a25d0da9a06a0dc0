"""Fuzzing targets: MuJoCo models of robots, and described robots with their URDF and mesh."""

from __future__ import annotations

import os
import re
import zlib
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any
from unittest.mock import patch

import numpy as np
from PIL import Image

from egosim_jax.robots.drawing import Shape
from egosim_jax.robots.ik import Solver
from egosim_jax.robots.models import load_model
from egosim_jax.robots.own import load_own
from tests.fuzz.outside import STL, outside, place_special
from tests.fuzz.target import Target, pixels
from tests.unit.robots.own_arm import write_arm
from tests.unit.robots.toy import TOY, XML

ARM = replace(TOY, model=("franka_emika_panda", "panda"))
ASSETS = """<asset>
  <mesh name="m" file="m.stl"/>
  <texture name="t" type="2d" file="t.png"/>
  <texture name="u" type="2d" builtin="checker" width="8" height="8"/>
  <material name="a" texture="t" rgba="1 0 0 1"/>
  <hfield name="h" file="t.png" size="1 1 1 1"/>
  <hfield name="i" nrow="4" ncol="4" size="1 1 1 1"/>
</asset>
<include file="more.xml"/>
"""
MORE = """<mujocoinclude>
  <worldbody><geom type="mesh" mesh="m" material="a"/></worldbody>
</mujocoinclude>
"""


def make(folder: Path) -> None:
    """Write an arm with a mesh, textures, height fields and an included file."""
    model = folder / "franka_emika_panda"
    (model / "assets").mkdir(parents=True)
    text = XML.replace('"radian"/>', '"radian" meshdir="assets" texturedir="assets"/>')
    text = text.replace("<worldbody>", ASSETS + "<worldbody>")
    (model / "panda.xml").write_text(text)
    (model / "more.xml").write_text(MORE)
    (model / "assets" / "m.stl").write_bytes(STL)
    Image.fromarray(pixels(8, 8, 3)).save(model / "assets" / "t.png")


def read(folder: Path) -> Any:
    """Load the model, move it to a point and take its drawn meshes."""
    with patch.dict(os.environ, MENAGERIE_ROOT=str(folder)):
        robot = load_model(ARM)
    pose = np.eye(4)
    pose[:3, 3] = 0.2, 0.1, 0.3
    q = Solver(robot).approach(robot.home, pose, robot.largest_m, steps=2)
    meshes = Shape(robot=robot).pose(q, robot.largest_m, np.eye(4))
    return robot.positions, robot.openings_m, q.round(4), meshes


def make_own(folder: Path) -> None:
    """Write a described robot with its URDF and a mesh."""
    write_arm(folder)


def read_own(folder: Path) -> Any:
    """Load the described robot and take its drawn meshes."""
    robot = load_own(folder / "my_arm.toml").robot
    return robot.positions, robot.openings_m, Shape(robot=robot).pose(robot.home, 0.0, np.eye(4))


HUGE = (
    "3000",
    "40000",
    "2000000000",
    "99999999999",
    "-1",
    "0",
    "1e9",
    "1e308",
    "nan",
    "inf",
    "1" * 400,
)
WORDS = ("", "x", "x" * 5000, "\t", "\u00e9", "drive", "0 0", "1 1 1 1 1 1 1 1", "true", "mesh")
JOINTS = ("ball", "free", "hinge", "slide")
CHILDREN = (
    '<replicate count="{n}" offset="1 0 0"><geom size=".1 .1"/></replicate>',
    '<body><flexcomp name="f" type="grid" count="{n} {n} 1" spacing=".1 .1 .1" dim="2"/></body>',
    '<composite type="cable" count="{n} 1 1" size="1"><geom size=".01 .01"/></composite>',
    '<replicate count="{n}"><body><freejoint/><geom size=".1 .1"/></body></replicate>',
    '<body><freejoint/><geom size=".1 .1"/></body>',
    '<attach model="n" body="secret" prefix="n"/>',
    '<body name="b"><joint type="ball"/><geom size=".1 .1"/></body>',
)
PIECES = (
    '<asset><texture name="v" type="{kind}" builtin="{built}" width="{n}" height="{n}"/></asset>',
    '<asset><texture name="v" type="2d" nchannel="{n}" builtin="flat" width="9"/></asset>',
    '<asset><hfield name="v" nrow="{n}" ncol="{n}" size="1 1 1 1"/></asset>',
    '<asset><mesh name="v" builtin="sphere" params="{n}"/></asset>',
    '<asset><mesh name="v" file="{path}"/></asset>',
    '<asset><mesh name="v" content_type="model/stl" file="{path}"/></asset>',
    '<asset><texture name="v" type="cube" fileright="{path}"/></asset>',
    '<asset><hfield name="v" file="{path}" size="1 1 1 1"/></asset>',
    '<asset><model name="n" file="{path}"/></asset>',
    '<include file="{path}"/>',
    '<include file="panda.xml"/>',
    '<compiler meshdir="{path}"/>',
    '<size memory="{n}"/>',
    '<size njmax="{n}" nconmax="{n}" nuserdata="{n}"/>',
    '<deformable><skin name="s" file="{path}"/></deformable>',
    '<custom><numeric name="s" size="{n}"/></custom>',
    '<keyframe><key qpos="{n}"/></keyframe>',
    '<extension><plugin plugin="{path}"/></extension>',
)
URDF = """<robot name="r"><link name="l"><visual><geometry>
  <mesh filename="{path}"/>
</geometry></visual></link></robot>
"""
WRAPPED = (
    "{path}", "../../../../../../../../..{path}", "assets/../../../../../../../../../../..{path}",
    "file://{path}", "package://{path}", "file:{path}", "//{path}", "./{path}", "\n{path}",
    "&#x2f;{path}", "..\\..\\..\\..\\..\\..\\..\\..\\..{path}", "~{path}", "%2e%2e{path}",
)  # fmt: skip


def other_model(data: bytes, rng: Random) -> bytes:
    """Change an attribute, an element or the document of an XML file; enlarge other files."""
    text = data.decode("utf-8", "replace")
    if not text.lstrip().startswith("<"):
        return _large(data, rng)
    match rng.randrange(6):
        case 0 | 1:
            return _other_attribute(text, rng).encode()
        case 2:
            return _other_element(text, rng).encode()
        case 3:
            return _filled(URDF, rng).encode() if rng.random() < 0.1 else _document(text, rng)
        case 4:
            places = [found.end() for found in re.finditer("<worldbody>|<body[^>]*>", text)]
            return _inserted(text, rng.choice(places or [0]), CHILDREN, rng)
        case _:
            places = [found.end() for found in re.finditer("<mujoco[a-z]*>", text)]
            return _inserted(text, rng.choice(places or [0]), PIECES, rng)


def _filled(piece: str, rng: Random) -> str:
    path = rng.choice(WRAPPED).format(path=outside(rng))
    kind, built = rng.choice(("2d", "cube", "skybox")), rng.choice(("flat", "checker", "gradient"))
    return piece.format(n=rng.choice(HUGE), path=path, kind=kind, built=built)


def _inserted(text: str, place: int, pieces: tuple[str, ...], rng: Random) -> bytes:
    piece = _filled(rng.choice(pieces), rng) * rng.choice((1, 1, 1, 40))
    return (text[:place] + piece + text[place:]).encode()


def _other_attribute(text: str, rng: Random) -> str:
    spans = [found.span(2) for found in re.finditer(r'\s(\w+)="([^"]*)"', text)]
    if not spans:
        return text
    start, end = rng.choice(spans)
    if rng.random() < 0.3:
        start = text.rindex(" ", 0, start)
        return text[:start] + text[end + 1 :]
    path = rng.choice(WRAPPED).format(path=outside(rng))
    return text[:start] + rng.choice((*HUGE, *WORDS, *JOINTS, path, path, path)) + text[end:]


def _other_element(text: str, rng: Random) -> str:
    spans = [found.span() for found in re.finditer(r"<[^/][^>]*/>", text)]
    if not spans:
        return text
    start, end = rng.choice(spans)
    element = text[start:end] * rng.choice((0, 0, 2, 3000))
    if rng.random() < 0.3:
        element = text[start:end].replace("/>", f' type="{rng.choice(JOINTS)}"/>')
    return text[:start] + element + text[end:]


def _document(text: str, rng: Random) -> bytes:
    """Nest it deeply, give it a document type, another encoding, or entities."""
    match rng.randrange(5):
        case 0:
            levels = rng.choice((60, 3000, 200_000))
            deep = "<body>" * levels + '<geom size=".1 .1"/>' + "</body>" * levels
            return text.replace("<worldbody>", "<worldbody>" + deep).encode()
        case 1:
            entity = f'<!DOCTYPE mujoco [<!ENTITY e SYSTEM "{outside(rng)}">]>'
            return (entity + text.replace("base", "&e;")).encode()
        case 2:
            lines = "".join(f'<!ENTITY e{n} "{f"&e{n - 1};" * 10}">' for n in range(1, 12))
            return f'<!DOCTYPE m [<!ENTITY e0 "x">{lines}]>{text.replace("base", "&e11;")}'.encode()
        case 3:
            return text.encode(rng.choice(("utf-16", "utf-8-sig", "utf-32", "utf-7")))
        case _:
            return text.replace(
                ">", rng.choice(("><!--", "><![CDATA[", "\0>", "<", ">>")), 9
            ).encode()


def _large(data: bytes, rng: Random) -> bytes:
    """Return an image that unpacks to gigabytes, or a mesh that claims many triangles."""
    if not data.startswith(b"\x89PNG"):
        return (
            data[:80]
            + rng.choice((0, 5, 10**5, 2**31, 2**32 - 1)).to_bytes(4, "little")
            + data[84:]
        )
    side, depth, color = rng.choice(((30_000, 1, 0), (9000, 8, 6), (2**31 - 1, 16, 6), (0, 8, 2)))
    row = bytes(1 + side * depth * {0: 1, 2: 3, 6: 4}[color] // 8) if side < 10**5 else b""
    packer = zlib.compressobj(1)
    packed = b"".join(packer.compress(row) for _ in range(side if row else 0)) + packer.flush()
    header = side.to_bytes(4) * 2 + bytes([depth, color, 0, 0, 0])
    chunks = ((b"IHDR", header), (b"IDAT", packed), (b"IEND", b""))
    return data[:8] + b"".join(
        len(body).to_bytes(4) + kind + body + zlib.crc32(kind + body).to_bytes(4)
        for kind, body in chunks
    )


TARGETS: list[Target] = [
    Target(
        name="robot model",
        make=make,
        read=read,
        files=("*/*.xml", "*/*.xml", "*/assets/*"),
        lossy="a model has no checksum: another number is as good as the one before",
        mutations=(other_model,) * 8,
        rearrangements=(place_special,),
    ),
    Target(
        name="described robot",
        make=make_own,
        read=read_own,
        files=("*.urdf", "*.urdf", "*.toml", "meshes/*"),
        lossy="a model has no checksum: another number is as good as the one before",
        mutations=(other_model,) * 8,
        rearrangements=(place_special,),
    ),
]
