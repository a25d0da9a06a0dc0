"""Clips of further cameras."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.rendering import reference
from egosim_jax.simulation.preview import Preview
from egosim_jax.simulation.rig import MountedCamera, Rig
from egosim_jax.simulation.rollout import Rollout, load_clip
from egosim_jax.simulation.simulator import Simulator
from egosim_jax.simulation.views import view_from
from egosim_jax.types import InputError
from tests.painted import SIDE, VIDEO, ChunkPainter, painted

AWAY = np.diag([1.0, -1, -1, 1])
"""Pose of a camera that looks away from the table."""


@pytest.fixture(scope="module")
def start():
    return painted().start(3, ActionSpec())


@pytest.fixture(scope="module")
def action(start):
    rows = ActionSpec().rest + np.linspace(0, 0.1, VIDEO.frames)[:, None] * np.eye(7)[1]
    return ActionSpec().to_action(rows, camera=start.camera, prompt="")[0]


def rig(pose=SIDE, mount="world"):
    return Rig(cameras=(MountedCamera(name="other", mount=mount, pose=pose),))


def simulator(generator=None, **options):
    return Simulator(generator=generator or Preview(), perception=None, fps=8, **options)


def test_a_camera_in_the_heads_place_has_the_heads_clip(start, action):
    step = simulator(rig=rig(np.eye(4), "head")).step(start.state, action, seed=1)
    np.testing.assert_array_equal(step.others["other"].clip.frames, step.clip.frames)
    assert step.others["other"].unobserved == pytest.approx((step.view.mask > 0).mean())


def test_the_motion_is_predicted_once_for_all_cameras(start, action, monkeypatch):
    calls = []
    predict = Simulator.predict
    monkeypatch.setattr(Simulator, "predict", lambda *a: calls.append(a) or predict(*a))
    step = simulator(rig=rig()).step(start.state, action, seed=1)
    assert len(calls) == 1
    alone = simulator().step(start.state, action, seed=1)
    np.testing.assert_array_equal(step.clip.frames, alone.clip.frames)
    assert not alone.others


def test_each_camera_has_its_own_stream_of_chunks(start, action):
    painter = ChunkPainter()
    step = simulator(painter, rig=rig(np.eye(4), "head")).step(start.state, action, seed=1)
    np.testing.assert_array_equal(step.others["other"].clip.frames, step.clip.frames)


def test_a_rollout_keeps_the_clips_of_all_cameras(start, action, tmp_path):
    def run(rigged):
        simulated = simulator(rig=rigged)
        return list(Rollout(simulated, tmp_path).run(start.state, [action], seed=1))

    (made,) = run(rig())
    (kept,) = run(rig())
    np.testing.assert_array_equal(
        made.others["other"].clip.frames, kept.others["other"].clip.frames
    )
    assert made.others["other"].unobserved == kept.others["other"].unobserved
    main = load_clip(tmp_path / "clip_1" / "frames.npz", fps=8)
    np.testing.assert_array_equal(main.frames, made.clip.frames)
    with pytest.raises(InputError, match="cameras"):
        run(rig(np.eye(4), "head"))


def test_a_view_of_nothing_is_empty(start):
    poses = start.camera.world_from_camera @ AWAY
    cameras = replace(start.camera, world_from_camera=poses.repeat(3, axis=0))
    view = view_from(reference, start.state, cameras, point_px=1)
    assert view.mask.min() == 255
    assert not view.frames.any()
    assert np.isinf(view.depth_m).all()


def test_a_camera_that_turns_to_the_scene_sees_it(start):
    """A renderer refuses a first frame without points, and a camera on a wrist may have one."""
    pose = start.camera.world_from_camera[0]
    cameras = replace(start.camera, world_from_camera=np.stack([pose @ AWAY, pose, pose @ AWAY]))
    view = view_from(reference, start.state, cameras, point_px=1)
    seen = reference.render(start.state, start.camera, point_px=1)
    np.testing.assert_array_equal(view.frames[1], seen.frames[0])
    assert not view.frames[0].any()
    assert not view.frames[2].any()


def test_a_generator_of_another_size_is_refused(start, action):
    def short(view, action, first_frame, seed):
        is_main = np.array_equal(first_frame, start.first_frame)
        return view.frames if is_main else view.frames[1:]

    with pytest.raises(InputError, match="must return the same number of frames"):
        simulator(short, rig=rig()).step(start.state, action, seed=1, first_frame=start.first_frame)
