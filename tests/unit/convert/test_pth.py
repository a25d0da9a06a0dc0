"""`.pth` files are read as torch reads them, and nothing in them is ever run."""

import collections
import io
import os
import pickle
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from egosim_jax.io.untrusted.pth import read_pth
from egosim_jax.types import InputError


def same_bits(ours, theirs):
    assert ours.shape == tuple(theirs.shape)
    assert str(theirs.dtype) == f"torch.{ours.dtype.name}"
    bits = theirs.contiguous().view(torch.uint8) if theirs.ndim else theirs
    if theirs.ndim:
        ours = np.ascontiguousarray(ours).view(np.uint8)
        np.testing.assert_array_equal(ours.reshape(-1), bits.numpy().reshape(-1))
    else:
        assert ours.item() == theirs.item()


def flattened(tree, name=""):
    if isinstance(tree, torch.Tensor):
        return {name: tree}
    items = tree.items() if isinstance(tree, dict) else enumerate(tree)
    found = {}
    if isinstance(tree, (dict, list, tuple)):
        for key, value in items:
            if isinstance(value, (torch.Tensor, dict, list, tuple)):
                found |= flattened(value, f"{name}.{key}" if name else str(key))
    return found


def check(path: Path):
    # torch's weights-only reader knows only protocol 2; this test wrote the file itself.
    expected = flattened(torch.load(path, weights_only=False))
    found = read_pth(path)
    assert list(found) == list(expected)
    for name, tensor in found.items():
        same_bits(tensor.array(), expected[name].detach())
        assert not tensor.array().flags.writeable


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_every_protocol_reads_as_torch_does(tmp_path, protocol):
    network = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.BatchNorm1d(4))
    torch.save(network.state_dict(), tmp_path / "a.pth", pickle_protocol=protocol)
    check(tmp_path / "a.pth")


DTYPES = [
    torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.float8_e4m3fn,
    torch.float8_e5m2, torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8,
    torch.uint16, torch.bool,
]  # fmt: skip


def test_every_dtype_keeps_its_bits(tmp_path):
    values = 10 * torch.rand(5, 7)
    torch.save({str(dtype): values.to(dtype) for dtype in DTYPES}, tmp_path / "a.pth")
    check(tmp_path / "a.pth")


def test_views_of_a_shared_storage_are_read_in_place(tmp_path):
    whole = torch.arange(60.0).reshape(3, 4, 5)
    views = {
        "whole": whole,
        "transposed": whole.transpose(0, 2),
        "part": whole[1:, ::2, 3],
        "row": whole[2, 1],
        "one": whole[0, 0, 0],
        "none": whole[:0],
        "repeated": whole[:, :1, 0].expand(3, 4),
    }
    torch.save(views, tmp_path / "a.pth")
    check(tmp_path / "a.pth")
    assert read_pth(tmp_path / "a.pth")["transposed"].array().base is not None


def test_containers_parameters_and_plain_values_around_tensors(tmp_path):
    tree = {
        "model_state": collections.OrderedDict(a=torch.nn.Parameter(torch.rand(2))),
        "lists": [torch.rand(2), (torch.rand(3), [torch.rand(1)])],
        "epoch": 3, "rate": 1e-4, "name": "ä", "nothing": None, "yes": True, 7: torch.rand(1),
        "shape": torch.Size([2, 3]), "big": 2**70,
    }  # fmt: skip
    torch.save(tree, tmp_path / "a.pth")
    check(tmp_path / "a.pth")


