"""PLY of other programs: every byte order, and every way in which a file can be inconsistent."""

import os
import resource

import numpy as np
import open3d as o3d
import pytest

from egosim_jax.cli.view import View
from egosim_jax.state.ply import MAX_HEADER, read_points, read_triangles
from egosim_jax.state.snapshot import read_ply, write_ply
from egosim_jax.types import InputError

PROPERTIES = [("float", c) for c in "xyz"] + [("uchar", c) for c in ("red", "green", "blue")]


def header(form="ascii", count=2, properties=PROPERTIES, more=""):
    lines = [f"property {kind} {name}" for kind, name in properties]
    return "\n".join(
        ["ply", f"format {form} 1.0", f"element vertex {count}", *lines, f"{more}end_header", ""]
    ).encode()


TEXT = header() + b"0 1 2 10 20 30\n3 4 5 40 50 60\n"
ROWS = [(0, 1, 2, 10, 20, 30), (3, 4, 5, 40, 50, 60)]


@pytest.fixture
def read(tmp_path):
    def read(data):
        (tmp_path / "a.ply").write_bytes(data)
        return read_ply(tmp_path / "a.ply")

    return read


def binary(order="<", count=2, **options):
    form = "binary_little_endian" if order == "<" else "binary_big_endian"
    dtype = [(n, order + {"float": "f4", "uchar": "u1"}[k]) for k, n in PROPERTIES]
    return header(form, count, **options) + np.array(ROWS, dtype).tobytes()


@pytest.mark.parametrize("data", [TEXT, binary("<"), binary(">")], ids=["ascii", "little", "big"])
def test_every_byte_order_is_read(read, data):
    state = read(data)
    np.testing.assert_array_equal(state.points_m, [[0, 1, 2], [3, 4, 5]])
    np.testing.assert_array_equal(state.colors, [[10, 20, 30], [40, 50, 60]])


@pytest.mark.parametrize("text", [True, False])
def test_open3d_writes_what_is_read_and_reads_what_is_written(tmp_path, text):
    rng = np.random.default_rng(0)
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(rng.normal(size=(9, 3)).astype(np.float32)))
    cloud.point.colors = o3d.core.Tensor(rng.integers(0, 256, (9, 3)).astype(np.uint8))
    o3d.t.io.write_point_cloud(str(tmp_path / "a.ply"), cloud, write_ascii=text)
    state = read_ply(tmp_path / "a.ply")
    np.testing.assert_allclose(state.points_m, cloud.point.positions.numpy(), rtol=1e-5)
    np.testing.assert_array_equal(state.colors, cloud.point.colors.numpy())
    write_ply(tmp_path / "b.ply", state)
    again = o3d.t.io.read_point_cloud(str(tmp_path / "b.ply"))
    np.testing.assert_array_equal(again.point.positions.numpy(), state.points_m)
    np.testing.assert_array_equal(again.point.colors.numpy(), state.colors)
    assert "object_ids" in again.point


@pytest.mark.parametrize("data", [TEXT, binary("<"), binary(">")], ids=["ascii", "little", "big"])
@pytest.mark.parametrize("left", [0.3, 0.8, 0.97])
def test_a_file_that_was_cut_off_is_refused(read, data, left):
    """Open3D drew it as if complete, with points that nobody wrote."""
    with pytest.raises(InputError, match="not a readable PLY file"):
        read(data[: int(left * len(data))])


def test_a_file_that_was_cut_off_is_not_drawn(tmp_path):
    (tmp_path / "a.ply").write_bytes(binary()[:-5])
    with pytest.raises(InputError, match="25 bytes follow the header, which specifies 30"):
        View(path=tmp_path / "a.ply", out=tmp_path / "a.png").run()
    assert not (tmp_path / "a.png").exists()


@pytest.mark.parametrize(
    "line", [b"property float " + b"x" * 100_000, b"comment " + b"x" * 5_000_000, b"x" * 100_000]
)
def test_a_header_without_end_is_refused(read, line):
    """Open3D aborted the process."""
    with pytest.raises(InputError, match=f"does not end within {MAX_HEADER:,} bytes|has the line"):
        read(TEXT.replace(b"end_header", line + b"\nend_header"))


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("count", [3, 500_000_000, 10**30])
def test_more_points_than_the_file_can_hold_are_refused_before_there_is_room_for_them(
    read, form, count
):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match=r"specifies|expected 1 to"):
        read(header(form, count) + bytes(40))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


