"""Parts behind one entrance, without Ray: its handles call the parts directly."""

import asyncio
from types import SimpleNamespace

import numpy as np
import pytest

from egosim_jax.interactive.server import replicas
from egosim_jax.interactive.server.errors import RequestError
from egosim_jax.interactive.server.service import Service
from egosim_jax.interactive.server.store import Store
from egosim_jax.types import InputError
from tests.painted import painted

PARTS = 2


class Handle:
    """Handle of a part's replica, as Ray's."""

    def __init__(self, part):
        self.part, self.stopped = part, False
        self.describe = SimpleNamespace(remote=part.describe)
        streamed = SimpleNamespace(remote=self.stream)
        self.replies = SimpleNamespace(options=lambda *, stream: stream and streamed)

    async def stream(self, message):
        if self.stopped:
            from ray.exceptions import RayActorError  # here: other tests import Ray themselves

            raise RayActorError
        async for reply in self.part.replies(message):
            yield reply


@pytest.fixture
def handles(tmp_path, monkeypatch):
    services = []

    def open_painted(folder, limits, **_):
        services.append(Service(Store(folder, painted(), limits), world="painted"))
        return services[-1]

    monkeypatch.setattr(replicas, "open_service", open_painted)
    settings = replicas.Replicas(out=tmp_path, parts=PARTS)
    yield [Handle(replicas.Part(settings, number)) for number in range(PARTS)]
    for service in services:
        service.store.close()


@pytest.fixture
def entrance(handles):
    return replicas.Entrance(handles)


def ask(entrance, request, **fields):
    return asyncio.run(entrance.handle({"request": request, **fields}))


def test_each_session_is_in_the_part_that_its_id_chooses(entrance, tmp_path):
    names = ["a", "b", "c", "d"]
    for name in names:
        row = ask(entrance, "create", session=name, seed=3)["row"]
        reply = ask(entrance, "step", session=name, step_id=1, actions=row[None])
        assert (reply["session"], reply["step_id"]) == (name, 1)
    folders = {p.parent.parent.name: set() for p in tmp_path.glob("part-*/*/session.json")}
    assert set(folders) == {"part-0", "part-1"}
    for name in names:
        assert (tmp_path / f"part-{replicas.part_of(name, PARTS)}" / name).is_dir()
    assert ask(entrance, "status")["sessions"] == dict.fromkeys(names, 1)
    new = ask(entrance, "create")["session"]
    assert (tmp_path / f"part-{replicas.part_of(new, PARTS)}" / new).is_dir()
    assert asyncio.run(entrance.describe())["parts"] == PARTS


async def collect(replies):
    return [reply async for reply in replies]


def test_the_frames_of_a_part_are_passed_on(entrance, handles):
    row = ask(entrance, "create", session="a", seed=3)["row"]
    message = {"request": "step", "session": "a", "step_id": 1, "actions": row[None]}
    group, reply = asyncio.run(collect(entrance.replies({**message, "stream": True})))
    assert (group["session"], group["first_frame"]) == ("a", 0)
    np.testing.assert_array_equal(group["frames"], reply["frames"])
    (alone,) = asyncio.run(collect(entrance.replies(message)))
    assert alone["info"] == reply["info"]
    wrong = {**message, "stream": True, "step_id": 9}
    with pytest.raises(RequestError, match="Send step 2") as refused:
        asyncio.run(collect(entrance.replies(wrong)))
    assert refused.value.status == 409
    handles[replicas.part_of("a", PARTS)].stopped = True
    with pytest.raises(RequestError, match="resumes its sessions"):
        asyncio.run(collect(entrance.replies(wrong)))


@pytest.mark.parametrize(
    ("message", "status"),
    [
        ([1], 422),
        ({"request": "fly"}, 422),
        ({"request": [1]}, 422),
        ({"request": "step", "session": "x"}, 404),
        ({"request": "step", "session": "\ud800"}, 404),
    ],
)
def test_errors_of_a_part_are_those_of_the_entrance(entrance, message, status):
    with pytest.raises(RequestError) as refused:
        asyncio.run(entrance.handle(message))
    assert refused.value.status == status


def test_a_part_that_is_started_again_disturbs_no_other(entrance, handles):
    names = {replicas.part_of(name, PARTS): name for name in ("a", "b", "c", "d")}
    handles[0].stopped = True
    with pytest.raises(RequestError, match="resumes its sessions") as refused:
        ask(entrance, "create", session=names[0])
    assert (refused.value.status, refused.value.code) == (503, "part_restarts")
    assert ask(entrance, "create", session=names[1])["session"] == names[1]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"out": "serve"}, "must be absolute"),
        ({"out": "/x", "part": "2"}, "no setting 'part'"),
        ({"out": "/x", "parts": "two"}, "parts is 'two'"),
        ({"parts": "2"}, "out is"),
        ({"out": "/x", "parts": "0"}, "parts"),
    ],
)
def test_settings_that_are_not_valid_are_refused(given, message):
    with pytest.raises(InputError, match=message):
        replicas.read_settings(given)


def test_replicas_without_ray_serve_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(replicas, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"egosim-jax\[replicas\]"):
        replicas.app({"out": str(tmp_path / "serve")})
    assert not (tmp_path / "serve").exists()


def test_the_number_of_parts_cannot_change(tmp_path):
    settings = replicas.read_settings({"out": str(tmp_path), "parts": "3", "gpus": "0.5"})
    assert (settings.parts, settings.gpus) == (3, 0.5)
    replicas.keep_parts(settings)
    replicas.keep_parts(settings)
    with pytest.raises(InputError, match="in 3 parts, not 2"):
        replicas.keep_parts(replicas.Replicas(out=tmp_path, parts=2))
