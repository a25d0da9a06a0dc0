"""Gymnasium environments of a painted world: without a model."""

import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from egosim_jax.interactive import env as egosim
from egosim_jax.interactive.env import rewards
from egosim_jax.interactive.env.action_spec import LAYOUTS, ActionSpec
from egosim_jax.interactive.env.rewards import GoalImage, MoveObject
from egosim_jax.interactive.env.single import WorldEnv
from egosim_jax.interactive.env.vector import WorldVectorEnv
from egosim_jax.simulation.preview import Preview
from egosim_jax.simulation.start import Start
from egosim_jax.types import InputError
from tests.painted import VIDEO, painted


def make(**options):
    return gymnasium.make(egosim.ID, backend=painted(), disable_env_checker=True, **options)


def ahead(env, rows=4):
    """Rows that move the hand away from the wearer."""
    env = env.unwrapped
    return env.actions.rest + np.linspace(0, 0.1, rows + 1)[1:, None] * np.eye(7)[1]


@pytest.mark.filterwarnings("ignore:.*:UserWarning")
@pytest.mark.parametrize(
    "layout",
    [n if n == "wrist" else pytest.param(n, marks=pytest.mark.slow) for n in LAYOUTS],
)
def test_gymnasiums_checker_passes(layout):
    actions = ActionSpec(layout=layout, camera=layout == "gripper")
    observe = ("frames", "depth", "keypoints", "state")
    env = make(actions=actions, observe=observe, render_mode="rgb_array")
    check_env(env.unwrapped)


def test_the_name_of_an_environment_can_name_its_module():
    """It works in a program that imports nothing else of this package."""
    name = f"egosim_jax.interactive.env:{egosim.ID}"
    env = gymnasium.make(name, backend=painted(), disable_env_checker=True)
    assert isinstance(env.unwrapped, WorldEnv)
    assert isinstance(gymnasium.make_vec(name, num_envs=2, backend=painted()), WorldVectorEnv)


def test_equal_seeds_and_actions_give_equal_states():
    infos = []
    for _ in range(2):
        env = make()
        env.reset(seed=3)
        infos.append(env.unwrapped.chunk_step(ahead(env))[-1])
    assert infos[0]["state_sha256"] == infos[1]["state_sha256"]
    assert infos[0]["chunk"] == 1


def test_a_short_chunk_is_padded_and_says_so():
    env = make()
    env.reset(seed=3)
    _, _, _, _, info = env.unwrapped.chunk_step(ahead(env, rows=1))
    assert info["padded_frames"] == VIDEO.frames - 2
    held, _, _, _, _ = env.unwrapped.chunk_step(ahead(env, rows=4))
    assert held["row"] == pytest.approx(ahead(env)[-1])


def test_a_plain_step_moves_in_a_straight_line():
    plain, chunked = make(), make()
    target = ahead(plain)[-1]
    for env in (plain, chunked):
        env.reset(seed=3)
    a = plain.step(target)[0]
    b = chunked.unwrapped.chunk_step(ahead(chunked))[0]
    np.testing.assert_array_equal(a["frames"], b["frames"])


def test_a_start_is_saved_and_loaded_whole(tmp_path):
    env = make()
    env.reset(seed=3)
    env.unwrapped.chunk_step(ahead(env))
    env.unwrapped.running.now.save(tmp_path / "start")
    again = make()
    again.reset(options={"start": Start.load(tmp_path / "start")})
    for one in (env, again):
        one.unwrapped.chunk_step(ahead(env))
    np.testing.assert_array_equal(env.unwrapped.running.frames(), again.unwrapped.running.frames())


def test_moving_an_object_is_rewarded_by_its_distance():
    env = make(reward=MoveObject(number=10, offset_m=(0.0, 0.0, 0.0)))
    env.reset(seed=3)
    _, reward, terminated, _, info = env.unwrapped.chunk_step(ahead(env))
    assert (reward, terminated, info["success"]) == (0.0, True, True)


def test_a_goal_image_is_reached_by_its_own_frame(monkeypatch):
    env = make()
    env.reset(seed=3)
    goal = env.unwrapped.chunk_step(ahead(env))[0]["frames"][-1]
    monkeypatch.setattr(rewards, "_lpips", lambda a, b: float(np.abs(a / 255 - b / 255).mean()))
    near = make(reward=GoalImage(image=goal, threshold=0.001))
    near.reset(seed=3)
    assert near.unwrapped.chunk_step(ahead(env))[4]["success"]
    far = make(reward=GoalImage(image=255 - goal))
    far.reset(seed=3)
    _, reward, terminated, _, _ = far.unwrapped.chunk_step(ahead(env))
    assert reward < -0.1
    assert not terminated


