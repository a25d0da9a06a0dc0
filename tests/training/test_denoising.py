"""What the denoiser's loss looks at."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from egosim_jax.train.tasks.denoising import Denoising, changed_places
from tests.training.run_tiny import MODEL


def test_places_that_change_count_more_and_all_count_one_on_average():
    truth, prior = np.zeros((2, 2, 4, 4, 16), np.float32), np.zeros((2, 2, 4, 4, 16), np.float32)
    truth[0, 1, 0, :2] = 3.0  # two of 32 places, by more than a deviation
    truth[0, 0, 0, 0] = 0.5  # one, by a quarter of its square
    places = np.asarray(changed_places(jnp.asarray(truth), jnp.asarray(prior), 4.0))[..., 0]
    mean = (29 * 1 + 2 * 5 + 1 * 2) / 32
    assert places[0, 1, 0, 0] == pytest.approx(5 / mean)
    assert places[0, 0, 0, 0] == pytest.approx(2 / mean)
    assert places[0, 0, 3, 3] == pytest.approx(1 / mean)
    np.testing.assert_allclose(places.mean(axis=(1, 2, 3)), 1, rtol=1e-6)
    np.testing.assert_array_equal(places[1], 1)


def test_without_change_all_places_count_the_same():
    rng = np.random.default_rng(0)
    truth, prior = rng.normal(size=(2, 1, 2, 3, 4, 16)).astype(np.float32)
    np.testing.assert_array_equal(changed_places(jnp.asarray(truth), jnp.asarray(prior), 0.0), 1)


def test_a_lora_is_all_that_its_task_trains_and_the_rest_is_in_the_compute_dtype():
    model = dataclasses.replace(MODEL, dit=dataclasses.replace(MODEL.dit, dtype="bfloat16"))
    task = Denoising(model=model, rank=2)
    _, trained, frozen = nnx.split(task.networks(nnx.Rngs(0)), task.trained, ...)
    paths = {path[-1] for path, _ in nnx.to_flat_state(trained)}
    assert paths == {"down", "up"}
    assert {path[-2] for path, _ in nnx.to_flat_state(trained)} == {"low_rank"}
    assert len(nnx.to_flat_state(trained)) == 2 * 12  # of a block: 4 + 6 of attention, 2 of the MLP
    assert not any("low_rank" in path for path, _ in nnx.to_flat_state(frozen))
    assert task.frozen_dtype == "bfloat16"
