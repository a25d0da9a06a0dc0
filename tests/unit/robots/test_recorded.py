"""Recorded joints of an own robot become actions of its gripper in the frame of its base.

The dataset is rendered here: a table, a box and the moving arm, in a camera whose pose is known.
"""

import json
import shutil
from dataclasses import replace

import mujoco
import numpy as np
import pytest

pytest.importorskip("mink")
pytest.importorskip("mujoco_menagerie")
import pyarrow as pa
import pyarrow.parquet as pq

from egosim_jax.cli.__main__ import main
from egosim_jax.data.lerobot_writer import ClipRecord, EpisodeRecord, write_lerobot
from egosim_jax.geometry import invert, look_at, pixel_rays
from egosim_jax.perception.video.estimates import DepthEstimate
from egosim_jax.robots.description import read_description
from egosim_jax.robots.drawing import Shape, draw
from egosim_jax.robots.first_scene import estimate_depth, robot_depth, without_robot
from egosim_jax.robots.own import load_own
from egosim_jax.robots.recorded import episode_of, open_replay
from egosim_jax.simulation.episode import Episode
from egosim_jax.state.depth import state_from_depth
from egosim_jax.types import Action, Cameras, InputError, VideoSpec
from tests.unit.robots.own_arm import DESCRIPTION, JOINTS, RECORDING, Texts, write_arm
from tests.unit.robots.test_own import reference_of

WIDTH, HEIGHT, FPS, COUNT = 96, 64, 16, 17
POSE = look_at(np.array([1.2, -0.5, 0.7]), np.array([0.2, 0.0, 0.3]), up=np.array([0.0, 0.0, 1.0]))
MATRIX = np.array([[70.0, 0.0, 47.5], [0.0, 70.0, 31.5], [0.0, 0.0, 1.0]])
SPEC = VideoSpec(frames=5, height=32, width=48, fps=8)
NAMES = [*(f"{joint}.pos" for joint in JOINTS), "gripper.pos"]
BOX = np.array([0.45, -0.15, 0.0]), np.array([0.55, -0.05, 0.12])


def camera_toml(pose=POSE, width=WIDTH):
    return (
        f"[camera]\nbase_from_camera = {pose.tolist()}\nintrinsics_px = {MATRIX.tolist()}\n"
        f"width = {width}\nheight = {HEIGHT}\n"
    )


def cameras(count=1):
    return Cameras(
        world_from_camera=np.tile(POSE, (count, 1, 1)), intrinsics_px=MATRIX,
        height=HEIGHT, width=WIDTH,
    )  # fmt: skip


