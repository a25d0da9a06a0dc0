"""Messages between clients and server."""

import msgpack
import numpy as np
import pytest

from egosim_jax.interactive.server import wire
from egosim_jax.types import InputError

ARRAY = {b"__ndarray__": True, b"data": bytes(8), b"dtype": "<f8", b"shape": [1]}


def test_arrays_scalars_and_text_come_back():
    message = {"a": np.arange(6, dtype=np.uint8).reshape(2, 3), "b": np.float32(2.5), "c": ["x"]}
    found = wire.unpack(wire.pack(message), limit=wire.MAX_BYTES)
    np.testing.assert_array_equal(found["a"], message["a"])
    assert (found["b"], found["b"].dtype, found["c"]) == (2.5, np.float32, ["x"])


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({**ARRAY, b"dtype": "O"}, "must be of numbers"),
        ({**ARRAY, b"dtype": ",f8"}, "must be of numbers"),
        ({**ARRAY, b"shape": [1 << 40]}, "whole numbers"),
        ({**ARRAY, b"shape": [-1, -1]}, "whole numbers"),
        ({**ARRAY, b"data": "text"}, "data must be bytes"),
        ({b"__npgeneric__": True, b"data": "7", b"dtype": "<i8"}, "must be a number"),
        ({b"__npgeneric__": True, b"data": 1 << 63, b"dtype": "|i1"}, "NumPy scalar"),
        ([[[[[[[[[[[[[[[[[[1]]]]]]]]]]]]]]]]]], "levels deep"),
    ],
)
def test_what_is_no_array_of_numbers_is_refused(value, message):
    with pytest.raises(InputError, match=message):
        wire.unpack(msgpack.packb({"actions": value}), limit=wire.MAX_BYTES)


@pytest.mark.parametrize("data", [b"", b"\xc1", wire.pack({1: 2}), b"\x93" * 3000])
def test_what_is_not_messagepack_is_refused(data):
    with pytest.raises(InputError, match="is not MessagePack"):
        wire.unpack(data, limit=wire.MAX_BYTES)


@pytest.mark.parametrize("item", [b"\x80", b"\x90", b"\xa1x"])
def test_a_message_of_too_many_items_is_refused(item, monkeypatch):
    monkeypatch.setattr(wire, "MAX_ITEMS", 2000)
    lists = b"\xdd\x00\x00\x02\x00" + item * (1 << 9)
    with pytest.raises(InputError, match="more than 2,000 items"):
        wire.unpack(b"\x94" + lists * 4, limit=wire.MAX_BYTES)
    assert len(wire.unpack(b"\x94" + lists * 4)) == 4
    with pytest.raises(InputError, match="max_array_len"):
        wire.unpack(b"\xdd\x00\xff\xff\xff" * 3, limit=wire.MAX_BYTES)


def pypi(value):
    """Return a value as msgpack_numpy.encode 0.4.8 of PyPI does, if msgpack does not know it."""
    if isinstance(value, np.ndarray):
        structured = value.dtype.kind in "VO"
        return {
            b"nd": True,
            b"type": value.dtype.descr if structured else value.dtype.str,
            b"kind": value.dtype.kind.encode() if structured else b"",
            b"shape": value.shape,
            b"data": b"pickled" if value.dtype.kind == "O" else value.tobytes(),
        }
    if isinstance(value, complex):
        return {b"complex": True, b"data": repr(value)}
    return {b"nd": False, b"type": value.dtype.str, b"data": value.data}


@pytest.mark.parametrize(
    "value",
    [
        np.arange(6.0).reshape(2, 3),
        np.asfortranarray(np.arange(6, dtype=np.float32).reshape(2, 3)),
        np.arange(4, dtype=">i2"),
        np.array([True, False]),
        np.zeros((0, 7)),
        np.array(2.5),
        np.bool_(True),
        np.int64(-3),
    ],
    ids=lambda value: f"{type(value).__name__} {value.dtype.str} {value.shape}",
)
def test_messages_of_pypis_msgpack_numpy_are_read(value):
    data = msgpack.packb({"a": {"b": [value]}}, default=pypi)
    found = wire.unpack(data, limit=wire.MAX_BYTES)["a"]["b"][0]
    assert (type(found), found.dtype) == (type(value), value.dtype)
    np.testing.assert_array_equal(found, value)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.array([{}]), "dtype of an array is a list of 1: it must be of numbers"),
        (np.zeros(2, [("x", "f8")]), "must be of numbers"),
        (np.array(["text"]), "must be of numbers"),
        (1j, "complex number: send real numbers"),
        ({**pypi(np.zeros(2)), b"shape": [3]}, "must agree"),
        ({**pypi(np.zeros(2)), b"shape": None}, "whole numbers"),
        ({**pypi(np.zeros(2)), b"type": "<f9"}, "must be of numbers"),
    ],
    ids=["object", "structured", "text", "complex", "size", "shape", "type"],
)
def test_other_values_of_pypis_msgpack_numpy_are_refused(value, message):
    with pytest.raises(InputError, match=message):
        wire.unpack(msgpack.packb({"a": value}, default=pypi), limit=wire.MAX_BYTES)


def test_pypis_msgpack_numpy_reads_our_arrays():
    def decode(value):
        if b"nd" in value:  # as in msgpack_numpy.decode
            assert value[b"nd"] is True
            return np.ndarray(value[b"shape"], np.dtype(value[b"type"]), value[b"data"])
        return value

    array = np.arange(6, dtype=np.uint8).reshape(2, 3)
    found = msgpack.unpackb(wire.pack({"a": array}), object_hook=decode)
    np.testing.assert_array_equal(found["a"], array)


def test_a_large_message_is_refused_by_its_size():
    with pytest.raises(InputError, match="at most 10"):
        wire.unpack(bytes(11), limit=10)
