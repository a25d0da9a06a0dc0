"""The moving average of a run's weights has most of what the run learned, however long it is."""

import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from egosim_jax.train.config import OptimizerConfig
from egosim_jax.train.loop import train
from tests.training.line import Line, training, write_points


def values(networks) -> np.ndarray:
    return np.concatenate([np.ravel(networks.kernel[...]), np.ravel(networks.bias[...])])


@pytest.mark.parametrize(("decay", "steps"), [(0.9999, 50), (0.98, 12)])
def test_a_decay_too_slow_for_the_run_keeps_most_of_what_was_learned(decay, steps, tmp_path):
    points = write_points(tmp_path / "points")
    start = values(Line().networks(nnx.Rngs(0)))

    def learned(name, **optimizer):
        config = training(steps=steps, save_every=steps, optimizer=optimizer)
        trained = train(Line(), config, data=points, validation=None, out=tmp_path / name)
        return values(trained) - start

    last, mean = learned("last"), learned("mean", ema_decay=decay)
    kept = float(mean @ last / (last @ last))
    assert kept > 0.7  # with a constant decay: 0.003 to 0.13
    again = learned("mean", ema_decay=decay)  # resumed at the end, from the checkpoint
    np.testing.assert_array_equal(again, mean)


@pytest.mark.parametrize("decay", [0.9, 0.9999])
def test_the_average_is_warmed_up(decay):
    optimizer = OptimizerConfig(ema_decay=decay)
    first, later, last = (float(optimizer.ema_decay_at(jnp.int32(n))) for n in (0, 2, 10**6))
    assert (first, later) == pytest.approx((1 / 10, 3 / 12))
    assert last == pytest.approx(decay)