def scene():
    """Image and depth of the table and a red box on it."""
    rays = pixel_rays(MATRIX, height=HEIGHT, width=WIDTH)
    towards, eye = rays @ POSE[:3, :3].T, POSE[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        table = np.where(towards[..., 2] < 0, -eye[2] / towards[..., 2], np.inf)
        ends = (np.stack(BOX)[:, None, None] - eye) / towards
    near, far = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
    hit = (near < far) & (near < table)
    depth = np.where(hit, near, table)
    depth = np.where(depth < 4, depth, np.inf).astype(np.float32)
    points = eye + towards * np.where(np.isfinite(depth), depth, 0)[..., None]
    checks = (np.floor(points[..., :2] / 0.1).sum(axis=-1) % 2)[..., None] * 60 + 120
    image = np.where(hit[..., None], [200, 40, 30], checks).astype(np.uint8)
    return image, depth


def motion():
    """Joint positions in radians, and openings as a share, of each frame."""
    t = np.linspace(0, 1, COUNT)[:, None]
    start = np.array([0.1, 0.5, 0.0, 0.9, 0.1, 0.6, 0.0])
    return start + t * np.array([-0.4, 0.1, 0.1, 0.2, -0.1, 0.3, 0.4]), 1 - 0.8 * t[:, 0]


def expected(joints, share):
    """Tips by MuJoCo's own importer of the URDF."""
    known = reference_of(Texts())
    data, tips = mujoco.MjData(known), []
    for values, part in zip(joints, share, strict=True):
        for name, value in zip(JOINTS, values, strict=True):
            data.qpos[known.joint(name).qposadr[0]] = value
        for name in ("finger1", "finger2"):
            data.qpos[known.joint(name).qposadr[0]] = 0.04 * part
        mujoco.mj_kinematics(known, data)
        left = data.body("left")
        tips.append([left.xpos + left.xmat.reshape(3, 3) @ [0, 0, 0.05],
                     data.body("right_tip").xpos.copy()])  # fmt: skip
    return np.array(tips)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Folder with a robot, a dataset of it, and the depth of its first frame."""
    folder = tmp_path_factory.mktemp("robot")
    path = write_arm(folder, description=DESCRIPTION + RECORDING + camera_toml())
    own = load_own(path)
    robot = own.robot
    joints, share = motion()
    q = np.tile(robot.home, (COUNT, 1))
    q[:, robot.joint_at] = joints
    shape = Shape(robot=robot)
    meshes = [
        shape.pose(values, float(part) * robot.largest_m, np.eye(4))
        for values, part in zip(q, share, strict=True)
    ]
    image, depth = scene()
    drawn = draw(
        np.tile(image, (COUNT, 1, 1, 1)), np.tile(depth, (COUNT, 1, 1)), cameras(COUNT), meshes,
        [color for _, _, color in shape.geoms], world_from_up=np.eye(4),
    )  # fmt: skip
    rows = np.concatenate([np.degrees(joints), 100 * share[:, None]], axis=1)
    action = Action(
        cameras=cameras(COUNT), joints_m=np.full((COUNT, 1, 3, 3), np.nan), kind="robot",
        prompt="Reach for the box.",
    )  # fmt: skip
    clip = ClipRecord(frames=drawn.frames, rows=rows, action=action)
    episode = EpisodeRecord(clips=[clip], save_scene=lambda _: None)
    write_lerobot(folder / "set", [episode], names=NAMES, fps=FPS, robot_type="my_arm")
    np.savez(folder / "depth.npz", depth_m=drawn.depth_m[0])
    return folder, drawn, own


def replay_of(recorded, **options):
    return open_replay(recorded[0] / "set", 0, recorded[2], **options)


def replay_as(recorded, tmp_path, text):
    """The motion by the same model, with another description of camera and recording."""
    path = write_arm(tmp_path, description=text)
    own = replace(recorded[2], description=read_description(path))
    return open_replay(recorded[0] / "set", 0, own)


def test_the_keypoints_are_the_tips_of_the_urdf_and_the_video_is_the_target(recorded):
    folder, drawn, _ = recorded
    replay = replay_of(recorded)
    robot_m = robot_depth(replay)
    image, mask = without_robot(replay, robot_m)
    depth = np.where(mask, np.nan, np.load(folder / "depth.npz")["depth_m"])
    state = state_from_depth(image, depth, MATRIX, POSE)
    episode = episode_of(replay, SPEC, state, first_frame=image)
    assert len(episode.actions) == 2
    tips = expected(*motion())
    for number, action in enumerate(episode.actions):
        at = 2 * np.arange(4 * number, 4 * number + 5)
        np.testing.assert_allclose(action.joints_m[:, 0, 1:], tips[at], atol=1e-4)
        assert (action.kind, action.prompt) == ("robot", "Reach for the box.")
        np.testing.assert_allclose(action.cameras.world_from_camera[0], POSE)
        shown = episode.ground_truth[number].frames
        halves = drawn.frames[at].reshape(5, 32, 2, 48, 2, 3).mean(axis=(2, 4))
        assert np.abs(shown - halves).mean() < 4


def test_the_robot_is_where_the_video_shows_it_and_is_removed_from_the_scene(recorded):
    _, drawn, _ = recorded
    replay = replay_of(recorded)
    robot_m = robot_depth(replay)
    np.testing.assert_array_equal(np.isfinite(robot_m) & (robot_m < drawn.depth_m[0] + 1e-4),
                                  drawn.mask[0])  # fmt: skip
    image, mask = without_robot(replay, robot_m)
    assert mask[drawn.mask[0]].all()
    assert np.array_equal(image[~mask], drawn.frames[0][~mask])


def test_commands_are_for_the_next_frame(recorded):
    """The writer's action is the row of the next frame, so both columns give one motion."""
    measured, commanded = replay_of(recorded), replay_of(recorded, column="action")
    np.testing.assert_allclose(measured.base_from_grip, commanded.base_from_grip, atol=1e-6)


def test_estimated_depth_gets_its_scale_from_the_robot(recorded):
    _, drawn, _ = recorded
    replay = replay_of(recorded)

    def estimator(frames, moving, estimate, wanted):
        return DepthEstimate.measured(wanted, 3.7 * drawn.depth_m[:1], metric=False)

    depth = estimate_depth(replay, robot_depth(replay), estimator, name="network")
    known = np.isfinite(drawn.depth_m[0])
    np.testing.assert_allclose(depth[known], drawn.depth_m[0][known], rtol=0.01)


def test_the_command_writes_an_episode_that_is_simulated_and_scored(recorded, tmp_path, capsys):
    folder, *_ = recorded
    out = tmp_path / "episode"
    args = ["robot", "actions", str(folder / "set"), "--robot", str(folder / "my_arm.toml")]
    args += ["--depth", str(folder / "depth.npz"), "--config", "debug", "--out", str(out)]
    assert main(args) == 0
    said = capsys.readouterr().out
    assert "the robot covers" in said
    episode = Episode.load(out)
    assert episode.ground_truth
    assert episode.video == VideoSpec(frames=9, height=64, width=96, fps=16)
    table = episode.state.points_m[episode.state.object_ids == 0]
    assert np.median(np.abs(table[:, 2])) < 0.01
    box = episode.state.points_m[episode.state.object_ids > 0]
    low, high = BOX
    assert len(box)
    assert ((box > low - 0.03) & (box < high + 0.03)).all(axis=1).mean() > 0.95
    run = tmp_path / "run"
    assert main(["simulate", "--episode", str(out), "--config", "preview", "--out", str(run)]) == 0
    report = json.loads((run / "report.json").read_text())
    assert "psnr" in json.dumps(report)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (('angle_unit = "degrees"', 'angle_unit = "radians"'), 'angle_unit = "degrees"'),
        (("gripper_open = 100", "gripper_open = 1"), "gripper_open"),
        (('gripper = "gripper.pos"', 'gripper = "grip.pos"'), "Did you mean 'gripper.pos'"),
        (
            ("[recording]", '[recording]\nnames = ["a", "b", "c", "d", "e", "f", "g"]'),
            "no value 'a'",
        ),
        (("[recording]", '[recording]\ncamera = "front"'), "observation.images.ego"),
        (("width = 96", "width = 640"), "described for 640x64"),
        ((camera_toml(), ""), "no table [camera]"),
        ((RECORDING, ""), "no table [recording]"),
        ((camera_toml(), camera_toml(invert(POSE))), "With its inverse"),
        ((camera_toml(), camera_toml(POSE @ np.diag([1.0, -1, -1, 1]))), "OpenGL"),
        ((camera_toml(), camera_toml(2 * POSE)), "rigid"),
    ],
)
def test_what_the_dataset_contradicts_is_refused(recorded, tmp_path, change, said):
    text = DESCRIPTION + RECORDING + camera_toml()
    assert change[0] in text
    with pytest.raises(InputError) as caught:
        replay_as(recorded, tmp_path, text.replace(*change))
    assert said in str(caught.value)
    assert str(caught.value).isprintable()