@pytest.mark.parametrize("gone", ["x", "y", "z", "red", "green", "blue"])
def test_a_missing_property_is_named(read, gone):
    properties = [p for p in PROPERTIES if p[1] != gone]
    with pytest.raises(InputError, match=f"missing property {gone}"):
        read(header(properties=properties) + b"1 1 1 1 1\n2 2 2 2 2\n")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (TEXT + b"6 7 8 1 1 1\n", "3 lines follow"),
        (binary() + b"\0", "31 bytes follow"),
        (binary(count=0), "has 0 points"),
        (TEXT.replace(b"0 1 2", b"nan 1 2"), "not finite"),
        (TEXT.replace(b"10 20", b"999 20"), "not a readable PLY"),
        (TEXT.replace(b"0 1 2", b"0 one 2"), "not a readable PLY"),
        (TEXT.replace(b"0 1 2", b"0 1"), "not a readable PLY"),
        (TEXT.replace(b"float x", b"float y"), "not a readable PLY"),
        (TEXT.replace(b"uchar red", b"int red"), "must be uchar"),
        (TEXT.replace(b"uchar red", b"list uchar int red"), "a list property"),
        (TEXT.replace(b"ascii", b"morse"), "has the line"),
        (header(properties=PROPERTIES + [("int", f"p{n}") for n in range(300)]), "properties"),
        (b"", "its first line is not"),
        (b"\x89PNG", "its first line is not"),
    ],
)
def test_an_inconsistent_file_is_refused(read, data, message):
    with pytest.raises(InputError, match=message):
        read(data)


def test_faces_after_the_points_are_skipped(read):
    more = "element face 1\nproperty list uchar int vertex_indices\n"
    faces = binary(more=more) + b"\x03" + bytes(12)
    assert len(read(faces).points_m) == 2
    assert len(read(header(more=more) + b"0 1 2 1 1 1\n3 4 5 1 1 1\n3 0 1 1\n").points_m) == 2
    with pytest.raises(InputError, match="specifies"):
        read(binary(more=more))


def test_triangles_of_a_mesh_are_read_and_other_faces_refused(tmp_path):
    def read(corners, last=(3, 0, 1, 1), order="<"):
        more = f"element face 2\nproperty list uchar {corners} vertex_indices\n"
        dtype = [("count", "u1"), ("v", {"int": "i4", "ushort": "u2"}[corners], 3)]
        faces = np.array([(3, (0, 1, 0)), (last[0], last[1:])], dtype)
        data = faces.astype(faces.dtype.newbyteorder(order)).tobytes()
        (tmp_path / "a.ply").write_bytes(binary(order, more=more) + data)
        return read_triangles(tmp_path / "a.ply").tolist()

    expected = [[0, 1, 0], [0, 1, 1]]
    assert read("int") == read("ushort") == read("int", order=">") == expected
    for last in ((4, 0, 1, 1), (3, 0, 1, 2), (3, -1, 1, 1)):
        with pytest.raises(InputError, match="not triangles of its 2 vertices"):
            read("int", last)
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-1])
    with pytest.raises(InputError, match="damaged"):
        read_triangles(tmp_path / "a.ply")
    for points in (TEXT, binary()):
        (tmp_path / "a.ply").write_bytes(points)
        with pytest.raises(InputError, match="no triangles that can be read"):
            read_triangles(tmp_path / "a.ply")


def test_one_point_of_text_is_read(read):
    assert len(read(header(count=1) + b"0 1 2 10 20 30\n").points_m) == 1


def test_floats_are_colors_from_0_to_1(read):
    data = TEXT.replace(b"uchar", b"float").replace(b"10 20 30", b"0 0.5 1")
    data = data.replace(b"40 50 60", b"1 1 0")
    np.testing.assert_array_equal(read(data).colors, [[0, 128, 255], [255, 255, 0]])
    with pytest.raises(InputError, match="from 0 to 1"):
        read(data.replace(b"0.5", b"1.5"))


def test_ids_that_do_not_fit_are_refused(read):
    properties = [*PROPERTIES, ("uint", "object_ids")]
    data = header(count=1, properties=properties) + b"0 0 0 1 1 1 4000000000\n"
    with pytest.raises(InputError, match="object_ids must be int"):
        read(data)


def test_a_pipe_is_refused_without_waiting_for_it(tmp_path):
    os.mkfifo(tmp_path / "pipe.ply")
    with pytest.raises(InputError, match="not a regular file"):
        read_points(tmp_path / "pipe.ply")
