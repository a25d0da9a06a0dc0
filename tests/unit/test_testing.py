"""Random data for tests has the arrays and the provenance of the real data."""

import dataclasses

import pytest

from egosim_jax import testing
from egosim_jax.data.shards import ShardReader
from egosim_jax.train.encode import check_encoders, example_shapes
from egosim_jax.types import InputError


@pytest.mark.parametrize("encoders", ["frozen", "joint"])
def test_latents_have_the_arrays_of_encoded_clips(tmp_path, encoders):
    model = dataclasses.replace(testing.tiny_model(), encoders=encoders)
    reader = ShardReader(testing.write_latents(tmp_path, model, records=2))
    assert reader.manifest.grid == model.grid
    expected = example_shapes(model, 1)
    for record in reader:
        found = {name: (array.shape, array.dtype) for name, array in record.arrays.items()}
        assert found == {name: (a.shape[1:], a.dtype) for name, a in expected.items()}


def test_latents_are_of_the_encoders_in_the_weights_folder(tmp_path):
    model = testing.tiny_model()
    weights = testing.write_weights(tmp_path / "weights", model)
    latents = testing.write_latents(tmp_path / "latents", model, records=1, weights=weights)
    check_encoders(latents, model, weights)
    others = testing.write_weights(tmp_path / "others", model, seed=1)
    with pytest.raises(InputError, match="was not encoded for this training"):
        check_encoders(latents, model, others)
