"""Texts with carriage returns, byte order marks, tabs and blanks read as the plain ones."""

import numpy as np
import pytest

from egosim_jax.data.metadata import read_metadata
from egosim_jax.data.readers.colmap import Colmap
from egosim_jax.data.readers.egovid import _rows
from egosim_jax.data.readers.taste_rob import read_table
from tests.unit.data.readers import test_colmap

BOM = b"\xef\xbb\xbf"
VARIANTS = {
    "crlf": lambda data: data.replace(b"\n", b"\r\n"),
    "cr": lambda data: data.replace(b"\n", b"\r"),
    "bom": lambda data: BOM + data,
    "bom_crlf": lambda data: BOM + data.replace(b"\n", b"\r\n"),
    "trailing_blanks": lambda data: data.replace(b"\n", b"  \n"),
    "no_last_line_feed": lambda data: data.rstrip(b"\n"),
}
TABS = {"tabs": lambda data: data.replace(b" ", b"\t"), "double": lambda d: d.replace(b" ", b"  ")}


@pytest.mark.parametrize("variant", [*VARIANTS, *TABS])
def test_a_colmap_model(world, tmp_path, imported, variant):
    folder = test_colmap.write_model(tmp_path / "room", world, binary=False)
    for path in folder.glob("*.txt"):
        path.write_bytes((VARIANTS | TABS)[variant](path.read_bytes()))
    recording = imported(Colmap(source=tmp_path / "room", fps=10.0))[0]["room"]
    np.testing.assert_allclose(recording.world_from_camera, world.poses, atol=1e-9)
    assert len(recording.points.frames) == world.frames * len(test_colmap.POINTS)


TABLE = b"ego_prior_video,prompt,video_id\na/p.mp4,Pick the cup,a\nb/p.mp4,Place it,b\n"
LINES = (
    b'{"ego_prior_video": "a/p.mp4", "prompt": "Pick the cup", "video_id": "a"}\n'
    b'{"ego_prior_video": "b/p.mp4", "prompt": "Place it", "video_id": "b"}\n'
)


JSON_VARIANTS = ("bom_crlf", "trailing_blanks", "no_last_line_feed", "spaces")


@pytest.mark.parametrize(
    ("variant", "name", "data"),
    [
        *((variant, "m.csv", TABLE) for variant in (*VARIANTS, "spaces")),
        *((variant, "m.jsonl", LINES) for variant in JSON_VARIANTS),
    ],
)
def test_metadata(tmp_path, variant, name, data):
    spaces = {"spaces": lambda d: d.replace(b",", b" , ") if name == "m.csv" else d}
    (tmp_path / name).write_bytes((VARIANTS | spaces)[variant](data))
    clips = read_metadata(tmp_path / name)
    read = [(c.prompt.strip(" "), c.video_id) for c in clips]  # a prompt keeps its blanks
    assert read == [("Pick the cup", "a"), ("Place it", "b")]
    assert clips[0].prior == tmp_path / "a/p.mp4"


@pytest.mark.parametrize("variant", [*VARIANTS, "spaces"])
@pytest.mark.parametrize("reader", ["taste_rob", "egovid"])
def test_tables_of_datasets(tmp_path, variant, reader):
    data = b"video_id,caption\na.mp4,Pick the cup\nb.mp4,Place it\n"
    spaces = {"spaces": lambda d: d.replace(b",", b" , ")}
    data = (VARIANTS | spaces)[variant](data)
    if reader == "taste_rob":
        data = data.replace(b"video_id", b"video")
    (tmp_path / "t.csv").write_bytes(data)
    if reader == "taste_rob":
        found = read_table(tmp_path / "t.csv")
    else:
        found = [(row["video_id"], row["caption"]) for row in _rows(tmp_path / "t.csv")]
    assert found == [("a.mp4", "Pick the cup"), ("b.mp4", "Place it")]