class Calls:
    """Pickles as a call of anything."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


class Persistent:
    """Pickles as a reference to a storage."""

    def __init__(self, *about):
        self.about = about


class Writer(pickle.Pickler):
    def persistent_id(self, obj):
        return obj.about if isinstance(obj, Persistent) else None


def pickled(tree) -> bytes:
    file = io.BytesIO()
    Writer(file, protocol=2).dump(tree)
    return file.getvalue()


def archive(path: Path, entries: dict[str, bytes], compression=zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", compression) as file:
        for name, data in entries.items():
            file.writestr(name, data)
    return path


def tensor(offset=0, size=(2, 2), stride=(2, 1), count=4, key="0", kind=torch.FloatStorage):
    storage = Persistent("storage", kind, key, "cpu", count)
    rebuild = torch._utils._rebuild_tensor_v2
    return Calls(rebuild, storage, offset, size, stride, False, collections.OrderedDict())


def saved(path: Path, tree, **entries: bytes) -> Path:
    fixed = {"a/data.pkl": pickled(tree), "a/data/0": np.arange(4, dtype=np.float32).tobytes()}
    return archive(path, {**fixed, **entries})


def touch(path):
    Path(path).write_text("run", encoding="utf-8")


def test_the_forge_of_these_tests_makes_readable_files(tmp_path):
    found = read_pth(saved(tmp_path / "a.pth", {"w": tensor()}))
    np.testing.assert_array_equal(found["w"].array(), [[0, 1], [2, 3]])


FORGED = {
    "a call of the system": lambda mark: Calls(os.system, f"touch {mark}"),
    "a call of eval": lambda mark: Calls(eval, f"open({str(mark)!r}, 'w')"),
    "a function of the tests": lambda mark: Calls(touch, str(mark)),
    "an object with a state": lambda mark: collections.Counter("a"),
    "a set": lambda mark: {"w": {1, 2}},
    "a stride that reaches out": lambda mark: tensor(stride=(200, 1)),
    "an offset beyond the end": lambda mark: tensor(offset=4),
    "a negative stride": lambda mark: tensor(stride=(-2, 1)),
    "a negative offset": lambda mark: tensor(offset=-1),
    "a size that is no number": lambda mark: tensor(size=("2", 2)),
    "fewer strides than sizes": lambda mark: tensor(stride=(1,)),
    "an element repeated for ever": lambda mark: tensor(size=(10**6, 10**6), stride=(0, 0)),
    "a storage larger than its bytes": lambda mark: tensor(count=1000),
    "a storage that is missing": lambda mark: tensor(key="9"),
    "a storage outside": lambda mark: tensor(key="../../etc/passwd"),
    "a storage of another kind": lambda mark: tensor(kind=dict),
    "a reference to something else": lambda mark: {"w": Persistent("module", 1)},
    "a name by itself": lambda mark: {"w": torch.FloatStorage},
    "a rebuild of something else": (lambda mark: Calls(torch._utils._rebuild_tensor_v2, 1, 2, 3)),
}


@pytest.mark.parametrize("name", FORGED)
def test_a_forged_pickle_is_refused_and_not_run(tmp_path, name):
    mark = tmp_path / "mark"
    path = saved(tmp_path / "a.pth", {"first": FORGED[name](mark)})
    with pytest.raises(InputError, match=re.escape(str(path))):
        read_pth(path)
    assert not mark.exists()


RAW = {
    "an instance of a class by an old operation": b"(S'x'\nios\nsystem\n.",
    "a state of a number": b"K\x01K\x02b.",
    "a value that was not made": b"\x80\x020.",
    "an empty stack": b"\x80\x02\x85.",
    "no mark": b"\x80\x02t.",
    "a memory that was not written": b"\x80\x02h\x05.",
    "an extension": b"\x80\x02\x82\x01.",
    "a key twice": b"\x80\x02}(X\x01\x00\x00\x00aK\x01X\x01\x00\x00\x00aK\x02u.",
    "no end": b"\x80\x02}",
    "text longer than the file": b"\x80\x02X\xff\xff\xff\x7fa.",
    "a list in itself": b"\x80\x02]q\x00h\x00a.",
    "a thousand million lists": b"\x80\x02]q\x00" + b"".join(
        b"]q" + bytes([i + 1]) + b"(" + 10 * (b"h" + bytes([i])) + b"e" for i in range(9)
    ) + b".",
    "lists in lists in lists": b"\x80\x02" + 5000 * b"]" + 4999 * b"a" + b".",
}  # fmt: skip


@pytest.mark.parametrize("name", RAW)
def test_a_broken_pickle_is_refused(tmp_path, name):
    with pytest.raises(InputError):
        read_pth(archive(tmp_path / "a.pth", {"a/data.pkl": RAW[name]}))


def test_files_that_are_no_archive_of_torch_are_refused(tmp_path):
    pkl, bytes_4 = pickled({"w": tensor()}), np.arange(4, dtype=np.float32).tobytes()
    whole = {"a/data.pkl": pkl, "a/data/0": bytes_4}
    for number, (entries, compression) in enumerate(
        (
            ({**whole, "a/../../b": b"x"}, zipfile.ZIP_STORED),
            ({**whole, "/etc/passwd": b"x"}, zipfile.ZIP_STORED),
            (whole, zipfile.ZIP_DEFLATED),
            ({"a/bomb": bytes(1 << 24), **whole}, zipfile.ZIP_DEFLATED),
            ({"a/data/0": bytes_4}, zipfile.ZIP_STORED),
            ({**whole, "a/byteorder": b"big"}, zipfile.ZIP_STORED),
            ({**whole, "b/data.pkl": pkl}, zipfile.ZIP_STORED),
        )
    ):
        with pytest.raises(InputError):
            read_pth(archive(tmp_path / str(number), entries, compression))
    torch.save({"w": torch.rand(3)}, tmp_path / "old.pth", _use_new_zipfile_serialization=False)
    (tmp_path / "empty").touch()
    for path in (tmp_path / "old.pth", tmp_path / "empty", tmp_path / "absent"):
        with pytest.raises(InputError, match=path.name):
            read_pth(path)
