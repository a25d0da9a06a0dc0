"""States read back equal what was written, and damaged files are refused by name."""

import json
from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.state.snapshot import fingerprint, load, read_ply, save, write_ply
from egosim_jax.types import InputError, SceneState


def state(count=50):
    rng = np.random.default_rng(0)
    return SceneState(
        points_m=rng.normal(size=(count, 3)).astype(np.float32),
        colors=rng.integers(0, 256, (count, 3)).astype(np.uint8),
        object_ids=rng.integers(0, 3, count).astype(np.int32),
        last_seen=rng.integers(0, 5, count).astype(np.int32),
        intrinsics_px=np.array([[100.0, 0, 49.5], [0, 100, 29.5], [0, 0, 1]]),
        step=4,
        names={1: "red cup", 2: "lid"},
        world_from_object={2: np.diag([-1.0, -1, 1, 1])},
        held={0: 2},
        provenance={"world": "tabletop"},
    )


def test_a_state_that_is_read_equals_the_one_written(tmp_path):
    save(tmp_path / "state", state())
    again = load(tmp_path / "state")
    assert fingerprint(again) == fingerprint(state())
    for name in ("points_m", "colors", "object_ids", "last_seen", "intrinsics_px"):
        np.testing.assert_array_equal(getattr(again, name), getattr(state(), name))
        assert getattr(again, name).dtype == getattr(state(), name).dtype
    assert (again.step, again.names, again.provenance) == (
        4,
        {1: "red cup", 2: "lid"},
        {"world": "tabletop"},
    )
    np.testing.assert_array_equal(again.world_from_object[2], np.diag([-1.0, -1, 1, 1]))
    assert again.held == {0: 2}


def test_a_state_is_replaced_atomically(tmp_path):
    save(tmp_path / "state", state(50))
    save(tmp_path / "state", state(20))
    assert len(load(tmp_path / "state").points_m) == 20
    assert [path.name for path in tmp_path.iterdir()] == ["state"]


@pytest.mark.parametrize(
    "change",
    [
        {"step": 5},
        {"names": {1: "blue cup", 2: "lid"}},
        {"colors": np.zeros((50, 3), np.uint8)},
        {"world_from_object": {}},
        {"held": {1: 2}},
        {"held": {}},
    ],
)
def test_any_change_changes_the_fingerprint(change):
    assert fingerprint(replace(state(), **change)) != fingerprint(state())


def test_a_flipped_byte_is_named(tmp_path):
    save(tmp_path / "state", state())
    path = tmp_path / "state" / "points.npz"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))
    with pytest.raises(InputError, match=r"points\.npz is damaged"):
        load(tmp_path / "state")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 2}, "has version 2; this program reads version 1"),
        ({"step": "4"}, "not a count"),
        ({"step": True}, "not a count"),
        ({"step": -1}, "not a count"),
        ({"names": {"1": 5}}, "names is not a mapping to text"),
        ({"names": []}, "names is not a mapping to text"),
        ({"names": {"one": "cup"}}, "not an object id"),
        ({"names": {"1" * 12: "cup"}}, "not an object id"),
        ({"provenance": {"world": None}}, "provenance is not a mapping"),
        ({"world_from_object": {"2": [[1, 0], [0, 1]]}}, "is not 4 x 4 numbers"),
        ({"world_from_object": None}, "not a mapping to poses"),
        ({"held": []}, "held is not a mapping"),
        ({"held": {"0": "2"}}, "held is not a mapping"),
        ({"held": {"left": 2}}, "not an object id"),
        ({"intrinsics_px": "eye"}, "is not 3 x 3 numbers"),
        ({"intrinsics_px": [[1, 0, 0], [0, 1, 0], [0, 0, None]]}, "is not 3 x 3 numbers"),
        ({"intrinsics_px": [[1, 0, 0], [0, 1, 0], [0, 1]]}, "is not 3 x 3 numbers"),
        ({"intrinsics_px": [[1, 0, 0], [0, 1, 0], [0, 0, np.nan]]}, "is not finite"),
        ({"held": {"0": 1}}, "was changed"),
        ({"points": 7}, "was changed"),
        ({"step": 5}, "was changed"),
        ({"names": {"1": "blue cup", "2": "lid"}}, "was changed"),
        ({"sha256": 0}, ""),
    ],
    ids=str,
)
def test_a_changed_description_is_named(tmp_path, change, message):
    save(tmp_path / "state", state())
    path = tmp_path / "state" / "state.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(InputError, match=f"not a readable state.*{message}"):
        load(tmp_path / "state")


def test_a_description_without_its_hash_is_refused(tmp_path):
    save(tmp_path / "state", state())
    path = tmp_path / "state" / "state.json"
    written = json.loads(path.read_text())
    del written["description_sha256"]
    path.write_text(json.dumps(written))
    with pytest.raises(InputError, match="was changed after it was written"):
        load(tmp_path / "state")


def test_a_save_that_fails_leaves_the_older_state(tmp_path, monkeypatch):
    save(tmp_path / "state", state(50))

    def fail(path):
        return (path.parent / "missing").read_bytes()

    monkeypatch.setattr("egosim_jax.state.snapshot.sha256", fail)
    with pytest.raises(OSError, match="No such file"):
        save(tmp_path / "state", state(20))
    monkeypatch.undo()
    assert len(load(tmp_path / "state").points_m) == 50
    assert [path.name for path in tmp_path.iterdir()] == ["state"]


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"version": 1}'])
def test_files_that_are_not_a_state_are_named(tmp_path, text):
    (tmp_path / "state.json").write_text(text)
    with pytest.raises(InputError, match="not a readable state"):
        load(tmp_path)


def test_ply_keeps_positions_colors_and_ids(tmp_path):
    write_ply(tmp_path / "a.ply", state())
    again = read_ply(tmp_path / "a.ply", state())
    for name in ("points_m", "colors", "object_ids", "last_seen"):
        np.testing.assert_array_equal(getattr(again, name), getattr(state(), name))
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points_m": np.zeros((0, 3), np.float32)}, "one for each point"),
        ({"points_m": np.full((50, 3), np.nan, np.float32)}, "Point 0 of the state is not finite"),
    ],
)
def test_points_that_are_not_a_valid_state_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        replace(state(), **change)


def test_a_state_without_points_is_refused():
    with pytest.raises(InputError, match="at least one point"):
        state(0)
