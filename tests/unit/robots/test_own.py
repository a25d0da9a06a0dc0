"""An own robot is read as its URDF or MJCF says, or refused before any work."""

import mujoco
import numpy as np
import pytest

pytest.importorskip("mink")
pytest.importorskip("mujoco_menagerie")

from egosim_jax.cli.__main__ import main
from egosim_jax.robots.drawing import Shape
from egosim_jax.robots.ik import posed
from egosim_jax.robots.models import grip_of
from egosim_jax.robots.own import load_own, open_robot
from egosim_jax.types import InputError
from tests.unit.robots import toy
from tests.unit.robots.own_arm import DESCRIPTION, JOINTS, LIMIT, MIMIC, Texts, urdf, write_arm

TOY_TOML = """
model = "toy.xml"
base = "base"
joints = ["yaw", "shoulder", "elbow", "roll", "wrist", "turn"]
speeds = [3, 3, 3, 3, 3, 3]

[gripper]
joints = ["drive", "follow"]
closing_sign = -1
largest_opening_m = 0.08
body = "palm"
tips = [
    {frame = "right", offset_m = [0.0, 0.0, 0.025]},
    {frame = "left", offset_m = [0.0, 0.0, 0.025]},
]
"""


def write_toy(folder, xml=toy.XML, description=TOY_TOML):
    (folder / "toy.xml").write_text(xml)
    path = folder / "toy.toml"
    path.write_text(description)
    return path


def reference_of(texts):
    """MuJoCo's own importer: another implementation, which drops mimic and folders of meshes."""
    flags = '<mujoco><compiler fusestatic="false" boundmass="1" boundinertia="1"/></mujoco>'
    spec = mujoco.MjSpec.from_string(
        urdf(texts).replace("</robot>", flags + "</robot>").replace(texts.mesh, "none.stl")
    )
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    for geom in list(spec.geoms):
        spec.delete(geom)
    return spec.compile()


def postures(mj, count=5):
    low, high = np.array([mj.joint(name).range for name in JOINTS]).T
    generator = np.random.default_rng(1)
    return [generator.uniform(np.maximum(low, -3), np.minimum(high, 3)) for _ in range(count)]


@pytest.mark.parametrize("slide", [False, True])
def test_kinematics_and_fingers_are_as_mujoco_imports_the_urdf(tmp_path, slide):
    texts = Texts()
    if slide:  # six hinges and one slide
        texts.kinds["j3"] = "prismatic"
        texts.limits["j3"] = '<limit lower="-0.1" upper="0.2" velocity="0.3"/>'
    robot = load_own(write_arm(tmp_path, texts)).robot
    assert robot.largest_m == pytest.approx(0.08, abs=1e-9)
    known = reference_of(texts)
    data = mujoco.MjData(known)
    for values in postures(robot.mj):
        for opening_m in (0.0, 0.03, 0.08):
            q = robot.home
            q[robot.joint_at] = values
            grip = grip_of(robot, posed(robot, robot.open(q, opening_m)))
            for name, value in zip(JOINTS, values, strict=True):
                data.qpos[known.joint(name).qposadr[0]] = value
            for name in ("finger1", "finger2"):
                data.qpos[known.joint(name).qposadr[0]] = opening_m / 2
            mujoco.mj_kinematics(known, data)
            right = data.body("right_tip").xpos
            left_body = data.body("left")
            left = left_body.xpos + left_body.xmat.reshape(3, 3) @ [0, 0, 0.05]
            np.testing.assert_allclose(grip[:3, 3], (left + right) / 2, atol=1e-7)
            np.testing.assert_allclose(
                grip[:3, 0] * opening_m, right - left, atol=1e-7, err_msg="from the first tip"
            )
            along = data.body("hand").xmat.reshape(3, 3)[:, 2]
            np.testing.assert_allclose(grip[:3, 2], along, atol=1e-7)


def test_a_mimic_with_another_factor_and_offset_is_an_equality(tmp_path):
    mimic = '<mimic joint="finger1" multiplier="0.9" offset="0.002"/>'
    text = DESCRIPTION.replace("= 0.08", "= 0.076")
    robot = load_own(write_arm(tmp_path, Texts(mimic=mimic), text)).robot
    at = [robot.mj.joint(name).qposadr[0] for name in ("finger1", "finger2")]
    for opening_m in np.linspace(0, robot.largest_m, 5):
        first, second = robot.open(robot.home, float(opening_m))[at]
        assert second == pytest.approx(0.9 * first + 0.002, abs=1e-6)


def test_the_frame_of_the_base_is_at_the_origin(tmp_path):
    moved = toy.XML.replace('<body name="base">', '<body name="base" pos="1 2 3" euler="0 0 1">')
    robots = []
    for name, xml in (("a", toy.XML), ("b", moved)):
        (tmp_path / name).mkdir()
        robots.append(load_own(write_toy(tmp_path / name, xml)).robot)
    first, second = (grip_of(r, posed(r, r.home)) for r in robots)
    np.testing.assert_allclose(first, second, atol=1e-9)


