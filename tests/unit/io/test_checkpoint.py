"""Checkpoints: state and data position together, or nothing."""

from pathlib import Path

import grain
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import SingleDeviceSharding

from egosim_jax.io.checkpoint import Checkpoints
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


def test_state_and_data_position_come_back_together(tmp_path):
    data = numbers()
    seen = [next(data) for _ in range(5)]
    save(tmp_path, data)
    rest = [next(data) for _ in range(100)]

    again, checkpoints = numbers(), Checkpoints(tmp_path)
    loaded = checkpoints.restore(abstract(state()), again)
    np.testing.assert_array_equal(loaded["weights"], state()["weights"])
    assert checkpoints.latest == 7
    assert [next(again) for _ in range(100)] == rest
    assert set(seen) != set(rest[:5])


def test_a_checkpoint_of_another_model_is_refused_path_by_path(tmp_path):
    save(tmp_path, numbers())
    with pytest.raises(InputError, match=r"weights: checkpoint has \(3,\), config expects \(4,\)"):
        Checkpoints(tmp_path).restore(abstract(state(4)), numbers())


def test_an_empty_folder_has_no_checkpoint(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    assert checkpoints.latest is None
    with pytest.raises(InputError, match="no checkpoint"):
        checkpoints.restore(abstract(state()), numbers())


def test_what_a_kill_left_half_written_is_not_a_checkpoint(tmp_path):
    save(tmp_path, numbers())
    (tmp_path / "9.orbax-checkpoint-tmp").mkdir()
    assert Checkpoints(tmp_path).latest == 7
