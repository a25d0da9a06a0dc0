"""Tasks as text, judged by the state."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.geometry import rotation_z
from egosim_jax.interactive.env import ActionSpec
from egosim_jax.interactive.env.backends import tabletop_start
from egosim_jax.interactive.env.tasks import describe, parse
from egosim_jax.trials.agreement import moved
from egosim_jax.types import InputError, VideoSpec

VIDEO = VideoSpec(frames=17, height=48, width=64, fps=8)


@pytest.fixture(scope="module")
def start():
    """Scene 9: a white chest and its case, a green cup, a red ball, a black ring, a yellow cone."""
    return tabletop_start(9, ActionSpec(), VIDEO)


def by(x=0.0, y=0.0, z=0.0):
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def number(start, name):
    return next(n for n, its in start.state.names.items() if its == name)


def judged(start, text, **motions):
    """Judgment of a task after some objects moved, by their names with _ for spaces."""
    (goal,) = parse(text).goals(start).values()
    ids = {number(start, name.replace("_", " ")): motion for name, motion in motions.items()}
    return goal.judge(start.state, moved(start.state, ids))


@pytest.mark.parametrize(
    ("text", "motion", "success"),
    [
        ("red ball moved by 10 cm", by(0.08, 0.07), True),
        ("red ball moved by 10 cm", by(0.08), False),
        ("red ball moved by 0.1,0,0", by(0.09), True),
        ("red ball moved by 0.1,0,0", by(-0.1), False),
        ("red ball lifted by 100 mm", by(z=0.11), True),
        ("red ball lifted by 0.1 m", by(x=0.3, z=0.05), False),
        ("red ball untouched", by(0.005), True),
        ("red ball untouched", by(0.02), False),
    ],
)
def test_success_follows_from_the_motion(start, text, motion, success):
    assert judged(start, text, red_ball=motion).success == success


def test_the_reward_is_what_is_missing(start):
    found = judged(start, "red ball moved by 10 cm", red_ball=by(0.04))
    assert found.reward == pytest.approx(-0.06)
    assert judged(start, "red ball moved by 10 cm", red_ball=by(0.2)).reward == 0


def turned(start, name, degrees):
    """Rotation of an object about the vertical through its center."""
    points = start.state.points_m[start.state.object_ids == number(start, name)]
    center, turn = points.mean(axis=0), np.eye(4)
    turn[:3, :3] = rotation_z(np.radians(degrees))
    return by(*center) @ turn @ by(*-center)


@pytest.mark.parametrize(("degrees", "success"), [(20, False), (40, True)])
def test_a_part_is_open_relative_to_its_case(start, degrees, success):
    motion = turned(start, "white chest", degrees)
    assert judged(start, "white chest open by 30 deg", white_chest=motion).success == success
    both = {"white_chest": motion, "case_of_the_white_chest": motion}
    assert not judged(start, "white chest open by 10 deg", **both).success


def onto(start, height_m):
    """Motion of the ball to the middle of the chest, at a height above its top."""
    state = start.state
    numbers = number(start, "red ball"), number(start, "white chest")
    ball, chest = (state.points_m[state.object_ids == n] for n in numbers)
    to = chest.mean(axis=0) - ball.mean(axis=0)
    to[2] = chest[:, 2].max() + height_m - ball[:, 2].min()
    return by(*to)


def test_an_object_is_onto_another_where_it_rests(start):
    text = "red ball onto white chest"
    assert judged(start, text, red_ball=onto(start, 0.0)).success
    assert not judged(start, text, red_ball=onto(start, 0.1)).success
    assert not judged(start, text, red_ball=by(z=0.1) @ by(0.3)).success
    assert judged(start, text, red_ball=onto(start, 0.1)).reward < -0.05


def test_an_object_in_a_hand_rests_nowhere(start):
    (goal,) = parse("red ball onto white chest").goals(start).values()
    ball = number(start, "red ball")
    there = moved(start.state, {ball: onto(start, 0.0)})
    assert not goal.judge(start.state, replace(there, held={0: ball})).success


def test_all_conditions_must_be_met_and_a_broken_one_ends(start):
    text = "red ball moved by 10 cm and green cup untouched"
    both = judged(start, text, red_ball=by(0.2))
    broken = judged(start, text, red_ball=by(0.2), green_cup=by(0.1))
    waiting = judged(start, text, red_ball=by(0.02))
    assert (both.success, both.terminated) == (True, True)
    assert (broken.success, broken.terminated) == (False, True)
    assert (waiting.success, waiting.terminated) == (False, False)


def test_a_task_of_keeping_succeeds_only_at_the_end(start):
    (goal,) = parse("green cup untouched").goals(start).values()
    assert goal.waits
    assert not goal.judge(start.state, start.state).terminated


def test_any_is_each_loose_object(start):
    goals = parse("take the {object}: any lifted by 5 cm").goals(start, loose=("red ball", "mug"))
    assert list(goals) == ["red ball lifted by 5 cm"]  # there is no mug
    assert goals["red ball lifted by 5 cm"].instruction == "take the red ball"


def test_a_scene_without_the_object_has_no_goal(start):
    assert not parse("blue box untouched").goals(start)
    assert not parse("carry").goals(start)
    assert "red ball" in describe(start.state)


def test_an_object_may_be_an_id_and_has_a_default_instruction(start):
    (goal,) = parse(f"{number(start, 'red ball')} lifted by 5 cm").goals(start).values()
    assert goal.instruction == "Lift the red ball."


@pytest.mark.parametrize(
    "text", ["", "red box", "red box flies", "red box lifted by -3 cm", "red box moved by 30 deg"]
)
def test_other_texts_are_refused(text):
    with pytest.raises(InputError, match="--tasks"):
        parse(text)
