"""PLY files of points; the header is checked against the file size before arrays are allocated.

A text header names elements, their number and their properties; the values follow, as text or
binary of either byte order. Points are the element `vertex`; elements after it, such as faces, are
skipped, but must be complete.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.bounded import open_regular, quote, quote_path, quote_text
from egosim_jax.types import InputError

MAX_HEADER = 1 << 16
"""Maximum size of a header in bytes."""
MAX_BYTES = 1 << 29
"""Maximum size of a binary file in bytes."""
MAX_TEXT = 1 << 27
"""Maximum size of a text file in bytes."""
MAX_POINTS = 1 << 24
"""Maximum number of points."""
MAX_PROPERTIES = 256
"""Maximum number of properties of all elements."""
_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
          "float": "f4", "double": "f8"}  # fmt: skip
_TYPES |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4",
           "uint32": "u4", "float32": "f4", "float64": "f8"}  # fmt: skip
_NAMES = {np.dtype(dtype): name for name, dtype in reversed(_TYPES.items())}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class _Element:
    name: str
    count: int
    fields: list[tuple[str, str]] = field(default_factory=list)
    """Names and dtypes of the properties; for a list, the name and dtype of its length."""
    lists: bool = False
    items: str = ""
    """Dtype of the items of its last list."""


def read_points(path: Path) -> np.ndarray:
    """Read the points of a PLY file: a structured array with a field for each property.

    Raises `InputError` if it is not a PLY file, damaged, truncated or too large.
    """
    with _open(path) as (file, order, elements):
        vertex = next((e for e in elements if e.name == "vertex"), None)
        if vertex is None or not 0 < vertex.count <= MAX_POINTS:
            count = vertex.count if vertex else 0
            raise ValueError(f"it has {quote(count)} points; expected 1 to {MAX_POINTS:,}")
        number = elements.index(vertex)
        if vertex.lists or any(element.lists for element in elements[:number]):
            raise ValueError("a list property precedes the points or belongs to them")
        limit = MAX_TEXT if order == "=" else MAX_BYTES
        data = file.read(limit + 1)
        if len(data) > limit:
            raise ValueError(f"it has more than {limit:,} bytes, the limit")
        read = _text if order == "=" else _binary
        return read(data, order, elements, number)


def has_triangles(path: Path) -> bool:
    """Return whether a PLY file has faces."""
    with _open(path) as (_, _, elements):
        return any(e.name == "face" and e.count > 0 for e in elements)


def read_triangles(path: Path) -> np.ndarray:
    """Return the triangles of a binary PLY file, `t 3`: vertex indices of the element `face`.

    Raises `InputError` if it has no triangles, other polygons, or further face properties.
    """
    name = quote_path(path)
    points = read_points(path)
    with _open(path) as (file, order, elements):
        data = file.read(MAX_BYTES)
    number = next((k for k, e in enumerate(elements) if e.name == "face"), None)
    faces = None if number is None else elements[number]
    alone = faces is not None and faces.lists and len(faces.fields) == 1
    if order == "=" or faces is None or not alone or faces.count < 1:
        raise InputError(
            f"{name} has no triangles that can be read: it must be binary, with an element face "
            "of one list of vertex indices. Save the mesh as binary PLY without further properties "
            "of faces."
        )
    start = sum(
        e.count * np.dtype([(n, t) for n, t in e.fields]).itemsize for e in elements[:number]
    )
    layout = np.dtype([("count", order + faces.fields[0][1]), ("v", order + faces.items, 3)])
    if faces.items[0] == "f" or len(data) < start + faces.count * layout.itemsize:
        raise InputError(f"{name} is damaged: it has fewer than {faces.count:,} triangles.")
    rows = np.frombuffer(data, layout, count=faces.count, offset=start)
    triangles = rows["v"].astype(np.int64)
    if (rows["count"] != 3).any() or not 0 <= triangles.min() <= triangles.max() < len(points):
        raise InputError(
            f"{name} has faces that are not triangles of its {len(points):,} vertices. Triangulate "
            "the mesh."
        )
    return triangles


def write_points(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Write points as binary PLY, atomically; each column is a property."""
    dtypes = {name: column.dtype.newbyteorder("<") for name, column in columns.items()}
    points = np.empty(len(next(iter(columns.values()))), list(dtypes.items()))
    for name, column in columns.items():
        points[name] = column
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property {_NAMES[dtype]} {name}" for name, dtype in dtypes.items()]
    with atomic_write(path) as temporary:
        temporary.write_bytes("\n".join([*lines, "end_header\n"]).encode() + points.tobytes())


