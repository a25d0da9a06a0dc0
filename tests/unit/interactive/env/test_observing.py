"""Further cameras of an environment: fixed, on the head and on a wrist."""

import gymnasium
import numpy as np
import pytest

from egosim_jax.interactive import env as egosim
from egosim_jax.interactive.env import load_backend
from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.interactive.env.batching import Batcher
from egosim_jax.interactive.env.vector import WorldVectorEnv
from egosim_jax.simulation.rig import MountedCamera
from egosim_jax.types import InputError, VideoSpec
from tests import painted as painting
from tests.painted import VIDEO, BatchPainter, PaintedWorld, painted

SIDE = MountedCamera(name="side", mount="world", pose=painting.SIDE)
WRIST = MountedCamera(name="wrist", mount="right_wrist", pose=painting.WRIST, field_of_view_deg=90)
HEAD = MountedCamera(name="same", mount="head", pose=np.eye(4))
OBSERVE = ("frames", "wrist.frames", "wrist.depth", "side.frames", "same.frames")


def make(backend=None, **options):
    return gymnasium.make(
        egosim.ID, backend=backend or painted(), disable_env_checker=True, **options
    )


def ahead(env, rows=4):
    env = env.unwrapped
    return env.actions.rest + np.linspace(0, 0.1, rows + 1)[1:, None] * np.eye(7)[1]


def test_each_camera_has_its_frames_and_depth():
    env = make(cameras=[SIDE, WRIST, HEAD], observe=OBSERVE)
    first, _ = env.reset(seed=3)
    seen, _, _, _, info = env.unwrapped.chunk_step(ahead(env))
    for observation in (first, seen):
        assert env.observation_space.contains(observation)
    assert not np.array_equal(first["wrist.frames"], seen["wrist.frames"])
    assert not np.array_equal(seen["wrist.frames"], seen["side.frames"])
    assert np.array_equal(seen["same.frames"], seen["frames"])  # it is the main camera
    assert 0 < info["unobserved"]["side"] < 1
    assert np.isfinite(seen["wrist.depth"]).all()


def test_further_cameras_change_no_main_clip_and_no_state():
    results = []
    for options in ({}, {"cameras": [SIDE, WRIST], "observe": OBSERVE[:4]}):
        env = make(**options)
        env.reset(seed=3)
        seen, _, _, _, info = env.unwrapped.chunk_step(ahead(env))
        results.append((seen["frames"], info["state_sha256"], info.get("unobserved")))
    (frames, state, absent), (frames_of_rig, state_of_rig, _) = results
    assert np.array_equal(frames, frames_of_rig)
    assert (state, absent) == (state_of_rig, None)


def test_a_camera_that_nobody_observes_has_no_clip():
    env = make(cameras=[SIDE, WRIST], observe=("frames", "wrist.frames"))
    env.reset(seed=3)
    env.unwrapped.chunk_step(ahead(env))
    assert list(env.unwrapped.running.last.others) == ["wrist"]


def test_the_clips_of_all_cameras_are_rows_of_one_batch():
    batcher = Batcher(BatchPainter(), max_batch=2, wait_s=30.0)
    backend = PaintedWorld(generator=batcher, video=VIDEO, perception=None)
    env = make(backend, cameras=[WRIST], observe=("frames", "wrist.frames"))
    env.reset(seed=3)
    env.unwrapped.chunk_step(ahead(env))
    assert batcher.runs == {1: 0, 2: 1}
    batcher.close()


def test_a_vector_environment_has_the_cameras_of_each_episode():
    backend = painted(batch=4)
    envs = WorldVectorEnv(backend, 2, cameras=[WRIST], observe=("frames", "wrist.frames"))
    envs.reset(seed=3)
    rows = np.stack([envs.actions.rest + [0, 0.05, 0, 0, 0, 0, 0]] * 2)
    seen, *_ = envs.step(rows)
    assert seen["wrist.frames"].shape == (2, VIDEO.frames, VIDEO.height, VIDEO.width, 3)
    single = make(cameras=[WRIST], observe=("frames", "wrist.frames"))
    single.reset(seed=3)
    alone = single.step(rows[0])[0]
    assert np.array_equal(alone["wrist.frames"], seen["wrist.frames"][0])


def test_the_true_world_shows_the_same_moment_from_all_cameras():
    """The camera on the head, in place of the head's own, has the very same frames."""
    video = VideoSpec(frames=5, height=32, width=48, fps=8)
    world = load_backend("true")
    backend = type(world)(video=video)
    env = make(backend, cameras=[WRIST, HEAD], observe=("frames", "wrist.frames", "same.frames"))
    first, _ = env.reset(seed=3)
    assert np.array_equal(first["same.frames"], first["frames"])
    seen, *_ = env.unwrapped.chunk_step(ahead(env))
    assert np.array_equal(seen["same.frames"], seen["frames"])
    assert seen["wrist.frames"].std() > 10


def test_bad_declarations_are_refused_before_a_world_loads():
    refused = [
        (dict(cameras=[SIDE, SIDE]), "Two cameras are named 'side'"),
        (dict(cameras=WRIST), "a list of MountedCamera"),
        (dict(cameras=[WRIST], actions=ActionSpec(sides=("left",))), "is on the right wrist"),
        (dict(cameras=[SIDE], observe=("wrist.frames",)), "side.frames, side.depth"),
    ]
    for options, message in refused:
        with pytest.raises(InputError, match=message):
            egosim.make(**options)


def test_a_fixed_camera_that_sees_nothing_is_refused_at_the_reset():
    away = MountedCamera(name="away", mount="head", pose=np.diag([1.0, -1, -1, 1]))
    env = make(cameras=[away], observe=("away.frames",))
    with pytest.raises(InputError, match="away sees none of the"):
        env.reset(seed=3)