def test_a_vector_environment_equals_its_episodes():
    envs = gymnasium.make_vec(egosim.ID, num_envs=2, backend=painted())
    assert isinstance(envs, WorldVectorEnv)
    envs.reset(seed=3)
    env = make()
    rows = ahead(env)
    observed, _, _, _, infos = envs.chunk_step(np.stack([rows, rows]))
    assert observed in envs.observation_space
    for number in range(2):
        env.reset(seed=3 + number)
        single, _, _, _, info = env.unwrapped.chunk_step(rows)
        np.testing.assert_array_equal(observed["frames"][number], single["frames"])
        assert infos["state_sha256"][number] == info["state_sha256"]


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("workspace_m", [None, ((0.2, 0.1, 0.2), (0.4, 0.3, 0.5))])
def test_noise_on_a_resting_row_stays_within_the_bounds(layout, workspace_m):
    spec = ActionSpec(layout=layout, camera=True, sides=("right", "left"))
    spec = spec if workspace_m is None else replace(spec, workspace_m=workspace_m)
    low, high = spec.bounds
    assert (np.minimum(spec.rest - low, high - spec.rest) >= 0.0499 * (high - low)).all()


def test_a_scene_of_another_world_than_the_weights_is_said_at_the_reset():
    world = replace(painted(), trained_on="tabletop")
    start = world.start(3, ActionSpec())
    env = WorldEnv(world)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.reset(options={"start": start})
    other = replace(start, state=replace(start.state, provenance={"source": "video"}))
    with pytest.warns(UserWarning, match="trained on clips of the tabletop world"):
        env.reset(options={"start": other})


def test_a_preview_acts_as_a_model_and_says_what_it_is():
    env = WorldEnv(egosim.load_backend(config="preview"))
    with pytest.warns(UserWarning, match="not generated by a model"):
        env.reset(seed=3)
    seen, *_, info = env.chunk_step(env.actions.rest[None])
    assert seen["frames"].shape == (17, 96, 160, 3)
    assert info["preview"] is True


def test_scenes_that_the_default_weights_do_not_know_get_previews():
    world = replace(painted(), trained_on="tabletop", previews_unknown_scenes=True)
    start = world.start(3, ActionSpec())
    other = replace(start, state=replace(start.state, provenance={"source": "video"}))
    assert world.note(start) is None
    assert world.simulator(start).generator is world.generator
    assert isinstance(world.simulator(other).generator, Preview)
    assert "models fetch egosim_14b" in world.note(other)


def test_a_refused_action_of_one_episode_changes_none():
    envs = WorldVectorEnv(painted(), 2, actions=ActionSpec(camera=True, camera_reach=(5.0, 1.0)))
    envs.reset(seed=0)
    rows = np.stack([envs.actions.rest[None]] * 2)
    rows[1, 0, 7] = 4.0  # meters in one frame
    with pytest.raises(InputError, match="camera moves at"):
        envs.chunk_step(np.repeat(rows, 4, axis=1) * 1.0)
    assert [running.chunks for running in envs.running] == [0, 0]


def test_a_refused_start_of_one_episode_begins_none():
    envs = WorldVectorEnv(painted(), 2)
    envs.reset(seed=3)
    before = [running.start.seed for running in envs.running]
    with pytest.raises(InputError, match="nonsense"):
        envs.reset(seed=8, options={"starts": [{}, {"nonsense": 1}]})
    assert [running.start.seed for running in envs.running] == before


def test_a_seeded_vector_environment_repeats_its_later_resets():
    seeds = []
    for _ in range(2):
        envs = WorldVectorEnv(painted(), 2)
        envs.reset(seed=np.int64(3))
        envs.reset(options={"reset_mask": np.array([False, True])})
        seeds.append([running.start.seed for running in envs.running])
    assert seeds[0] == seeds[1]
    assert seeds[0][0] == 3


@pytest.mark.parametrize("row", [np.full(7, 9.0), np.full(7, np.nan), np.zeros(63)])
def test_a_start_with_a_row_of_other_actions_is_refused(row):
    env = make()
    start = painted().start(3, ActionSpec())
    env.reset(options={"start": replace(start, row=ActionSpec().rest)})
    with pytest.raises(InputError, match="row of the start"):
        env.reset(options={"start": replace(start, row=row)})
