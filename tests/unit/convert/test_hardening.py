"""Damaged or hostile files: refused in one line, with little time and memory."""

import json
import os
import pickle
import resource
import struct
import time
import zipfile

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

from egosim_jax.convert.detect import detect
from egosim_jax.convert.rules import Rule, assign
from egosim_jax.convert.source import sources
from egosim_jax.io import weights
from egosim_jax.io.mapped import read_metadata, read_safetensors
from egosim_jax.io.untrusted import pickled as pickle_reader
from egosim_jax.io.untrusted.pth import read_pth
from egosim_jax.types import InputError

SECONDS, MEBIBYTES, CHARACTERS = 10, 700, 2000


@pytest.fixture(autouse=True)
def bounded():
    """Little time and memory, whatever the test reads."""
    started, before = time.monotonic(), peak()
    yield
    assert time.monotonic() - started < SECONDS
    assert peak() - before < MEBIBYTES


def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def refused(read, path):
    with pytest.raises(InputError) as error:
        read(path)
    message = str(error.value)
    assert "\n" not in message
    assert len(message) < CHARACTERS
    assert message.isprintable()
    return message


def header(path, text, body=b""):
    text = text if isinstance(text, bytes) else json.dumps(text).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + body)
    return path


def entry(dtype="U8", shape=(4,), places=(0, 4)):
    return {"dtype": dtype, "shape": list(shape), "data_offsets": list(places)}


def pickled(path, program):
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("a/data.pkl", program)
        file.writestr("a/data/0", bytes(16))
    return path


# Safetensors.

WHOLE = entry(shape=(6,), places=(0, 6))
HEADERS = {
    "no JSON": b"{,}",
    "a place outside the file": {"a": entry(shape=(8,), places=(0, 8))},
    "a dtype of four bits": {"a": entry("F4", shape=(12,), places=(0, 6))},
    "lists in lists": b'{"a":' + 50_000 * b"[" + 50_000 * b"]" + b"}",
    "half a surrogate pair": b'{"a\\ud800": ' + json.dumps(WHOLE).encode() + b"}",
    "a name of 600 characters": {600 * "a": WHOLE},
    "a name with a line feed": {"a\nb": WHOLE},
    "places that overlap": {"a": entry(), "b": entry(places=(2, 6))},
    "a hole between": {"a": entry(), "b": entry(shape=(1,), places=(5, 6))},
    "bytes after the last": {"a": entry()},
    "40 axes": {"a": entry(shape=(1,) * 39 + (6,), places=(0, 6))},
    "an empty tensor without end": {
        "a": entry(shape=(0, 2**40, 2**20), places=(0, 0)), "b": WHOLE,
    },
}  # fmt: skip


@pytest.mark.parametrize("name", HEADERS)
def test_a_bad_header_is_refused_in_one_line(tmp_path, name):
    refused(read_safetensors, header(tmp_path / "x.safetensors", HEADERS[name], bytes(6)))


@pytest.mark.parametrize("data", [b"abc", struct.pack("<Q", 1 << 40) + b"{}"])
def test_a_file_without_its_header_is_refused(tmp_path, data):
    (tmp_path / "x.safetensors").write_bytes(data)
    refused(read_safetensors, tmp_path / "x.safetensors")


def test_a_header_of_100_megabytes_is_refused(tmp_path):
    path = tmp_path / "x.safetensors"
    path.write_bytes(struct.pack("<Q", 100 << 20) + b"{")
    os.truncate(path, 101 << 20)
    assert "104,857,600 bytes" in refused(read_safetensors, path)
    assert "104,857,600 bytes" in refused(read_metadata, path)


def test_a_pointer_of_git_lfs_is_called_that(tmp_path):
    for name, read in (("x.safetensors", read_safetensors), ("x.pth", read_pth)):
        path = tmp_path / name
        path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n")
        assert "git lfs pull" in refused(read, path)


@pytest.mark.parametrize("name", ["x.safetensors", "x.pth", "x.safetensors.index.json"])
def test_a_pipe_does_not_block(tmp_path, name):
    os.mkfifo(tmp_path / name)
    where = tmp_path if name.endswith(".json") else tmp_path / name
    assert "not a regular file" in refused(lambda path: list(sources(path)), where)


INDICES = {
    "no JSON": b"{",
    "a list": b"[]",
    "an empty map": b'{"weight_map": {}}',
    "a number as file": b'{"weight_map": {"a": 1}}',
    "lists in lists": 50_000 * b"[",
    "a file outside": b'{"weight_map": {"a": "../x.safetensors"}}',
    "a long name": b'{"weight_map": {"a": "%s"}}' % ((1 << 20) * b"a"),
    "a NUL": b'{"weight_map": {"a": "x\\u0000.safetensors"}}',
    "a tensor that is not there": b'{"weight_map": {"b": "x.safetensors"}}',
}


@pytest.mark.parametrize("name", INDICES)
def test_a_bad_index_is_refused_in_one_line(tmp_path, name):
    save_file({"a": np.zeros(3)}, tmp_path / "x.safetensors")
    (tmp_path / "x.safetensors.index.json").write_bytes(INDICES[name])
    assert "index.json" in refused(lambda path: list(sources(path)), tmp_path)


# Names of layers.


def test_a_layer_of_a_high_number_is_not_known():
    tensors = {"blocks.0.w": np.zeros(1), "blocks.99999999999.w": np.zeros(1)}
    with pytest.raises(InputError, match=r"99999999999\.w: not in the conv"):
        assign(tensors, [Rule("blocks.*.w", "w")])
    tensors = {"blocks.9999.w": np.zeros(1)}
    with pytest.raises(InputError, match="and 9991 more are missing"):
        assign(tensors, [Rule("blocks.*.w", "w")])


