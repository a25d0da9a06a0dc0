"""Robot models read only their folder, within bounds, and name what they lack."""

import os
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mink")
pytest.importorskip("mujoco_menagerie")

from egosim_jax.robots.models import load_model
from egosim_jax.types import InputError
from tests.unit.robots.toy import TOY, XML, make_toy

FOLDER = "franka_emika_panda"
ARM = replace(TOY, model=(FOLDER, "panda"))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    (tmp_path / FOLDER / "assets").mkdir(parents=True)
    (tmp_path / "secret.xml").write_text("<mujoco/>")
    return tmp_path / FOLDER


def write(folder, text):
    (folder / "panda.xml").write_text(text)


def asset(text):
    return XML.replace("<worldbody>", f"<asset>{text}</asset><worldbody>")


def child(text):
    return XML.replace("<worldbody>", f"<worldbody>{text}")


def test_a_model_of_a_folder_is_the_compiled_one(folder):
    write(folder, XML)
    (folder / "assets" / "a.txt").write_text("")
    (folder / "link.txt").symlink_to("assets/a.txt")
    found, known = load_model(ARM), make_toy()
    np.testing.assert_array_equal(found.positions, known.positions)
    np.testing.assert_array_equal(found.mj.site_quat, known.mj.site_quat)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (XML.replace('<joint joint1="drive" joint2="follow"/>', ""), "'follow'"),
        (XML.replace('joint2="follow"', 'joint2="follow" polycoef="0 .5 0 0 0"'), "'follow'"),
        (XML.replace('"left"', '"other"'), "body 'left'"),
        (XML.replace('"palm"', '"other"'), "body 'palm'"),
        (XML.replace('"elbow"', '"other"'), "joint 'elbow'"),
        (XML.replace('<joint joint1="drive" joint2="follow"/>', "").replace("drive", "d"), "drive"),
        (XML.replace('name="roll"', 'name="roll" type="ball"'), "'roll'"),
        (child('<body><freejoint name="f"/><geom size="1 1"/></body>'), "'f'"),
        (
            child('<replicate count="501" offset="1 0 0"><geom size="1 1"/></replicate>'),
            "geometries",
        ),
        (asset('<mesh name="m" file="gone.stl"/>'), "gone.stl"),
        (XML[:-40], "panda.xml"),
        ("", "panda.xml"),
        (asset('<mesh name="m" file="../../secret.xml"/>'), "secret.xml"),
        (asset('<mesh name="m" file="..\\\\..\\\\secret.xml"/>'), "secret.xml"),
        (XML.replace("<worldbody>", '<include file="/etc/hostname"/><worldbody>'), "/etc/hostname"),
        (XML.replace('angle="radian"', 'angle="radian" meshdir="/etc"'), "meshdir"),
        ("<!DOCTYPE mujoco []>" + XML, "document type"),
        (asset('<texture name="t" type="2d" builtin="flat" width="40000" height="40000"/>'), ""),
        (asset('<hfield name="h" nrow="40000" ncol="40000" size="1 1 1 1"/>'), ""),
        (XML.replace("<worldbody>", '<size memory="100G"/><worldbody>'), ""),
    ],
)
def test_a_broken_or_hostile_model_is_refused_with_a_name(folder, text, said):
    write(folder, text)
    with pytest.raises(InputError) as caught:
        load_model(ARM)
    assert said in str(caught.value)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("kind", ["pipe", "link", "folder", "loop"])
def test_files_that_are_not_the_folders_own_are_refused(folder, kind):
    write(folder, asset('<mesh name="m" file="assets/m.stl"/>'))
    if kind == "pipe":
        os.mkfifo(folder / "assets" / "m.stl")
    elif kind == "loop":
        (folder / "assets" / "m.stl").symlink_to("m.stl")
    else:
        place = folder / "assets" / ("m.stl" if kind == "link" else "more")
        place.symlink_to("/etc/hostname" if kind == "link" else "/etc")
    with pytest.raises(InputError, match=r"regular file|link out|symbolic links"):
        load_model(ARM)


def test_an_image_that_unpacks_to_gigabytes_is_refused_within_bounds(folder):
    image = pytest.importorskip("PIL.Image")
    image.new("1", (30_000, 30_000)).save(folder / "assets" / "t.png")
    write(folder, asset('<texture name="t" type="2d" file="assets/t.png"/>'))
    with pytest.raises(InputError, match=r"memory|panda\.xml"):
        load_model(ARM)
