"""The learning rate follows the step of the run, also after skipped updates."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from egosim_jax.sharding import make_mesh
from egosim_jax.train.config import OptimizerConfig, TrainConfig, learning_rate
from egosim_jax.train.update import Programs, mean_metrics
from egosim_jax.types import MeshConfig
from tests.training.line import Line

STEPS, PEAK = 10, 0.1


@dataclass(frozen=True)
class Slope(Line):
    """A loss with the gradient 1 everywhere: an Adam update is as large as the learning rate."""

    def loss(self, networks, batch, keys):
        total = networks.kernel[...].sum() + networks.bias[...].sum()
        return total * batch["x"].mean(), {}


def batch(*, bad: bool) -> dict[str, jax.Array]:
    shapes = Slope().shapes(2)
    ones = {name: jnp.ones(shape.shape, shape.dtype) for name, shape in shapes.items()}
    return {**ones, "x": ones["x"] * (jnp.nan if bad else 1)}


@pytest.mark.parametrize(
    ("schedule", "end"), [("cosine", PEAK / 20), ("cosine_restarts", 0.0), ("constant", PEAK)]
)
def test_the_rate_in_the_log_is_the_rate_that_was_used(schedule, end):
    optimizer = OptimizerConfig(learning_rate=PEAK, schedule=schedule, warmup_steps=2)
    config = TrainConfig(steps=STEPS, batch_size=2, optimizer=optimizer)
    mesh = make_mesh(MeshConfig())
    programs = Programs.of(Slope(), config, mesh)
    with jax.set_mesh(mesh):
        state = programs.create()
        for step in range(STEPS):
            before = np.asarray(state.params["bias"][...])
            bad = (step % 2 == 1 and step != STEPS - 1) or step == 0
            state, metrics = programs.update(state, programs.frozen, batch(bad=bad))
            rate = mean_metrics([metrics])["lr"]
            assert rate == pytest.approx(
                float(jnp.asarray(learning_rate(optimizer, STEPS)(step))), abs=1e-8
            )
            used = before - np.asarray(state.params["bias"][...])
            np.testing.assert_allclose(used, 0 if bad else rate, rtol=1e-4, atol=1e-7)
    assert float(jnp.asarray(learning_rate(optimizer, STEPS)(STEPS))) == pytest.approx(end)
    assert int(state.step) == STEPS
