"""Refusals of sessions: invalid starts and actions, and more than the limits."""

import numpy as np
import pytest

from egosim_jax.interactive.env.single import WorldEnv
from egosim_jax.interactive.options import Limits
from egosim_jax.interactive.server.errors import RequestError
from egosim_jax.interactive.server.session import Session
from egosim_jax.interactive.server.store import Store
from egosim_jax.simulation.actions import all_joints_of
from egosim_jax.types import InputError
from tests.painted import painted
from tests.unit.interactive.server.served import rows, step


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ({"session": "../x"}, "letters, digits"),
        ({"seed": -1}, "must be from 0"),
        ({"seed": "7"}, "whole number"),
        ({"actions": {"layout": "feet"}}, "no action layout"),
        ({"actions": {"fingers": 5}}, "no setting 'fingers'"),
        ({"episode": b"PK"}, "not a readable zip"),
        ({"prompt": 5}, "must be a text"),
        ({"actions": {"camera": True, "camera_reach": [float("nan"), 1]}}, "reach of the camera"),
    ],
)
def test_an_invalid_session_is_refused_and_not_made(store, request_, message):
    with pytest.raises(InputError, match=message):
        store.create(request_)
    assert not store.sessions
    assert [path.name for path in store.folder.iterdir()] == [".lock"]


def test_limits_are_kept(tmp_path):
    limits = Limits(sessions=1, queue=1, max_steps=2)
    store = Store(tmp_path, painted(), limits)
    session = store.create({})
    with pytest.raises(RequestError, match="Close one"):
        store.create({})
    with pytest.raises(RequestError, match="more than a session's maximum of 2 steps"):
        step(store, session, 3)
    store.draining = True
    with pytest.raises(RequestError, match="shutting down"):
        step(store, session, 1)
    store.close()


def test_a_full_queue_and_a_busy_session_are_refused_and_nothing_is_lost(tmp_path):
    store = Store(tmp_path, painted(pause=0.3), Limits(queue=2))
    one, two, three = (store.create({"session": name}) for name in ("one", "two", "three"))
    runs = [store.step({"session": s.id, "step_id": 1, "actions": rows(s)}) for s in (one, two)]
    for session, number, code in ((one, 2, "queue_full"), (three, 1, "queue_full")):
        with pytest.raises(RequestError) as refused:
            step(store, session, number)
        assert (refused.value.status, refused.value.code) == (429, code)
        assert refused.value.retry_after_s
    store.limits = Limits()
    with pytest.raises(RequestError, match="one at a time") as refused:
        step(store, one, 1, rows(one, 5))  # of another client
    assert (refused.value.status, refused.value.code) == (409, "session_busy")
    assert [run.result().step_id for run in runs] == [1, 1]
    assert step(store, three, 1).step_id == 1
    store.close()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"row": np.full(7, np.nan)}, "Row 0 of the actions has nan as right x: all must be"),
        ({"row": np.zeros(63)}, "must have 1 to 4 rows of 7 numbers"),
        ({"row": [0.1, 0.2, 0.1, 0, 0, 180, 0]}, "180 as right rz.*rotations in radians"),
        ({"rows": 5}, "must have 1 to 4 rows of 7 numbers"),
    ],
)
def test_an_invalid_action_is_refused_with_rule_and_value(store, change, message):
    made = store.create({"seed": 3})
    row = np.asarray(change.get("row", made.actions.rest), float)
    with pytest.raises(RequestError, match=message) as refused:
        step(store, made, 1, np.tile(row, (change.get("rows", 1), 1)))
    assert (refused.value.status, refused.value.code) == (422, "invalid")
    assert (made.committed, made.pending, made.busy) == (0, False, False)
    assert step(store, made, 1).step_id == 1


PARKED = {"layout": "wrist", "workspace_m": [[-9, -9, -9], [9, 9, 9]]}


@pytest.mark.parametrize(
    ("actions", "hidden"),
    [
        ({}, ["right"]),
        ({"sides": ["left", "right"]}, ["left"]),
        ({"sides": ["left"], "layout": "gripper", "camera": True}, ["left"]),
    ],
    ids=["hand", "one of two", "gripper and camera"],
)
def test_a_hand_out_of_view_is_hidden_as_in_an_environment(store, actions, hidden):
    made = store.create({"seed": 3, "actions": {**PARKED, **actions}})
    row = made.actions.rest.copy()
    row[1] -= 8
    env = WorldEnv(store.backend, actions=made.actions)
    env.reset(seed=3)
    for number, expected in ((1, []), (2, hidden)):  # the first clip begins in view
        found = step(store, made, number, row[None])
        *_, info = env.chunk_step(row[None])
        assert found.info["hidden_hands"] == info["hidden_hands"] == expected
    again = Session(made.folder, store.backend)
    joints = made.action(2).joints_m
    assert np.isnan(joints[:, 0]).all()
    np.testing.assert_array_equal(again.action(2).joints_m, joints)
    np.testing.assert_array_equal(
        all_joints_of(again.action(2))[-1], made.actions.joints(row[None])[0]
    )
    nan = np.where(np.arange(len(row)) < 7, np.nan, row)
    with pytest.raises(RequestError, match="Give a hand that is out of view its last place"):
        step(store, made, 3, nan[None])
    assert step(store, made, 3, row[None]).step_id == 3  # the advice


def test_an_action_that_ends_out_of_sight_of_the_scene_is_refused(store):
    fields = {"camera": True, "camera_reach": [0.15, 3.14]}
    made = store.create({"seed": 3, "actions": fields})
    away = np.concatenate([made.actions.rest[:-6], [0, 0, 0, 0, 3.1, 0]])[None]
    with pytest.raises(RequestError, match="its last camera sees none"):
        step(store, made, 1, away)
    assert step(store, made, 1, made.actions.rest[None]).step_id == 1