def test_radians_that_are_called_degrees_are_refused(recorded, tmp_path):
    folder = recorded[0]
    copied = tmp_path / "set"
    shutil.copytree(folder / "set", copied)
    path = next((copied / "data").rglob("*.parquet"))
    table = pq.read_table(path)
    for name in ("observation.state", "action"):
        rows = np.array(table[name].to_pylist())
        rows[:, :-1] = np.radians(rows[:, :-1])
        column = pa.array(rows.tolist(), table[name].type)
        table = table.set_column(table.schema.get_field_index(name), name, column)
    pq.write_table(table, path)
    with pytest.raises(InputError, match="seem to be radians"):
        open_replay(copied, 0, recorded[2])


def test_depth_that_contradicts_the_robot_is_refused(recorded, tmp_path, capsys):
    folder, drawn, _ = recorded
    np.savez(tmp_path / "far.npz", depth_m=10 * drawn.depth_m[0])
    args = ["robot", "actions", str(folder / "set"), "--robot", str(folder / "my_arm.toml")]
    args += ["--config", "debug", "--out", str(tmp_path / "episode"), "--depth"]
    assert main([*args, str(tmp_path / "far.npz")]) == 2
    assert "10 times the distance" in capsys.readouterr().err
    assert main(args[:-1]) == 2
    assert not (tmp_path / "episode").exists()
