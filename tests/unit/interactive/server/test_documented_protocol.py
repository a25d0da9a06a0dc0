"""Client and tables of docs/protocol.md, against a served world."""

import json
import re
from pathlib import Path

import pytest
from websockets.sync.client import connect

from egosim_jax.interactive.env.chunks import OBSERVATIONS
from egosim_jax.interactive.env.true_world import TrueWorld
from egosim_jax.interactive.server import wire
from egosim_jax.interactive.server.client import Client
from egosim_jax.interactive.server.requests import REQUESTS
from egosim_jax.types import VideoSpec
from tests.painted import VIDEO, ChunkPainter, PaintedWorld
from tests.unit.interactive.server.served import http, run

ROOT = Path(__file__).parents[4]
TEXT = (ROOT / "docs" / "protocol.md").read_text("utf-8")
SCRIPTS = re.findall(r"```python\n(.*?)```", TEXT, re.S)
TYPES = {
    "text": str,
    "int": int,
    "float": float,
    "bool": bool,
    "map": dict,
    "list of int": list,
    "list of text": list,
}
SIZES = {"f": VIDEO.frames, "height": VIDEO.height, "width": VIDEO.width, "d": 7, "h": 1, "j": 21}


def rows_of(heading):
    """The rows of all tables of a section, with the first column filled down."""
    section = TEXT.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    tables = re.findall(r"(?:^\|.*\n)+", section, re.M)
    found, first = [], ""
    for line in (line for table in tables for line in table.splitlines()[2:]):
        cells = [cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        first = cells[0] = cells[0] or first
        found.append(cells)
    return found


def fields(heading, name):
    """The fields of a message and their types."""
    return {field.strip("`"): kind for first, field, kind, *_ in rows_of(heading) if first == name}


def check(value, kind):
    """Check a value by its documented type."""
    array = re.fullmatch(r"(float64|float32|uint8|int32) \((.*)\)", kind)
    if array is None:
        assert type(value) is TYPES[kind], (value, kind)
        return
    assert value.dtype == array[1]
    sizes = array[2].split(", ")
    assert value.ndim == len(sizes)
    for size, name in zip(value.shape, sizes, strict=True):
        assert size == SIZES.get(name, int(name) if name.isdigit() else size)


def check_all(reply, documented):
    assert reply.keys() == documented.keys()
    for name, kind in documented.items():
        check(reply[name], kind)


def streamed(port, step, shown):
    """The reply to a streamed step, after the messages of its groups, which are added."""
    with connect(f"ws://127.0.0.1:{port}", compression=None, max_size=None) as socket:
        socket.recv()
        socket.send(wire.pack({"request": "step", "stream": True, **step}))
        while "first_frame" in (reply := wire.unpack(socket.recv(timeout=60))):
            shown.append(reply)
    return reply


@pytest.fixture(scope="module")
def port(tmp_path_factory):
    world = PaintedWorld(generator=ChunkPainter(), video=VIDEO, perception="classical")
    service, port, _ = run(tmp_path_factory.mktemp("sessions"), world=world)
    yield port
    service.store.close()


def test_the_client_needs_no_package_of_ours(port, capsys):
    script, _ = SCRIPTS
    assert len(script.splitlines()) <= 25
    imported = set(re.findall(r"^(?:import|from) (\w+)", script, re.M))
    assert imported == {"msgpack", "websockets"}
    exec(compile(script.replace("8000", str(port)), "protocol.md", "exec"), {})  # noqa: S102
    shape = (VIDEO.frames, VIDEO.height, VIDEO.width, 3)
    assert capsys.readouterr().out == f"painted\n{shape}\n"


def test_the_client_lifts_an_object_of_the_true_world(tmp_path, capsys):
    definitions, script = SCRIPTS[0].split("\n\n\nwith ")[0], SCRIPTS[1]
    small = VideoSpec(frames=17, height=16, width=24, fps=8)
    service, port, _ = run(tmp_path, world=TrueWorld(video=small))
    exec(compile(f"{definitions}\n{script.replace('8000', str(port))}", "protocol.md", "exec"), {})  # noqa: S102
    service.store.close()
    assert capsys.readouterr().out in ("rises by 0.09 m\n", "rises by 0.1 m\n")


def test_the_requests_have_the_documented_fields():
    assert {name: set(fields("Requests", f"`{name}`")) for name in REQUESTS} == {
        name: set(known) for name, known in REQUESTS.items()
    }


def test_the_replies_have_the_documented_fields(port):
    start = fields("Replies", "`create`, `reset`, `load`")
    step, group = fields("Replies", "`step`"), fields("Replies", "group of a streamed step")
    part, saved = fields("Replies", "part before the last"), fields("Replies", "`save`")
    status = fields("Replies", "`status` of a session")
    with Client(f"ws://127.0.0.1:{port}") as client:
        check_all(client.server, {row[0].strip("`"): row[1] for row in rows_of("Description")})
        made = client.request("create", seed=3)
        check_all(made, start | fields("Replies", "only `create`"))
        session, rows = made["session"], made["row"][None]
        client.request("save", session=session, name="here")
        shown = []
        ask = {"session": session, "step_id": 1, "actions": rows, "observe": list(OBSERVATIONS)}
        reply = streamed(port, ask, shown)
        for message in shown:
            check_all(message, group)
        observed = {row[0].strip("`"): row[1] for row in rows_of("Replies") if len(row) == 3}
        extra = {name: observed[name] for name in ("depth", "keypoints", "state")}
        check_all(reply, step | extra)
        for name, kind in re.findall(r"`(\w+)` (\w+ \([n, 3]+\))", TEXT):
            check(reply["state"][name], kind)
        known = {name: observed[name] for name in observed if name not in extra}
        assert reply["info"].keys() == known.keys() - {"scene_warning", "preview"}
        for name in reply["info"]:
            check(reply["info"][name], known[name])
        del ask["observe"]
        check_all(client.request("step", **ask | {"step_id": 2, "part": 1}), part)
        last = client.request("step", **ask | {"step_id": 2, "part": 2})
        check_all(last, {name: kind for name, kind in step.items() if name != "timing"})
        check_all(client.request("save", session=session, name="there"), saved)
        check_all(client.request("load", session=session, name="here"), start)
        check_all(client.request("reset", session=session), start)
        found = client.request("status", session=session)
        assert found.keys() >= status.keys() - {"keys of `info"}
        check_all(client.request("status"), fields("Replies", "`status` of the server"))
        check_all(client.request("close", session=session), fields("Replies", "`close`"))


def test_http_has_the_documented_paths(port):
    listed = {row[0].strip("`") for row in rows_of("HTTP")} - {"GET /openapi.json"}
    paths = json.loads(http(port, "/openapi.json")[1])["paths"]
    assert listed == {f"{m.upper()} {path}" for path, methods in paths.items() for m in methods}


def test_every_code_is_documented():
    sources = (ROOT / "egosim_jax" / "interactive" / "server").glob("*.py")
    text = "".join(path.read_text("utf-8") for path in sources)
    raised = set(re.findall(r"RequestError\(\s*\d+,\s*\"(\w+)\"", text))
    documented = {code for row in rows_of("Errors") for code in re.findall(r"`(\w+)`", row[1])}
    assert documented - {"unknown_path"} == raised
