"""Steps of a session that are given part by part."""

import numpy as np
import pytest

from egosim_jax.interactive.options import Limits
from egosim_jax.interactive.server.client import Client
from egosim_jax.interactive.server.errors import RequestError
from egosim_jax.interactive.server.parts import Parts
from egosim_jax.interactive.server.store import Store
from egosim_jax.types import InputError
from tests import painted as painting
from tests.painted import VIDEO, ChunkPainter, PaintedWorld
from tests.unit.interactive.server.served import run, step

WORLD = PaintedWorld(generator=ChunkPainter(), video=VIDEO, perception=None)


@pytest.fixture
def store(tmp_path):
    with_limits = Store(tmp_path, WORLD, Limits(open_steps=1))
    yield with_limits
    with_limits.close()


def rows(session):
    return session.actions.rest + np.linspace(0, 0.1, 5)[1:, None] * np.eye(7)[1]


def part(store, session, number, actions, step_id=1, show=None):
    request = {"session": session.id, "step_id": step_id, "part": number, "actions": actions}
    return store.step(request, show).result()


def test_a_step_in_parts_is_committed_with_the_last_one(store):
    session = store.create({"seed": 3})
    given, shown = rows(session), []
    first = part(store, session, 1, given[:2], show=shown.append)
    assert [len(frames) for frames in shown] == [1, 2]
    assert not (session.folder / "steps").exists()
    again = part(store, session, 1, given[:2])
    np.testing.assert_array_equal(again.frames, first.frames)
    done = part(store, session, 2, given[2:])
    assert (session.committed, done.step_id) == (1, 1)
    np.testing.assert_array_equal(done.frames[:3], first.frames)
    other = store.create({"seed": 3})
    want = step(store, other, 1, given)
    np.testing.assert_array_equal(done.frames, want.frames)
    assert done.info == want.info
    repeated = part(store, session, 2, given[2:])
    np.testing.assert_array_equal(repeated.frames, done.frames)


def test_parts_out_of_order_or_of_another_action_are_refused(store):
    session = store.create({"seed": 3})
    given = rows(session)
    with pytest.raises(RequestError, match="Part 2 of step 1 cannot follow part 0") as refused:
        part(store, session, 2, given[2:])
    assert (refused.value.status, refused.value.code) == (409, "part_out_of_order")
    part(store, session, 1, given[:2])
    with pytest.raises(RequestError, match="Send part 2"):
        part(store, session, 3, given[2:])
    with pytest.raises(InputError, match="part is 0"):
        part(store, session, 0, given[:2])
    part(store, session, 1, given[1:3])  # begins again
    part(store, session, 2, given[2:])
    with pytest.raises(RequestError, match="made with another action"):
        part(store, session, 2, given[:2])


def test_a_step_at_once_or_a_reset_ends_the_parts(store):
    session = store.create({"seed": 3})
    given = rows(session)
    part(store, session, 1, given[:2])
    store.reset({"session": session.id}).result()
    with pytest.raises(RequestError, match="cannot follow part 0"):
        part(store, session, 2, given[2:])
    part(store, session, 1, given[:2])
    step(store, session, 1, given)
    with pytest.raises(RequestError, match="cannot follow part 0"):
        part(store, session, 2, given[2:], step_id=2)


def test_open_steps_are_limited_and_an_idle_one_makes_room(store):
    one, two = store.create({"seed": 3}), store.create({"seed": 4})
    given = rows(one)
    part(store, one, 1, given[:2])
    with pytest.raises(RequestError) as refused:
        part(store, two, 1, given[:2])
    assert (refused.value.status, refused.value.code) == (429, "too_many_open_steps")
    store.parts = Parts(most=1, idle_s=0.0)
    part(store, one, 1, given[:2])
    part(store, two, 1, given[:2])
    with pytest.raises(RequestError, match="cannot follow part 0"):
        part(store, one, 2, given[2:])


def test_a_part_that_fails_ends_the_parts(store, monkeypatch):
    session = store.create({"seed": 3})
    given = rows(session)
    part(store, session, 1, given[:2])

    def fail(*_):
        raise FloatingPointError

    with monkeypatch.context() as patched:
        patched.setattr(ChunkPainter, "paint", fail)
        with pytest.raises(RequestError, match="not finite"):
            part(store, session, 2, given[2:])
    with pytest.raises(RequestError, match="cannot follow part 0"):
        part(store, session, 2, given[2:])
    part(store, session, 1, given[:2])
    assert part(store, session, 2, given[2:]).step_id == 1


def test_a_client_gives_parts_and_sees_each_before_it_gives_the_next(tmp_path):
    service, port, _ = run(tmp_path, world=WORLD)
    with Client(f"ws://127.0.0.1:{port}") as client:
        assert client.server["part_rows"] == [2, 2]
        session, shown = client.create(seed=3), []
        given = session.reply["row"] + np.linspace(0, 0.1, 5)[1:, None] * np.eye(7)[1]
        first = session.step_part(given[:2], show=shown.append)
        assert (first["step_id"], first["part"], "info" in first) == (1, 1, False)
        assert 0 < first["timing"]["first_frames_s"] <= first["timing"]["last_frames_s"]
        np.testing.assert_array_equal(np.concatenate(shown), first["frames"])
        done = session.step_part(given[2:], show=shown.append)
        assert (session.step_id, done["info"]["chunk"]) == (1, 1)
        np.testing.assert_array_equal(np.concatenate(shown), done["frames"])
    service.store.close()


def test_further_cameras_have_their_clip_after_the_last_part(store):
    cameras = [{"name": "wrist", "mount": "right_wrist", "pose": painting.WRIST.tolist()}]
    session = store.create({"seed": 3, "cameras": cameras})
    given = rows(session)
    assert not part(store, session, 1, given[:2]).others
    done = part(store, session, 2, given[2:])
    expected = step(store, store.create({"seed": 3, "cameras": cameras}), 1, given)
    np.testing.assert_array_equal(done.others["wrist"], expected.others["wrist"])