@contextmanager
def _open(path: Path) -> Iterator[tuple[io.BufferedReader, str, list[_Element]]]:
    """Open a file after its header, and raise `InputError` with its name for a `ValueError`."""
    with open_regular(path) as file:
        try:
            yield file, *_header(file)
        except ValueError as error:
            why = quote_text(str(error))
            raise InputError(f"{quote_path(path)} is not a readable PLY file: {why}.") from error


def _header(file: io.BufferedReader) -> tuple[str, list[_Element]]:
    """Return the byte order and the elements of a PLY header. Raises `ValueError`."""
    head = file.read(MAX_HEADER)
    lines = head.decode("latin-1").split("\n")
    if lines[0].rstrip("\r") != "ply":
        raise ValueError("its first line is not 'ply'")
    order, elements, properties = "", [], 0
    end = len(lines[0]) + 1
    for line in lines[1:-1]:
        end += len(line) + 1
        match line.split():
            case ["end_header"] if order:
                file.seek(end)
                return order, elements
            case ["format", name, "1.0"] if name in _ORDERS and not order:
                order = _ORDERS[name]
            case ["comment" | "obj_info", *_]:
                pass
            case ["element", name, count] if count.isascii() and count.isdigit():
                # 20 digits exceed every limit; `int` is slow for thousands.
                elements.append(_Element(name, int(count[:20])))
            case ["property", kind, name] if kind in _TYPES and elements:
                elements[-1].fields.append((name, _TYPES[kind]))
                properties += 1
            case ["property", "list", length, kind, name] if (
                {length, kind} <= _TYPES.keys() and elements and _TYPES[length][0] != "f"
            ):
                elements[-1].fields.append((name, _TYPES[length]))
                elements[-1].lists, elements[-1].items = True, _TYPES[kind]
                properties += 1
            case _:
                raise ValueError(f"its header has the line {quote(line)}")
        if properties > MAX_PROPERTIES:
            raise ValueError(f"it has more than {MAX_PROPERTIES} properties")
    raise ValueError(f"its header does not end within {MAX_HEADER:,} bytes")


def _binary(data: bytes, order: str, elements: list[_Element], number: int) -> np.ndarray:
    sizes = [
        element.count * np.dtype([(n, order + t) for n, t in element.fields]).itemsize
        for element in elements
    ]
    open_ended = any(element.lists for element in elements)
    if len(data) < sum(sizes) or (len(data) > sum(sizes) and not open_ended):
        raise ValueError(
            f"{len(data):,} bytes follow the header, which specifies "
            f"{'at least ' * open_ended}{quote(sum(sizes))}"
        )
    dtype = [(name, order + kind) for name, kind in elements[number].fields]
    count = elements[number].count
    return np.frombuffer(data, dtype, count=count, offset=sum(sizes[:number]))


def _text(data: bytes, order: str, elements: list[_Element], number: int) -> np.ndarray:
    wanted = sum(element.count for element in elements)
    lines = data.count(b"\n") + (not data.endswith(b"\n"))
    if wanted > lines:
        raise ValueError(f"{lines:,} lines follow the header, which specifies {quote(wanted)}")
    before = sum(element.count for element in elements[:number])
    rows = (line for line in io.BytesIO(data) if not line.isspace())
    points = np.loadtxt(
        (row.decode("ascii") for row in rows),
        [(name, order + kind) for name, kind in elements[number].fields],
        comments=None,
        skiprows=before,
        max_rows=elements[number].count,
        ndmin=1,
    )
    left = sum(1 for _ in rows)
    if len(points) < elements[number].count or left != wanted - before - len(points):
        raise ValueError(
            f"{before + len(points) + left:,} lines follow the header, which specifies {wanted:,}"
        )
    return points