def test_an_mjcf_has_the_grips_of_the_same_arm_in_the_table(tmp_path):
    own, known = load_own(write_toy(tmp_path)).robot, toy.make_toy()
    assert own.largest_m == pytest.approx(known.largest_m)
    for opening_m in (0.0, 0.05):
        q = known.open(known.home, opening_m)
        mine = own.open(own.home, opening_m)
        mine[own.joint_at] = q[known.joint_at]
        np.testing.assert_allclose(
            grip_of(own, posed(own, mine)), grip_of(known, posed(known, q)), atol=1e-9
        )


def test_joints_that_rest_and_described_limits_are_taken(tmp_path):
    xml = toy.XML.replace('name="yaw" axis="0 0 1"', 'name="yaw" axis="0 0 1" limited="false"')
    text = TOY_TOML.replace('"roll", ', "").replace("3, 3, 3]", "3, 3]")
    text += "[fixed]\nroll = 0.4\n[limits]\nyaw = [-1.0, 2.0]\n"
    robot = load_own(write_toy(tmp_path, xml, text)).robot
    assert robot.home[robot.mj.joint("roll").qposadr[0]] == pytest.approx(0.4)
    assert robot.mj.joint("yaw").range.tolist() == [-1, 2]
    assert robot.home[robot.joint_at[0]] == pytest.approx(0.5)


def test_an_endless_joint_of_a_urdf_needs_no_limits(tmp_path):
    texts = Texts(kinds={"j1": "continuous"}, limits={"j1": '<limit velocity="2" effort="1"/>'})
    robot = load_own(write_arm(tmp_path, texts)).robot
    assert not robot.mj.jnt_limited[robot.mj.joint("j1").id]


def test_the_mesh_of_a_package_is_drawn_in_meters(tmp_path):
    geoms = Shape(robot=load_own(write_arm(tmp_path)).robot).geoms
    sizes = [np.ptp(vertices, axis=0) for _, (vertices, _), _ in geoms]
    assert any(np.allclose(size, 0.06, atol=1e-6) for size in sizes)
    assert len(geoms) == 11


def test_a_mesh_that_mujoco_does_not_read_is_replaced_by_the_collision_geometry(tmp_path):
    more = (
        '<link name="camera"><visual><geometry><mesh filename="meshes/c.dae"/></geometry></visual>'
        '<collision><geometry><sphere radius="0.01"/></geometry></collision></link>'
        '<joint name="cam" type="fixed"><parent link="hand"/><child link="camera"/></joint>'
    )
    path = write_arm(tmp_path, Texts(more=more))
    (tmp_path / "meshes/c.dae").write_text("<COLLADA/>")
    own = load_own(path)
    assert len(Shape(robot=own.robot).geoms) == 12
    assert own.replaced == ("camera",)
    (tmp_path / "arm.urdf").write_text(urdf(Texts(more=more.replace("collision>", "nothing>"))))
    with pytest.raises(InputError, match="no collision geometry"):
        load_own(path)


BROKEN_URDF = {
    "no mimic": (Texts(mimic=""), "an equality of 'finger2'"),
    "no limits": (Texts(limits={"j2": "", "j5": '<limit velocity="1"/>'}), "of 'j2'; 'j5'"),
    "no speed": (Texts(limits={"j2": LIMIT.replace("velocity", "speed")}), "(speeds)"),
    "no mesh": (Texts(mesh="package://my_arm/meshes/gone.stl"), "meshes/gone.stl"),
    "no package": (Texts(mesh="package://other/hand.stl"), "package 'other'"),
    "a mesh elsewhere": (Texts(mesh="../../secret.stl"), "outside of its folder"),
    "a mesh in millimeters": (Texts(scale="1 1 1"), "0.001 0.001 0.001"),
    "a floating joint": (Texts(kinds={"j4": "floating"}), "'floating'"),
    "a mimic of nothing": (Texts(mimic='<mimic joint="finger"/>'), "Did you mean 'finger1'"),
    "a mimic of the arm": (Texts(mimic='<mimic joint="j2"/>'), "finger2"),
    "an arm's mimic": (Texts(limits={"j3": f'{LIMIT}<mimic joint="j2"/>'}), "equality"),
    "another joint": (
        Texts(more='<link name="x"/><joint name="lift" type="prismatic"><parent link="hand"/>'
                   '<child link="x"/></joint>'),
        "'lift'",
    ),
    "two roots": (Texts(more='<link name="x"/>'), "2 links that hang on no joint"),
    "a loop": (Texts(more='<joint name="l" type="fixed"><parent link="left"/><child link="right"/>'
                          "</joint>"), "hangs on two joints"),
    "a xacro": (Texts(more="<xacro:macro/>"), "xacro"),
    "words": (Texts(limits={"j1": '<limit lower="a" upper="1"/>'}), "lower is 'a'"),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN_URDF)
