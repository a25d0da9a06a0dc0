"""Checkpoints of real size, as files of holes: read as they are, and by their outlines."""

import json
from pathlib import Path

import ml_dtypes
import numpy as np
import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from egosim_jax import configs
from egosim_jax.convert.detect import detect
from egosim_jax.convert.outline import write_outline
from egosim_jax.convert.plan import to_jax, to_torch
from egosim_jax.convert.source import sources
from egosim_jax.convert.tables import weight_shapes
from egosim_jax.io.mapped import TensorInfo, header
from egosim_jax.io.untrusted.pth import read_pth
from egosim_jax.io.untrusted.zipped import open_archive
from egosim_jax.types import InputError
from tests.unit.convert.test_full_size import shaped

CONFIG = configs.get("egosim_14b")
BFLOAT16 = np.dtype(ml_dtypes.bfloat16)


def released(network):
    """Return the shape of each tensor of a network in Wan's release."""
    found = CONFIG.networks[network]
    return {w.name: w.shape for w in to_torch(shaped(weight_shapes(found)), found, "wan")}


@pytest.fixture(scope="module")
def umt5(tmp_path_factory):
    """UmT5's encoder as torch saves it, 11 GB without values."""
    path = tmp_path_factory.mktemp("umt5") / "models_t5_umt5-xxl-enc-bf16.pth"
    with FakeTensorMode():
        state = {n: torch.empty(s, dtype=torch.bfloat16) for n, s in released("text").items()}
    with torch.serialization.skip_data(materialize_fake_tensors=True):
        torch.save(state, path)
    assert path.stat().st_size > 11e9
    return path


def outlined(path: Path, folder: Path) -> tuple[Path, list[int]]:
    """Return the outline of a file, and the size of each read."""
    reads = []

    def read(name, at, count):
        reads.append(count)
        with path.open("rb") as file:
            file.seek(at)
            return file.read(count)

    write_outline(folder, {path.name: path.stat().st_size}, read)
    return folder / path.name, reads


def test_a_pth_of_11_gb_is_read_beyond_4_gib(umt5):
    values = np.arange(4096).astype(BFLOAT16)
    with open_archive(umt5) as archive:
        begin = max(entry.begin for entry in archive.entries.values() if entry.size == 8192)
    with umt5.open("r+b") as file:
        file.seek(begin)
        file.write(values.tobytes())
    found = read_pth(umt5)
    assert {name: tensor.shape for name, tensor in found.items()} == released("text")
    np.testing.assert_array_equal(found["norm.weight"].array(), values)
    assert not found["blocks.23.norm2.weight"].array().any()


def test_an_outline_of_a_pth_is_planned_like_the_file(umt5, tmp_path):
    outline, reads = outlined(umt5, tmp_path)
    assert outline.stat().st_size == umt5.stat().st_size
    assert 512 * outline.stat().st_blocks < 8 << 20
    assert (len(reads), sum(reads) < 4 << 20) == (4, True)
    (found,) = detect(tmp_path, CONFIG).found
    (expected,) = detect(umt5, CONFIG).found
    plans = [[(w.name, w.shape, w.dtype) for w in to_jax(f, CONFIG)] for f in (found, expected)]
    assert plans[0] == plans[1]


def test_tensors_beyond_4_gib_in_safetensors_are_read(tmp_path):
    """One tensor of over 2**31 elements and 4 GiB, and one after it."""
    infos = [TensorInfo("a", (1 << 16, (1 << 15) + 1), BFLOAT16), TensorInfo("b", (4,), BFLOAT16)]
    head = header(infos, {})
    values, size = np.arange(4).astype(BFLOAT16), 2 * ((1 << 31) + (1 << 16) + 4)
    with (tmp_path / "x.safetensors").open("wb") as file:
        file.truncate(len(head) + size)
        file.write(head)
        for end in (8, 0):  # the last values of each tensor
            file.seek(len(head) + size - 8 - end)
            file.write(values.tobytes())
    (source,) = sources(tmp_path)
    np.testing.assert_array_equal(source.tensors["b"].array(), values)
    np.testing.assert_array_equal(source.tensors["a"].array()[-1, -4:], values)
    outline, reads = outlined(tmp_path / "x.safetensors", tmp_path / "outline")
    assert sum(reads) == len(head)
    (again,) = sources(outline)
    assert {n: t.shape for n, t in again.tensors.items()} == {i.name: i.shape for i in infos}


@pytest.mark.parametrize("cut", [1, 1000, 10**9])
def test_an_outline_of_a_damaged_file_is_refused_like_the_file(umt5, tmp_path, cut):
    damaged = tmp_path / umt5.name
    with damaged.open("wb") as file, umt5.open("rb") as source:
        file.write(source.read(1 << 16))
        file.truncate(umt5.stat().st_size)
        source.seek(-(1 << 20), 2)
        file.seek(-(1 << 20), 2)
        file.write(source.read())
        file.truncate(umt5.stat().st_size - cut)
    outline, _ = outlined(damaged, tmp_path / "outline")
    for path in (damaged, outline):
        with pytest.raises(InputError, match="cannot be read"):
            read_pth(path)


def test_an_index_is_outlined_in_full(tmp_path):
    text = json.dumps({"weight_map": {"a": "x-00001-of-00001.safetensors"}})
    (tmp_path / "x.safetensors.index.json").write_text(text)
    outline, _ = outlined(tmp_path / "x.safetensors.index.json", tmp_path / "outline")
    assert outline.read_text() == text
