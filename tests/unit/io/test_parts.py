"""Files are joined from their parts unchanged, or not at all."""

import json

import numpy as np
import pytest

from egosim_jax.io.parts import DESCRIPTION, cut, join
from egosim_jax.types import InputError


@pytest.fixture
def files(tmp_path):
    """Files of no bytes, of a few bytes, and of a multiple of the part size."""
    rng, made = np.random.default_rng(0), []
    for name, size in (("none.bin", 0), ("few.bin", 250), ("even.safetensors", 300)):
        made.append(tmp_path / name)
        made[-1].write_bytes(rng.bytes(size))
    return made


@pytest.fixture
def folder(files, tmp_path):
    cut(files, tmp_path / "parts", part_bytes=100)
    return tmp_path / "parts"


def test_joined_parts_are_the_files(files, folder, tmp_path):
    assert sorted(x.stat().st_size for x in folder.glob("*.0*")) == [50, 100, 100, 100, 100, 100]
    joined = join(folder, tmp_path / "out")
    assert [path.name for path in joined] == [path.name for path in files]
    for have, want in zip(joined, files, strict=True):
        assert have.read_bytes() == want.read_bytes()


def test_new_parts_replace_the_old_ones(files, folder, tmp_path):
    cut(files[1:2], folder, part_bytes=200)
    assert sorted(path.name for path in folder.iterdir()) == [
        "few.bin.000",
        "few.bin.001",
        DESCRIPTION,
    ]


def test_a_damaged_a_short_and_a_missing_part_are_named(folder, tmp_path):
    part = folder / "few.bin.001"
    data = part.read_bytes()
    for damaged in (data[:-1] + bytes([data[-1] ^ 1]), data[:-1], None):
        part.unlink()
        if damaged is not None:
            part.write_bytes(damaged)
        with pytest.raises(InputError, match=r"few\.bin\.001"):
            join(folder, tmp_path / "out")
        assert not (tmp_path / "out" / "few.bin").exists()
        part.write_bytes(data)


def test_parts_in_another_order_are_refused(folder, tmp_path):
    described = json.loads((folder / DESCRIPTION).read_text())
    described["files"]["even.safetensors"]["parts"].reverse()
    (folder / DESCRIPTION).write_text(json.dumps(described))
    with pytest.raises(InputError, match=r"even\.safetensors, joined from"):
        join(folder, tmp_path / "out")


@pytest.mark.parametrize("name", ["../few.bin", "/etc/passwd", ".hidden", "a/b", ""])
@pytest.mark.parametrize("where", ["file", "part"])
def test_a_name_outside_of_the_folder_is_refused(folder, tmp_path, where, name):
    described = json.loads((folder / DESCRIPTION).read_text())
    entry = described["files"].pop("few.bin")
    if where == "part":
        entry["parts"][0]["file"] = name
    described["files"][name if where == "file" else "few.bin"] = entry
    (folder / DESCRIPTION).write_text(json.dumps(described))
    with pytest.raises(InputError, match="does not describe"):
        join(folder, tmp_path / "out")


@pytest.mark.parametrize("text", ["[]", "{}", '{"files": []}', '{"files": {"a": 1}}', "{"])
def test_a_description_of_another_form_is_refused(folder, tmp_path, text):
    (folder / DESCRIPTION).write_text(text)
    with pytest.raises(InputError, match=DESCRIPTION):
        join(folder, tmp_path / "out")
