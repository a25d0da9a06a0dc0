"""Sessions of a painted world: journal, resumption, limits, isolation."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.interactive.env.chunks import make_chunk
from egosim_jax.interactive.env.single import WorldEnv
from egosim_jax.interactive.env.true_world import TrueWorld
from egosim_jax.interactive.options import Limits
from egosim_jax.interactive.server import wire
from egosim_jax.interactive.server.errors import RequestError
from egosim_jax.interactive.server.session import Session
from egosim_jax.interactive.server.store import Store
from egosim_jax.simulation.episode import Episode
from egosim_jax.types import InputError
from tests.painted import SIDE, VIDEO, WRIST, painted
from tests.unit.interactive.server.served import rows, step


def hashes(results):
    return [result.info["state_sha256"] for result in results]


def test_a_repeated_step_returns_the_same_result(store):
    session = store.create({"seed": 3})
    first = step(store, session, 1)
    second = step(store, session, 2)
    for known in (first, second):
        again = step(store, session, known.step_id)
        np.testing.assert_array_equal(again.frames, known.frames)
        assert again.info == known.info
    assert session.committed == 2


@pytest.mark.parametrize(("number", "code"), [(3, "step_out_of_order"), (1, "step_used")])
def test_a_step_out_of_order_or_of_another_action_is_refused(store, number, code):
    session = store.create({"seed": 3})
    step(store, session, 1)
    with pytest.raises(RequestError) as refused:
        step(store, session, number, rows(session, 9))
    assert (refused.value.status, refused.value.code) == (409, code)
    assert step(store, session, 2).step_id == 2


def test_a_failed_step_leaves_the_session_where_it_was(store, monkeypatch):
    session = store.create({"seed": 3})
    first = step(store, session, 1)

    def fail(*_):
        raise FloatingPointError

    with monkeypatch.context() as patched:
        patched.setattr(type(store.backend.generator), "__call__", fail)
        with pytest.raises(RequestError, match="not finite"):
            step(store, session, 2)
    assert not (session.folder / "steps" / "2").exists()
    assert session.result == first
    assert step(store, session, 2, rows(session, 5)).step_id == 2


@pytest.mark.parametrize("text", ["{}", "[]", "{"])
def test_a_damaged_request_does_not_keep_the_store_from_opening(store, text):
    for name in ("good", "bad"):
        step(store, store.create({"session": name}), 1)
    store.close()
    last = store.folder / "bad" / "steps" / "1"
    (last / "info.json").unlink()
    (last / "request.json").write_text(text)
    again = Store(store.folder, painted(), Limits())
    assert (set(again.sessions), set(again.damaged)) == ({"good"}, {"bad"})
    again.close()


def test_a_start_that_the_world_refuses_changes_nothing(store, tmp_path):
    world = TrueWorld(video=VIDEO)
    start = store.backend.start(3, ActionSpec())
    made = Session.create(tmp_path / "one", world, ActionSpec(), start)
    with pytest.raises(InputError, match="scenes of its seeds"):
        made.restart(replace(start, seed=4))
    assert Session(made.folder, world).now.seed == 3
    with pytest.raises(InputError, match="scenes of its seeds"):
        Session.create(tmp_path / "two", world, ActionSpec(), replace(start, seed=4))
    assert not (tmp_path / "two").exists()


def test_a_reopened_store_finishes_the_step_that_was_under_way(store, tmp_path):
    session = store.create({"seed": 3, "session": "one"})
    wanted = [step(store, session, number) for number in (1, 2, 3)]
    store.close()
    copy = tmp_path / "copy"
    shutil.copytree(store.folder, copy)
    last = copy / "one" / "steps" / "3"
    (last / "info.json").unlink()
    shutil.rmtree(last / "rollout")
    again = Store(copy, painted(), Limits())
    found = again.sessions["one"]
    result = step(again, found, 3)
    assert hashes([result]) == hashes(wanted[2:])
    np.testing.assert_array_equal(result.frames, wanted[2].frames)
    assert step(again, found, 4).step_id == 4
    again.close()


def test_a_reset_returns_to_the_first_start_and_takes_a_prompt(store):
    made = store.create({"seed": 3, "session": "one", "prompt": "Wave."})
    store.reset({"session": "one", "seed": 4}).result()
    assert made.now.seed == 4
    store.reset({"session": "one", "episode": None}).result()
    assert (made.now.seed, made.now.prompt) == (3, "Wave.")
    store.reset({"session": "one", "prompt": "Clap."}).result()
    assert (made.now.seed, made.now.prompt) == (3, "Clap.")
    assert Session(made.folder, store.backend).now.prompt == "Clap."


def test_a_session_is_not_continued_in_another_world(store):
    step(store, store.create({"session": "one"}), 1)
    store.close()
    again = Store(store.folder, painted("classical"), Limits())
    with pytest.raises(RequestError, match="perception of the session is 'None', of this server"):
        again.get("one")
    again.close()


def test_a_reset_and_a_load_continue_the_step_numbers(store):
    session = store.create({"seed": 3})
    first = step(store, session, 1)
    store.save({"session": session.id, "name": "here"}).result()
    step(store, session, 2)
    loaded = store.load({"session": session.id, "name": "here"}).result()
    assert (loaded.step_id, loaded.info["state_sha256"]) == (2, first.info["state_sha256"])
    third = step(store, session, 3, rows(session, 2))
    assert np.array_equal(third.frames, step(store, session, 2).frames)
    reset = store.reset({"session": session.id, "seed": 4}).result()
    assert reset.step_id == 3
    reopened = Session(session.folder, store.backend)
    assert reopened.now.seed == 4
    assert reopened.result.info == reset.info


def test_a_session_reports_figures_and_poses_as_an_environment_does(store):
    made = store.create({"seed": 3})
    result = step(store, made, 1)
    env = WorldEnv(painted(), actions=made.actions)
    env.reset(seed=3)
    info = env.chunk_step(rows(made))[-1]
    for name in ("validity", "object_validity", "object_poses", "objects"):
        assert result.info[name] == wire.to_json(info[name])
    assert Session(made.folder, store.backend).result.info == result.info


def test_an_episode_of_a_session_can_be_simulated_again(store):
    session = store.create({"seed": 3})
    for number in (1, 2):
        step(store, session, number)
    ((start, steps),) = session.runs()
    episode = Episode(
        state=start.state,
        actions=tuple(map(session.action, steps)),
        fps=VIDEO.fps,
        first_frame=start.first_frame,
    )
    created = store.create({"seed": 3, "episode": episode.to_bytes()})
    assert created.result.info["state_sha256"] == session.result.info["state_sha256"]


def test_a_damaged_session_does_not_disturb_the_others(store, tmp_path):
    for name in ("good", "bad"):
        step(store, store.create({"session": name}), 1)
    store.close()
    (store.folder / "bad" / "starts" / "0" / "start.json").write_text("{")
    (store.folder / "bad" / "steps" / "1" / "info.json").unlink()
    again = Store(store.folder, painted(), Limits())
    assert set(again.sessions) == {"good"}
    with pytest.raises(
        RequestError, match=r"could not be resumed: bad/starts/0/start\.json"
    ) as shown:
        again.get("bad")
    assert str(store.folder) not in str(shown.value)
    again.close()


@pytest.mark.parametrize(
    "fields", [None, {"row": [1, [2]]}, {"past": [3]}, {"height": 10**9}, {"row": [10**400]}]
)
def test_a_damaged_save_is_refused_without_the_paths_of_the_server(store, fields):
    made = store.create({"seed": 3})
    store.save({"session": made.id, "name": "a"}).result()
    start = made.folder / "saved" / "a" / "start.json"
    old = start.read_text()
    start.write_text("{" if fields is None else json.dumps({**json.loads(old), **fields}))
    with pytest.raises(RequestError, match=r"start|frames of") as refused:
        store.load({"session": made.id, "name": "a"}).result()
    assert (refused.value.status, str(store.folder) in str(refused.value)) == (422, False)
    assert step(store, made, 1).step_id == 1


@pytest.mark.parametrize("file", ["saved/a/first_frame.png", "starts", "steps/1/info.json"])
def test_links_out_of_a_session_are_not_followed(store, tmp_path, file):
    made = store.create({"session": "one"})
    store.save({"session": "one", "name": "a"}).result()
    step(store, made, 1)
    store.close()
    (made.folder / file).rename(tmp_path / "secret")
    (made.folder / file).symlink_to(tmp_path / "secret")
    again = Store(store.folder, painted(), Limits())
    with pytest.raises(RequestError, match="is a link to a file outside"):
        again.load({"session": "one", "name": "a"}).result()
    again.close()


def test_a_store_that_closes_at_once_gives_up_what_waits(tmp_path, monkeypatch):
    store = Store(tmp_path, painted(pause=0.3), Limits(threads=1))
    one, two = (store.create({"session": name}) for name in ("one", "two"))
    runs = [store.step({"session": s.id, "step_id": 1, "actions": rows(s)}) for s in (one, two)]
    store.close(at_once=True)
    assert (one.committed, two.committed) == (1, 0)
    assert runs[0].result().step_id == 1


CAMERAS = [
    {"name": "wrist", "mount": "right_wrist", "field_of_view_deg": 90.0, "pose": WRIST.tolist()},
    {"name": "side", "mount": "world", "pose": SIDE.tolist()},
]


def test_further_cameras_have_clips_that_a_restarted_store_reads(store):
    session = store.create({"session": "one", "seed": 3, "cameras": CAMERAS})
    alone = step(store, store.create({"seed": 3}), 1)
    shape = (VIDEO.height, VIDEO.width, 3)
    assert {name: f.shape for name, f in session.result.others.items()} == {
        "wrist": (1, *shape),
        "side": (1, *shape),
    }
    made = step(store, session, 1)
    np.testing.assert_array_equal(made.frames, alone.frames)
    assert made.info["state_sha256"] == alone.info["state_sha256"]
    assert made.info["unobserved"].keys() == {"wrist", "side"}
    assert not alone.others
    store.close()
    again = Store(store.folder, painted(), Limits())
    kept = again.get("one")
    assert kept.observer == session.observer
    for name, frames in made.others.items():
        np.testing.assert_array_equal(kept.result.others[name], frames)
    again.close()


def test_an_interrupted_step_keeps_the_clips_of_further_cameras(store, monkeypatch):
    session = store.create({"session": "one", "seed": 3, "cameras": CAMERAS})
    expected = step(store, store.create({"seed": 3, "cameras": CAMERAS}), 1)

    def stop(*_, **__):
        raise KeyboardInterrupt

    chunk = make_chunk(session.actions, rows(session, 1), start=session.now, video=VIDEO)
    session._accept(1, chunk, "hash")
    with monkeypatch.context() as patched:
        patched.setattr("egosim_jax.simulation.simulator.OpenClip.finish", stop)
        with pytest.raises(KeyboardInterrupt):
            session._run(1, None, None)
    calls = []
    paint = type(store.backend.generator).paint
    monkeypatch.setattr(
        type(store.backend.generator), "paint", lambda *a: calls.append(a) or paint(*a)
    )
    resumed = session.finish()
    assert not calls  # all frames were on disk
    for name, frames in expected.others.items():
        np.testing.assert_array_equal(resumed.others[name], frames)
    assert resumed.info == expected.info


@pytest.mark.parametrize(
    ("cameras", "message"),
    [
        ({}, "a list of at most 8 maps"),
        ([{"name": "a"}], "a map of name, mount, pose"),
        ([{**CAMERAS[0], "name": "ego"}], "not be 'ego', the main camera"),
        ([{**CAMERAS[0], "mount": "left_wrist"}], "only the hands right"),
        ([{**CAMERAS[0], "pose": "x"}], "4 rows of 4 finite numbers"),
        ([{**CAMERAS[0], "field_of_view_deg": 300}], "from 5 to 150 degrees"),
        ([CAMERAS[0], CAMERAS[0]], "Two cameras are named 'wrist'"),
    ],
)
def test_a_bad_camera_makes_no_session(store, cameras, message):
    with pytest.raises(InputError, match=message):
        store.create({"cameras": cameras})
    assert not list(store.folder.glob("[!.]*/session.json"))