def test_a_urdf_that_would_be_wrong_is_refused_with_the_name(tmp_path, case):
    texts, said = BROKEN_URDF[case]
    path = write_arm(tmp_path, texts)
    with pytest.raises(InputError) as caught:
        load_own(path)
    assert said in str(caught.value)
    assert str(caught.value).isprintable()


def test_an_arm_in_millimeters_is_refused(tmp_path):
    text = urdf(Texts(scale="1 1 1")).replace('upper="0.04"', 'upper="40"')
    for number in ("0.05", "0.1", "0.15", "0.08", "0.03", "0.02", "0.01", "0.06"):
        text = text.replace(f' {number}"', f' {1000 * float(number):g}"')
    path = write_arm(tmp_path, description=DESCRIPTION.replace("0.05]", "50]"))
    (tmp_path / "arm.urdf").write_text(text)
    with pytest.raises(InputError, match="millimeters"):
        load_own(path)


WRONG = {
    "closing_sign = -1": ("closing_sign = 1", "closing_sign must be -1"),
    "largest_opening_m = 0.08": ("largest_opening_m = 0.1", "open by 80 mm"),
    '"j4", "j5"': ('"j5", "j4"', "from base to wrist"),
    '"j7"]': ('"j8"]', "Did you mean 'j7'"),
    '["finger1", "finger2"]': ('["finger1"]', "'finger2'"),
    '{frame = "right_tip"}': ('{frame = "right_tips"}', "Did you mean 'right_tip'"),
    'base = "base_link"': ('base = "link_j2"', "moves with the joint"),
    "offset_m = [0.0, 0.0, 0.05]": ("offset_m = [0.0, 0.02, 0.05]", ""),
    "[gripper]": ("colors = 1\n[gripper]", "colors"),
    'joints = ["j1"': ('home = [9, 0, 0, 0, 0, 0, 0]\njoints = ["j1"', "(home)"),
    'model = "arm.urdf"': ('model = "gone.urdf"', "gone.urdf is missing"),
    "largest_opening_m": ("largest_opening", "no gripper.largest_opening_m"),
}


@pytest.mark.parametrize("right", WRONG)
def test_a_description_that_contradicts_its_model_is_refused(tmp_path, right):
    wrong, said = WRONG[right]
    assert right in DESCRIPTION
    path = write_arm(tmp_path, description=DESCRIPTION.replace(right, wrong))
    if right.startswith("offset"):  # a tip off the finger's middle changes no opening
        assert load_own(path).robot.largest_m == pytest.approx(0.08)
        return
    with pytest.raises(InputError) as caught:
        load_own(path)
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("xml", "said"),
    [
        (toy.XML.replace('<joint joint1="drive" joint2="follow"/>', ""), "'follow'"),
        (toy.XML.replace('joint2="follow"', 'joint2="follow" polycoef="0 .5 0 0 0"'), "'follow'"),
        (
            toy.XML.replace("<equality>", '<equality><joint joint1="elbow" joint2="shoulder"/>'),
            "does not hold",
        ),
        (
            toy.XML.replace(
                "<worldbody>",
                '<asset><mesh name="a" file="one.stl"/><mesh name="b" file="two.stl"/></asset>'
                "<worldbody>",
            ),
            "'one.stl'; 'two.stl'",
        ),
        (toy.XML.replace('<joint range="-2.8 2.8"/>', ""), "no limits of 'yaw'"),
        (toy.XML.replace("<worldbody>", '<include file="/etc/hostname"/><worldbody>'), "hostname"),
        (toy.XML.replace('name="roll"', 'name="roll" type="ball"'), "'roll'"),
        ("<sdf/>", "<sdf>"),
        ("<mujoco", "not valid XML"),
    ],
)
def test_an_mjcf_that_would_be_wrong_is_refused(tmp_path, xml, said):
    with pytest.raises(InputError) as caught:
        load_own(write_toy(tmp_path, xml))
    assert said in str(caught.value)


def test_the_check_prints_what_was_found(tmp_path, capsys):
    assert main(["robot", "check", str(write_arm(tmp_path))]) == 0
    said = capsys.readouterr().out
    for text in ("7 joints", "finger2: slide, follows", "opens by 80.0 mm", "1 meshes"):
        assert text in said
    path = write_arm(tmp_path, Texts(mimic=MIMIC.replace("1", "2")))
    assert main(["robot", "check", str(path)]) == 2


def test_a_robot_has_a_name_of_the_table_or_a_file(tmp_path):
    assert open_robot(str(write_arm(tmp_path))).arm.name == "my_arm"
    with pytest.raises(InputError, match="Did you mean 'panda'"):
        open_robot("pandas")
