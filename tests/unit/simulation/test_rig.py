"""Cameras fixed in the world, on the head and on wrists."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.rendering.hand_mesh import REST_MM
from egosim_jax.simulation.actions import FullAction
from egosim_jax.simulation.rig import MountedCamera, Rig, wrist_poses
from egosim_jax.types import Action, InputError
from tests.painted import SIDE, VIDEO, WRIST, painted

ROWS = np.array([[0.1, 0.2, 0.15, -0.5, 0.3, 0.4, closure] for closure in (0, 0.4, 0.8)])
LENS = {"field_of_view_deg": 90}


def camera(**changes):
    return MountedCamera(**{"name": "a", "mount": "right_wrist", "pose": WRIST, **changes})


def action_of(spec, rows=ROWS):
    start = painted().start(3, ActionSpec())
    return spec.to_action(rows, camera=start.camera, prompt="")[0]


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("layout", ["wrist", "gripper"])
def test_the_pose_of_a_wrist_follows_from_its_joints(layout, side):
    spec = ActionSpec(layout=layout, sides=(side,))
    poses = wrist_poses(spec.joints(ROWS)[:, 0], spec.kind, side)
    np.testing.assert_allclose(poses, spec.wrists(ROWS)[:, 0], atol=1e-6)
    if layout == "wrist":
        keypoints = ActionSpec(layout="keypoints", sides=(side,))
        rows = spec.joints(ROWS).reshape(len(ROWS), -1)
        np.testing.assert_allclose(keypoints.wrists(rows)[:, 0], poses, atol=1e-6)


def test_a_hand_at_rest_points_along_y_with_its_back_up():
    for side, mirror in (("right", 1.0), ("left", -1.0)):
        joints = REST_MM[None] / 1000 * [mirror, 1, 1]
        np.testing.assert_allclose(wrist_poses(joints, "human", side)[0], np.eye(4), atol=1e-9)


def test_a_gripper_that_closes_keeps_its_direction():
    spec = ActionSpec(layout="gripper")
    rows = ROWS.copy()
    rows[:, 6] = (0, 1, 1)
    poses = wrist_poses(spec.joints(rows)[:, 0], "robot", "right")
    np.testing.assert_allclose(poses, spec.wrists(rows)[:, 0], atol=1e-6)
    with pytest.raises(InputError, match="closed in all frames"):
        wrist_poses(spec.joints(rows[1:])[:, 0], "robot", "right")


def test_cameras_move_with_what_carries_them():
    spec = ActionSpec(sides=("left", "right"), camera=True)
    rows = np.concatenate([ROWS * [-1, 1, 1, 1, 1, 1, 1], ROWS, np.zeros((3, 6))], axis=1)
    rows[:, 14] = (0, 0.02, 0.04)
    action = action_of(spec, rows)
    mounted = tuple(
        camera(name=f"on_{mount}", mount=mount, pose=pose)
        for mount, pose in (("world", SIDE), ("head", WRIST), ("right_wrist", WRIST))
    )
    rig = Rig(cameras=mounted, sides=spec.sides, wrists=spec.wrists(rows))
    paths = {name: a.cameras.world_from_camera for name, a in rig.actions(action).items()}
    np.testing.assert_array_equal(paths["on_world"], np.repeat(SIDE[None], 3, axis=0))
    np.testing.assert_allclose(paths["on_head"], action.cameras.world_from_camera @ WRIST)
    np.testing.assert_allclose(paths["on_right_wrist"], spec.wrists(rows)[:, 1] @ WRIST)
    later = rig.actions(action_of(spec, rows[1:]), 1)["on_right_wrist"]
    np.testing.assert_array_equal(later.cameras.world_from_camera, paths["on_right_wrist"][1:])
    estimated = replace(rig, wrists=None).actions(action)["on_right_wrist"]
    np.testing.assert_allclose(
        estimated.cameras.world_from_camera, paths["on_right_wrist"], atol=1e-6
    )


def test_a_camera_sees_a_hand_that_the_head_does_not():
    spec = ActionSpec(workspace_m=((-2, -2, -2), (2, 2, 2)))
    rows = ROWS + [0, -1.5, 0, 0, 0, 0, 0]
    action = action_of(spec, rows)
    assert isinstance(action, FullAction)
    assert np.isnan(action.joints_m).all()
    seen = Rig(cameras=(camera(**LENS),)).actions(action)["a"]
    assert np.isfinite(seen.joints_m).all()
    gone = Action(cameras=action.cameras, joints_m=action.joints_m, kind="human", prompt="")
    with pytest.raises(InputError, match="missing from frame 0"):
        Rig(cameras=(camera(),)).actions(gone)


def test_the_lens_is_the_main_cameras_or_a_given_one():
    main = painted().start(3, ActionSpec()).camera
    mount = np.eye(4)[None]
    np.testing.assert_array_equal(camera().path(main, mount).intrinsics_px, main.intrinsics_px)
    wide = camera(**LENS).path(main, mount).intrinsics_px
    assert wide[0, 0] == pytest.approx(VIDEO.width / 2)
    given = [[40.0, 0, 20], [0, 40, 15], [0, 0, 1]]
    of_matrix = camera(intrinsics_px=given).path(main, mount)
    np.testing.assert_array_equal(of_matrix.intrinsics_px, given)
    with pytest.raises(InputError, match="Camera a: Cameras have implausible intrinsics"):
        camera(intrinsics_px=[[4000.0, 0, 20], [0, 40, 15], [0, 0, 1]]).path(main, mount)


def test_a_camera_survives_json():
    for lens in ({}, LENS, {"intrinsics_px": np.diag([40.0, 40, 1])}):
        mounted = camera(**lens)
        assert MountedCamera.from_json(mounted.to_json()) == mounted


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "A"}, "1 to 32 lowercase letters"),
        ({"name": "ego"}, "the main camera"),
        ({"mount": "elbow"}, "must be one of world, head"),
        ({"pose": np.diag([1.0, 1, -1, 1])}, "a rigid transform"),
        ({"pose": np.array([*np.eye(4)[:3].tolist(), [0, 0, 0, 2]])}, "a rigid transform"),
        ({"pose": WRIST + 60 * np.eye(4, k=3)}, "at most 5 m from its mount"),
        ({"pose": np.full((4, 4), np.nan)}, "4 rows of 4 finite numbers"),
        ({"intrinsics_px": [[1.0]]}, "3 rows of 3 finite numbers"),
        ({"field_of_view_deg": True}, "from 5 to 150 degrees"),
        ({**LENS, "intrinsics_px": np.eye(3)}, "give one"),
    ],
)
def test_a_bad_camera_is_refused(changes, message):
    with pytest.raises(InputError, match=message):
        camera(**changes)


def test_an_action_of_other_hands_is_refused():
    rig = Rig(cameras=(camera(),), sides=("left", "right"))
    with pytest.raises(InputError, match="has 1 hands, the rig has the sides left, right"):
        rig.actions(action_of(ActionSpec()))
