"""Checkpoints: state and data position, saved and restored together."""

import errno
import os
from pathlib import Path
from types import SimpleNamespace

import grain
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import SingleDeviceSharding

from egosim_jax.io.checkpoint import HASHES, Checkpoints
from egosim_jax.types import InputError


def numbers() -> grain.DatasetIterator:
    return iter(grain.MapDataset.range(100).shuffle(seed=1).repeat().to_iter_dataset())


def state(size: int = 3) -> dict[str, jax.Array]:
    return {"weights": jnp.arange(size, dtype=jnp.float32), "step": jnp.int32(7)}


def abstract(tree: dict[str, jax.Array]) -> dict[str, jax.ShapeDtypeStruct]:
    place = SingleDeviceSharding(jax.devices()[0])
    return {
        name: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=place)
        for name, leaf in tree.items()
    }


def save(folder: Path, data: grain.DatasetIterator) -> None:
    checkpoints = Checkpoints(folder)
    checkpoints.save(7, state(), data)
    checkpoints.close()


def test_state_and_data_position_are_restored_together(tmp_path):
    data = numbers()
    seen = [next(data) for _ in range(5)]
    save(tmp_path, data)
    rest = [next(data) for _ in range(100)]

    again, checkpoints = numbers(), Checkpoints(tmp_path)
    loaded = checkpoints.restore(abstract(state()), again)
    np.testing.assert_array_equal(loaded["weights"], state()["weights"])
    assert checkpoints.steps == [7]
    assert [next(again) for _ in range(100)] == rest
    assert set(seen) != set(rest[:5])


def test_a_checkpoint_of_another_model_is_refused_path_by_path(tmp_path):
    save(tmp_path, numbers())
    with pytest.raises(InputError, match=r"weights: checkpoint has \(3,\), config expects \(4,\)"):
        Checkpoints(tmp_path).restore(abstract(state(4)), numbers())


def test_an_empty_folder_has_no_checkpoint(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    assert checkpoints.steps == []
    with pytest.raises(InputError, match="no valid checkpoint"):
        checkpoints.restore(abstract(state()), numbers())


def test_an_incomplete_checkpoint_of_a_killed_run_is_ignored(tmp_path):
    save(tmp_path, numbers())
    (tmp_path / "9.orbax-checkpoint-tmp").mkdir()
    assert Checkpoints(tmp_path).steps == [7]


def test_the_newest_stay_and_those_of_every_so_many_steps(tmp_path):
    data, checkpoints = numbers(), Checkpoints(tmp_path, keep=2, keep_every=4)
    for step in range(1, 8):
        checkpoints.save(step, state(), data)
    checkpoints.close()
    assert Checkpoints(tmp_path).steps == [4, 6, 7]


def saved_twice(folder: Path) -> list[Path]:
    """Two checkpoints, and the second's value files, largest first."""
    data, checkpoints = numbers(), Checkpoints(folder)
    for step in (7, 8):
        checkpoints.save(step, state(1000), data)
    checkpoints.close()
    files = [f for f in (folder / "8").rglob("*") if f.is_file() and f.name != HASHES]
    return sorted(files, key=lambda file: file.stat().st_size, reverse=True)


def flip(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)


def truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-1])


@pytest.mark.parametrize("damage", [flip, truncate, Path.unlink], ids=lambda f: f.__name__)
def test_a_damaged_file_is_named_and_the_checkpoint_before_used_only_on_request(
    tmp_path, damage, capsys
):
    folder = tmp_path / "checkpoints"
    file = saved_twice(folder)[0]
    damage(file)
    with pytest.raises(InputError, match=rf"step 8(?s:.*){file.name}(?s:.*)--training.fallback"):
        Checkpoints(folder).restore(abstract(state(1000)), numbers())
    checkpoints = Checkpoints(folder)
    loaded = checkpoints.restore(abstract(state(1000)), numbers(), fallback=True)
    np.testing.assert_array_equal(loaded["weights"], state(1000)["weights"])
    assert checkpoints.steps == [7]
    assert str(file) in capsys.readouterr().err
    checkpoints.save(8, state(1000), numbers())  # the run reaches that step again
    checkpoints.close()
    assert Checkpoints(folder).steps == [7, 8]


def test_a_changed_byte_in_any_file_is_found(tmp_path):
    for file in saved_twice(tmp_path):
        before = file.read_bytes()
        if not before:
            continue
        flip(file)
        with pytest.raises(InputError, match=file.name):
            Checkpoints(tmp_path).restore(abstract(state(1000)), numbers())
        file.write_bytes(before)
    Checkpoints(tmp_path).restore(abstract(state(1000)), numbers())


def test_a_checkpoint_that_orbax_cannot_list_is_named(tmp_path):
    saved_twice(tmp_path)
    about = tmp_path / "8" / "_CHECKPOINT_METADATA"
    about.write_text(
        about.read_text().replace('"performance_metrics": {}', '"performance_metrics": 7')
    )
    with pytest.raises(InputError, match=r"cannot be listed: .*8/_CHECKPOINT_METADATA differs"):
        Checkpoints(tmp_path)
    truncate(tmp_path / "8" / HASHES)
    truncate(tmp_path / "8" / HASHES)
    with pytest.raises(InputError, match=rf"{HASHES} is not valid JSON"):
        Checkpoints(tmp_path)


# Orbax closes its event loop after the first array that it cannot open. TensorStore's threads may
# report further arrays to the closed loop.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_without_hashes_what_orbax_cannot_read_is_named(tmp_path):
    saved_twice(tmp_path)
    (tmp_path / "8" / HASHES).unlink()
    for file in (tmp_path / "8" / "state").rglob("*"):
        if file.is_file() and not file.name.startswith("_"):
            file.write_bytes(b"")
    with pytest.raises(InputError, match=r"step 8 in .* cannot be read, although its files"):
        Checkpoints(tmp_path).restore(abstract(state(1000)), numbers())


def test_a_disk_without_room_is_refused_before_anything_is_saved(tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=12_000))
    checkpoints = Checkpoints(tmp_path, keep=2)
    with pytest.raises(InputError, match=r"--training.keep"):
        checkpoints.check_room(abstract(state(1024)), [10, 20, 30, 40])
    checkpoints.check_room(abstract(state(900)), [10, 20, 30, 40])
    checkpoints.check_room(abstract(state(1024)), [10, 20])
    checkpoints.close()


def test_the_disk_must_have_room_for_what_is_kept_every_so_often(tmp_path, monkeypatch):
    """Keep 20, 40 and 60 of the steps 10 to 80, the newest two and, while saving, one more."""
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=6 * 4004 - 1))
    checkpoints = Checkpoints(tmp_path, keep=2, keep_every=20)
    steps = range(10, 90, 10)
    with pytest.raises(InputError, match=r"--training.keep-every"):
        checkpoints.check_room(abstract(state(1000)), steps)
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=6 * 4004))
    checkpoints.check_room(abstract(state(1000)), steps)
    checkpoints.close()


def test_a_disk_that_fills_up_while_saving_names_the_newest_checkpoint(tmp_path, monkeypatch):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(7, state(), numbers())
    checkpoints.wait()

    def full(path: Path, value: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr("egosim_jax.io.checkpoint.write_json", full)
    checkpoints.save(8, state(), numbers())
    with pytest.raises(InputError, match=r"step 8 was not saved, the newest is of step 7"):
        checkpoints.close()