def test_a_message_names_a_few_of_many_problems():
    with pytest.raises(InputError) as error:
        assign({f"name {number}": np.zeros(1) for number in range(100_000)}, [Rule("a", "a")])
    assert "and 99,989 more" in str(error.value)
    assert len(str(error.value)) < CHARACTERS


def test_a_file_of_many_networks_is_refused(tmp_path):
    empty = np.zeros(0, np.float32)
    tensors = {f"{number}.visual.cls_embedding": empty for number in range(1000)}
    save_file(tensors, tmp_path / "x.safetensors")
    assert "1000 networks" in refused(detect, tmp_path)


# Pickles.


def text(value):
    return b"X" + struct.pack("<I", len(value)) + value


def number(value):
    data = value.to_bytes(16, "little")
    return b"\x8a\x10" + data


MANY = b"(" + (1 << 12) * b"h\x00" + b"e"
PICKLES = {
    "a key of ten megabytes over a thousand": (
        b"\x80\x02}" + text((10 << 20) * b"k") + b"](" + 1000 * b"N" + b"es."
    ),
    "a name of keys that is too long": (
        b"\x80\x02" + b"".join(b"}" + text(400 * b"k") for _ in range(3)) + b"]sss."
    ),
    "tuples in tuples in a message": b"\x80\x02)" + 60 * b"q\x00h\x00\x86" + b"Q.",
    "tuples in tuples as a key": b"\x80\x02})" + 60 * b"q\x00h\x00\x86" + b"Ns.",
    "a chain of lists of many references": (
        b"\x80\x02]q\x00" + 3 * (b"]" + MANY + b"q\x00") + b"."
    ),
    "nothing, many times, in many lists": (
        b"\x80\x02Nq\x00](" + (1 << 12) * b"h\x00" + b"eq\x00]" + MANY + b"."
    ),
    "numbers as keys that collide": (
        b"\x80\x02}(" + b"".join(number(i * (2**61 - 1)) + b"N" for i in range(1, 5_000)) + b"u."
    ),
    "a key with half a surrogate pair": b"\x80\x02}" + text(b"\xed\xa0\x80") + b"Ns.",
    "a class of a long name": b"\x80\x02c" + (1 << 20) * b"m" + b"\nn\n.",
}


@pytest.mark.parametrize("name", PICKLES)
def test_a_bomb_in_a_pickle_is_refused_in_one_line(tmp_path, name):
    refused(read_pth, pickled(tmp_path / "x.pth", PICKLES[name]))


def test_a_long_pickle_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(pickle_reader, "MAX_STEPS", 1000)
    path = pickled(tmp_path / "x.pth", b"\x80\x02]q\x00]" + MANY + b".")
    assert "more than 1,000 operations" in refused(read_pth, path)


def test_a_zip_of_five_million_entries_is_refused(tmp_path):
    path = tmp_path / "x.pth"
    torch.save({"w": torch.rand(2)}, path)
    data = bytearray(path.read_bytes())
    wide, narrow = data.index(b"PK\6\6"), data.index(b"PK\5\6")
    struct.pack_into("<QQ", data, wide + 24, 5_000_000, 5_000_000)
    struct.pack_into("<HH", data, narrow + 8, 0xFFFF, 0xFFFF)
    path.write_bytes(data)
    assert "5,000,000 entries" in refused(read_pth, path)
    struct.pack_into("<QQ", data, wide + 24, 100_000, 100_000)
    path.write_bytes(data)
    assert "directory is damaged" in refused(read_pth, path)


def test_an_optimizer_state_next_to_the_weights_is_read(tmp_path):
    network = torch.nn.Linear(2, 2)
    optimizer = torch.optim.Adam(network.parameters())
    network(torch.rand(1, 2)).sum().backward()
    optimizer.step()
    torch.save({"m": network.state_dict(), "o": optimizer.state_dict()}, tmp_path / "x.pth")
    assert "o.state.0.exp_avg" in read_pth(tmp_path / "x.pth")


# Files of ours.


def hashed(path):
    rng = np.random.default_rng(0)
    arrays = {"a": rng.normal(size=(3, 4)), "b": rng.integers(0, 9, 5), "c": np.float32(2)}
    weights.write(path, arrays, metadata={"config": "debug"})
    return arrays


def test_what_we_write_is_read_by_others_and_us(tmp_path):
    arrays = hashed(path := tmp_path / "x.safetensors")
    theirs, ours = load_file(path), read_safetensors(path)
    for name, array in arrays.items():
        np.testing.assert_array_equal(theirs[name], array)
        np.testing.assert_array_equal(ours[name].array(), array)
    assert weights.hashes(tmp_path)["x"] == read_metadata(path)["sha256"]


def test_only_the_tensor_that_is_asked_for_is_checked(tmp_path):
    arrays = hashed(path := tmp_path / "x.safetensors")
    data = bytearray(path.read_bytes())
    data[-1] ^= 1  # of `c`, the narrowest
    path.write_bytes(data)
    found = read_safetensors(path)
    np.testing.assert_array_equal(found["a"].array(), arrays["a"])
    assert "c of" in refused(lambda tensor: tensor.array(), found["c"])


def test_weights_without_checksums_are_read(tmp_path):
    save_file({"a": np.arange(3.0)}, tmp_path / "x.safetensors", {"format": "egosim_jax"})
    (tensor,) = read_safetensors(tmp_path / "x.safetensors").values()
    np.testing.assert_array_equal(tensor.array(), np.arange(3.0))


def test_the_pickles_of_these_tests_are_readable_ones(tmp_path):
    assert read_pth(pickled(tmp_path / "x.pth", pickle.dumps({"a": [1, None]}, 2))) == {}
