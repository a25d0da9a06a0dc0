"""Wrong calls of both environments: each is refused with a message, and changes nothing."""

import gymnasium
import numpy as np
import pytest

from egosim_jax.interactive import env as environments
from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.interactive.env.rewards import GoalImage, MoveObject
from egosim_jax.interactive.env.single import WorldEnv, seed_of, to_options
from egosim_jax.interactive.env.vector import WorldVectorEnv
from egosim_jax.types import InputError
from tests.painted import painted

REST = ActionSpec().rest


def make(count, **options):
    """An environment of one episode, or a vector environment."""
    return WorldVectorEnv(painted(), count, **options) if count else WorldEnv(painted(), **options)


def rows(count):
    return np.tile(REST, (count, 1, 1) if count else (1, 1))


SINGLE, VECTOR = 0, 2


@pytest.mark.parametrize(
    ("count", "call", "message"),
    [
        (SINGLE, lambda env: env.reset(seed=-1), r"from 0 to 2\*\*63 - 1"),
        (VECTOR, lambda env: env.reset(seed=np.array(1 << 63)), r"from 0 to 2\*\*63 - 1"),
        (SINGLE, lambda env: env.step(REST[:6]), "The action has shape"),
        (VECTOR, lambda env: env.step(np.stack([REST, REST + 9])), "of the actions has"),
        (SINGLE, lambda env: env.step(REST + np.nan), "of the actions has"),
        (VECTOR, lambda env: env.step(REST[None]), "1 actions for 2 episodes: give one for each"),
        (VECTOR, lambda env: env.chunk_step(np.zeros((3, 1, 7))), "3 actions for 2 episodes"),
        (VECTOR, lambda env: env.chunk_step(rows(2), prompts="ab"), "one for each of 2 episodes"),
        (VECTOR, lambda env: env.chunk_step(rows(2), prompts=["a"]), "one for each of 2 episodes"),
    ],
)
def test_a_wrong_call_is_refused_and_changes_nothing(count, call, message):
    env = make(count)
    env.reset(seed=3)
    with pytest.raises(InputError, match=message):
        call(env)
    env.chunk_step(rows(count))


@pytest.mark.parametrize(
    ("convert", "value", "message"),
    [
        (seed_of, 1.5, "must be a whole number"),
        (seed_of, np.array([3, 4]), "must be a whole number"),
        (to_options, "state", "must be a map"),
        (to_options, {3: 4}, "must be a map"),
    ],
)
def test_a_seed_or_options_of_another_type_are_refused(convert, value, message):
    with pytest.raises(InputError, match=message):
        convert(value)


@pytest.mark.parametrize("seed", [np.array([3, 4]), (3, np.int64(4)), [3, 4]], ids=type)
def test_seeds_of_a_vector_environment_may_be_any_sequence(seed):
    env = make(2)
    env.reset(seed=seed)
    assert [running.start.seed for running in env.running] == [3, 4]


@pytest.mark.parametrize("count", [0, 2], ids=["single", "vector"])
def test_an_ended_episode_takes_no_step_until_it_is_reset(count):
    env = make(count, max_chunks=1)
    env.reset(seed=3)
    assert np.all(env.chunk_step(rows(count))[3])
    for step, action in (
        (env.chunk_step, rows(count)),
        (env.step, rows(count)[..., 0, :]),
    ):
        with pytest.raises(InputError, match="has ended: reset it"):
            step(action)
    env.reset(seed=3)
    env.chunk_step(rows(count))


@pytest.mark.parametrize("count", [0, 2], ids=["single", "vector"])
def test_a_closed_environment_refuses_every_call(count):
    env = make(count)
    env.reset(seed=3)
    env.close()
    env.close()
    calls = [
        lambda: env.reset(seed=3),
        lambda: env.chunk_step(rows(count)),
        lambda: env.step(rows(count)[..., 0, :]),
    ]
    for call in calls:
        with pytest.raises(InputError, match="is closed: make a new one"):
            call()


@pytest.mark.parametrize("count", [0, 2], ids=["single", "vector"])
@pytest.mark.parametrize(
    ("reward", "message"),
    [
        (
            MoveObject(number=99, offset_m=(0.1, 0.0, 0.0)),
            "Object 99 has no points.*info\\['objects'\\]",
        ),
        (MoveObject(number=0, offset_m=(0.1, 0.0, 0.0)), "Object 0 has no points"),
        (GoalImage(image=np.zeros((8, 8, 3), np.uint8)), "goal image"),
    ],
    ids=["unknown", "background", "size"],
)
def test_a_reward_that_cannot_judge_the_episode_is_refused_at_its_reset(count, reward, message):
    env = make(count, reward=reward)
    with pytest.raises(InputError, match=message):
        env.reset(seed=3)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"number": "10"}, "must be an id, a whole number"),
        ({"offset_m": (0.1, 0.0, np.nan)}, "must be x, y and z in meters"),
        ({"tolerance_m": 0.0}, "must be above 0"),
    ],
    ids=repr,
)
def test_a_task_that_no_episode_can_have_is_refused_at_once(fields, message):
    with pytest.raises(InputError, match=message):
        MoveObject(**{"number": 10, "offset_m": (0.1, 0.0, 0.0), **fields})


@pytest.mark.parametrize("vector", [False, True], ids=["single", "vector"])
def test_an_unknown_option_is_refused_before_a_world_is_loaded(vector, capsys):
    known = "Did you mean world\\? Options: backend, world, actions, observe, reward, max_chunks"
    make = gymnasium.make_vec if vector else gymnasium.make
    count = {"num_envs": 2} if vector else {}
    with pytest.raises(InputError, match=f"no option 'wrld' of an environment. {known}"):
        make("egosim_jax/Tabletop-v0", wrld="true", **count)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_chunks": 0}, "max_chunks is 0: it must be a whole number of at least 1"),
        ({"max_chunks": True}, "max_chunks is True"),
        ({"observe": "depth"}, "observe is the text 'depth': give a tuple"),
        ({"actions": "wrist"}, r"actions is 'wrist': .*ActionSpec\(layout='wrist'\)"),
        ({"world": "true", "backend": painted()}, "Give a backend or a world"),
        ({"backend": "true"}, "name a world by world="),
    ],
    ids=str,
)
@pytest.mark.parametrize("count", [0, 2], ids=["single", "vector"])
def test_settings_are_refused_before_a_world_loads(monkeypatch, count, options, message):
    monkeypatch.setattr(environments, "load_backend", lambda *_, **__: pytest.fail("it loaded"))
    with pytest.raises(InputError, match=message):
        environments.make_vec(num_envs=2, **options) if count else environments.make(**options)


def test_a_render_mode_that_is_not_known_is_refused():
    with pytest.raises(InputError, match="render_mode is 'human': it must be 'rgb_array' or None"):
        make(0, render_mode="human")


@pytest.mark.parametrize("count", [0, 2], ids=["single", "vector"])
def test_a_reward_that_is_no_reward_is_named(count):
    env = make(count, reward=lambda outcome: 0.5)
    env.reset(seed=3)
    with pytest.raises(InputError, match=r"The reward function returned 0\.5"):
        env.chunk_step(rows(count))
