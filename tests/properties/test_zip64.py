"""The zip reader and Python's agree on archives with every combination of ZIP64 fields."""

import contextlib
import io
import itertools
import struct
import zipfile
import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from egosim_jax.io.untrusted.zipped import from_file

WIDE, COUNT = 0xFFFFFFFF, 0xFFFF
FIELDS = list(itertools.product([False, True], repeat=3))
"""Choices of size, packed size and offset of an entry: True for those in its ZIP64 field."""
contents = st.binary(max_size=300)
others = st.sampled_from([b"", struct.pack("<HH4s", 0xCAFE, 4, b"abcd"), b"\0\0"])


def entry(name, content, packed, local64):
    """Return the local header and the content of an entry, and what its central header repeats."""
    method = 8 if packed else 0
    deflater = zlib.compressobj(wbits=-15)
    data = deflater.compress(content) + deflater.flush() if packed else content
    extra = struct.pack("<HHQQ", 1, 16, len(content), len(data)) if local64 else b""
    about = struct.pack("<HHHHHI", 45, 0, method, 0, 0x21, zlib.crc32(content))
    sizes = (WIDE, WIDE) if local64 else (len(data), len(content))
    header = b"PK\3\4" + about + struct.pack("<IIHH", *sizes, len(name), len(extra)) + name + extra
    return header + data, about, len(data)


def archive(entries, end64):
    """Return a zip of entries `(content, packed, local64, wide, before, after)`.

    `wide` has the numbers in the ZIP64 field, between other extra fields. `end64` places the
    number of entries and the offset of the directory in the 64-bit end record.
    """
    data, directory = b"", b""
    for number, (content, packed, local64, wide, before, after) in enumerate(entries):
        name, offset = f"entry/{number}".encode(), len(data)
        local, about, size = entry(name, content, packed, local64)
        data += local
        numbers = (len(content), size, offset)
        field = b"".join(struct.pack("<Q", n) for n, w in zip(numbers, wide, strict=True) if w)
        before = before if len(before) >= 4 else b""
        extra = before + (struct.pack("<HH", 1, len(field)) + field if field else b"") + after
        full, packed_size, offset = (WIDE if w else n for n, w in zip(numbers, wide, strict=True))
        directory += b"PK\1\2\x2d\3" + about + struct.pack(
            "<IIHHHHHII", packed_size, full, len(name), len(extra), 0, 0, 0, 0, offset
        ) + name + extra  # fmt: skip
    count, at, end = len(entries), len(data), b""
    if end64:
        end = struct.pack(
            "<4sQHHIIQQQQ", b"PK\6\6", 44, 45, 45, 0, 0, count, count, len(directory), at
        ) + struct.pack("<4sIQI", b"PK\6\7", 0, at + len(directory), 1)
        count, at = COUNT, WIDE
    sizes = (count, count, WIDE if end64 else len(directory), at)
    return data + directory + end + struct.pack("<4sHHHHIIH", b"PK\5\6", 0, 0, *sizes, 0)


def ours(data):
    found = from_file(io.BytesIO(data))
    return {name: found.read(name) for name in found.entries}


def standard(data):
    with zipfile.ZipFile(io.BytesIO(data)) as found:
        return {name: found.read(name) for name in found.namelist()}


@settings(max_examples=60)
@given(
    wide=st.sampled_from(FIELDS),
    end64=st.booleans(),
    rows=st.lists(
        st.tuples(contents, st.booleans(), st.booleans(), st.none(), others, others),
        min_size=1, max_size=4,
    ),
)  # fmt: skip
def test_an_archive_with_zip64_fields_is_read_as_python_reads_it(wide, end64, rows):
    rows = [(*row[:3], wide if n == 0 else FIELDS[n], *row[4:]) for n, row in enumerate(rows)]
    data = archive(rows, end64)
    expected = {f"entry/{n}": row[0] for n, row in enumerate(rows)}
    assert ours(data) == standard(data) == expected


@given(st.sampled_from(FIELDS[1:]), st.integers(1, 28), contents)
def test_a_cut_zip64_field_is_refused_by_both(wide, cut, content):
    data = archive([(content, False, False, wide, b"", b"")], False)
    at = data.rindex(b"PK\1\2")
    (named, extra) = struct.unpack_from("<HH", data, at + 28)
    size = max(0, extra - 4 - cut)
    start = at + 46 + named
    for length in (size, extra - 4):  # fewer numbers, and a field beyond its header
        field = struct.pack("<HH", 1, length) + data[start + 4 : start + 4 + size]
        cut_data = data[: at + 30] + struct.pack("<H", len(field)) + data[at + 32 : start] + field
        cut_data += struct.pack("<4sHHHHIIH", b"PK\5\6", 0, 0, 1, 1, len(cut_data) - at, at, 0)
        with pytest.raises(zipfile.BadZipFile):
            standard(cut_data)
        with pytest.raises(ValueError, match="cut"):
            ours(cut_data)


@given(st.data())
def test_a_damaged_directory_is_read_or_a_value_error(data):
    intact = archive(
        [(b"abc", True, True, wide, b"", b"") for wide in FIELDS], data.draw(st.booleans())
    )
    damaged = bytearray(intact)
    places = st.integers(intact.index(b"PK\1\2"), len(intact) - 1)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(places)] = data.draw(st.sampled_from([0, 1, 8, 0x7F, 0xFF]))
    with contextlib.suppress(ValueError):
        assert set(ours(bytes(damaged)).values()) <= {b"abc"}
