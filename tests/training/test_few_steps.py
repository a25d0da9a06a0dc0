"""Training for a sampler's own steps: its inputs, its loss, its gradients."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from egosim_jax import configs
from egosim_jax.configs.model import Networks
from egosim_jax.diffusion.process import RectifiedFlow
from egosim_jax.generation.denoising import denoise
from egosim_jax.train.online.pool import latent_shapes
from egosim_jax.train.tasks.denoising import Denoising, condition_of
from egosim_jax.train.tasks.few_steps import FewSteps
from egosim_jax.types import InputError

BATCH = 8
MODEL = replace(configs.get("debug"), steps=3, process=RectifiedFlow(shift=3.0))


@pytest.fixture(scope="module")
def networks():
    networks = Networks.build(MODEL, only=("dit", "text", "image"), rngs=nnx.Rngs(0))
    kernel = networks.dit.head.linear.kernel  # 0 at first, as if the network predicted nothing
    kernel.set_value(jax.random.normal(jax.random.key(3), kernel.shape) / kernel.shape[0])
    return networks


@pytest.fixture(scope="module")
def batch():
    draw = np.random.default_rng(0)
    return {
        name: jnp.asarray(draw.normal(size=s.shape), jnp.float32)
        if np.issubdtype(s.dtype, np.floating)
        else jnp.asarray(draw.integers(0, 2, s.shape), s.dtype)
        for name, s in latent_shapes(MODEL, BATCH).items()
    }


def test_the_last_step_predicts_from_where_the_sampler_is(networks, batch):
    # The prediction of the last step is the clip that `generation.denoise` makes of this noise.
    task = FewSteps(model=MODEL, others=0.0)
    keys = task.keys(jax.random.key(1), BATCH)
    _, metrics = jax.jit(task.loss)(networks, batch, keys)
    own = jax.vmap(jax.random.split)(keys[:, 1])
    noise = jax.vmap(lambda key: jax.random.normal(key, batch["target"].shape[1:]))(own[:, 1])
    clips = denoise(networks.dit, condition_of(networks, batch, MODEL), noise, MODEL)
    last = task.bounds(BATCH, 3)[2]
    sigma = MODEL.process.times(3)[2]
    expected = np.square(clips - batch["target"])[last:].mean() / sigma**2
    np.testing.assert_allclose(metrics["loss_step_3"], expected, rtol=1e-4)


def test_a_step_has_no_gradient_through_the_steps_before_it(networks, batch):
    task = FewSteps(model=MODEL, others=0.0)
    keys = task.keys(jax.random.key(1), BATCH)
    noise = jnp.asarray(np.random.default_rng(1).normal(size=batch["target"].shape), jnp.float32)

    graph, weights = nnx.split(networks)

    def total(weights):
        merged = nnx.merge(graph, weights)
        condition = condition_of(merged, batch, MODEL)
        return sum(x.sum() for x in task.sampled(merged, condition, noise, [0, 2, 5, 8]))

    def loss(weights):
        return task.loss(nnx.merge(graph, weights), batch, keys)[0]

    none, learned = (jax.jit(jax.grad(function))(weights) for function in (total, loss))
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(none))
    assert any(np.any(leaf) for leaf in jax.tree.leaves(learned))


def test_samples_at_random_times_have_the_ordinary_loss(networks, batch):
    settings = {"model": MODEL, "change_loss_weight": 4.0}
    ordinary, task = Denoising(**settings), FewSteps(**settings, others=0.5)
    keys = task.keys(jax.random.key(2), BATCH)
    first, *_ = task.bounds(BATCH, 3)
    rows = {name: array[:first] for name, array in batch.items()}
    expected, _ = jax.jit(ordinary.loss)(networks, rows, keys[:first])
    found, metrics = jax.jit(task.loss)(networks, batch, keys)
    steps = sum(float(metrics[f"loss_step_{n}"]) * c for n, c in ((1, 1), (2, 2), (3, 1)))
    assert np.diff(task.bounds(BATCH, 3)).tolist() == [1, 2, 1]
    np.testing.assert_allclose(float(found) * BATCH - steps, float(expected) * first, rtol=1e-4)


def test_a_batch_is_divided_among_the_steps():
    assert FewSteps(model=MODEL).bounds(128, 2) == [16, 72, 128]
    assert FewSteps(model=MODEL, others=0.0).bounds(3, 3) == [0, 1, 2, 3]
    assert FewSteps(model=MODEL, others=0.5).bounds(3, 3) == [0, 1, 2, 3]
    with pytest.raises(InputError, match="batch-size"):
        FewSteps(model=MODEL).bounds(2, 3)


def test_models_that_do_not_predict_velocities_of_complete_clips_are_refused():
    noise = replace(MODEL, process=RectifiedFlow(prediction="epsilon", sigma_max=0.999))
    for model in (noise, configs.get("tabletop_student")):
        with pytest.raises(InputError, match="predicts velocities"):
            FewSteps(model=model)
    with pytest.raises(InputError, match="below 1"):
        FewSteps(model=MODEL, others=1.0)
