"""The denoiser's loss weights, and its trained weights."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from egosim_jax.conditioning.layout import ChannelLayout
from egosim_jax.configs.model import Networks
from egosim_jax.models.chunks import Chunks
from egosim_jax.train.tasks.denoising import Denoising, draw_latents, loss_weights, without_hands
from egosim_jax.types import InputError
from tests.training.run_tiny import MODEL


def test_locations_that_change_weigh_more_with_mean_one():
    target, prior = np.zeros((2, 2, 4, 4, 16), np.float32), np.zeros((2, 2, 4, 4, 16), np.float32)
    target[0, 1, 0, :2] = 3.0  # two of 32 weights, by more than a deviation
    target[0, 0, 0, 0] = 0.5  # one, by a quarter of its square
    weights = np.asarray(loss_weights(jnp.asarray(target), jnp.asarray(prior), 4.0))[..., 0]
    mean = (29 * 1 + 2 * 5 + 1 * 2) / 32
    assert weights[0, 1, 0, 0] == pytest.approx(5 / mean)
    assert weights[0, 0, 0, 0] == pytest.approx(2 / mean)
    assert weights[0, 0, 3, 3] == pytest.approx(1 / mean)
    np.testing.assert_allclose(weights.mean(axis=(1, 2, 3)), 1, rtol=1e-6)
    np.testing.assert_array_equal(weights[1], 1)


def test_without_change_loss_weight_all_locations_weigh_one():
    rng = np.random.default_rng(0)
    target, prior = rng.normal(size=(2, 1, 2, 3, 4, 16)).astype(np.float32)
    np.testing.assert_array_equal(loss_weights(jnp.asarray(target), jnp.asarray(prior), 0.0), 1)


def test_a_layout_without_a_prior_trains_unless_changes_shall_weigh_more():
    dit = dataclasses.replace(MODEL.dit, in_channels=16)
    layout = ChannelLayout(parts=(("noisy", 16),))
    model = dataclasses.replace(MODEL, dit=dit, layout=layout)
    task = Denoising(model=model)
    networks = task.networks(nnx.Rngs(0))
    batch = {name: jnp.zeros(s.shape, s.dtype) for name, s in task.shapes(2).items()}
    batch.pop("prior", None)
    loss, _ = nnx.jit(task.loss)(networks, batch, task.keys(jax.random.key(0), 2))
    assert np.isfinite(loss)
    with pytest.raises(InputError, match="has no prior"):
        Denoising(model=model, change_loss_weight=1.0)


def test_navigation_takes_the_hands_away_and_the_prior_for_target():
    rng = np.random.default_rng(0)
    batch = {n: jnp.asarray(rng.normal(size=(64, 1, 1, 1, 16))) for n in ("target", "prior")}
    batch["hands"] = jnp.ones((64, 1, 1, 1, 16))
    keys = jax.random.split(jax.random.key(0), 64)
    changed = without_hands(batch, keys, 0.5)
    gone = np.asarray(changed["hands"]).max(axis=(1, 2, 3, 4)) == 0
    assert 15 < gone.sum() < 49
    np.testing.assert_array_equal(changed["target"][gone], batch["prior"][gone])
    np.testing.assert_array_equal(changed["target"][~gone], batch["target"][~gone])
    one = without_hands({n: a[:1] for n, a in batch.items()}, keys[:1], 0.5)
    np.testing.assert_array_equal(one["hands"], changed["hands"][:1])
    with pytest.raises(InputError, match=r"must be in \[0, 1\], not 2"):
        Denoising(model=MODEL, navigation=2.0)


def test_drawn_latents_differ_by_stream_and_by_sample():
    names = ("target", "prior", "hands")
    batch = {name: jnp.zeros((2, 1, 1, 1, 16)) for name in names}
    batch |= {f"{name}_std": jnp.ones((2, 1, 1, 1, 16)) for name in names}
    found = draw_latents(batch, jax.random.split(jax.random.key(0), 2))
    rows = np.stack([found[name] for name in names]).reshape(6, 16)
    assert len({tuple(row) for row in rows}) == 6


class Seen:
    """Denoiser that keeps its inputs and predicts 0."""

    def prepare(self, condition, text, image=None):
        self.condition, self.image = condition, image

    def denoise(self, noisy, t, context):
        return jnp.zeros_like(noisy)

    def denoise_packed(self, clean, noisy, t, context, chunks):
        self.clean, self.noisy, self.t = clean, noisy, t
        return jnp.zeros_like(noisy)

    def part(self, name):
        where = MODEL.layout.slice(name)
        return self.condition[..., where.start - 16 : where.stop - 16]


@pytest.fixture
def batch():
    """Latents of two samples, each in its own range, without deviations."""
    rng = np.random.default_rng(0)
    draw = lambda *shape: jnp.asarray(rng.normal(size=(2, *shape)), jnp.float32)  # noqa: E731
    streams = {name: draw(*MODEL.latent_shape, 16) for name in ("target", "prior", "hands")}
    mask = jnp.zeros((2, *MODEL.latent_shape, 4), jnp.uint8)
    return {**streams, "mask": mask, "text": draw(3, 64), "image": draw(3, 32)}


def seen(batch, model=MODEL, **settings):
    """Return the loss of a batch with fixed keys, and the denoiser."""
    task, dit = Denoising(model=model, **settings), Seen()
    loss, _ = task.loss(Networks(dit=dit), batch, task.keys(jax.random.key(0), 2))
    return float(loss), dit


def test_the_loss_is_that_of_latents_drawn_from_their_posteriors(batch):
    model = dataclasses.replace(MODEL, posterior="sampled")
    names = ("target", "prior", "hands")
    of = lambda std: {f"{n}_std": jnp.full_like(batch[n], std) for n in names}  # noqa: E731
    means, _ = seen(batch)
    assert seen(batch | of(2.0))[0] == means  # a model of means does not draw
    assert seen(batch | of(0.0), model)[0] == pytest.approx(means)
    loss, dit = seen(batch | of(2.0), model)
    assert loss == pytest.approx(1 + 1 + 4, rel=0.15)  # of noise, means and draws
    for name in ("prior", "hands"):
        assert (dit.part(name) - batch[name]).std() == pytest.approx(2, rel=0.15)


def test_a_student_sees_clean_chunks_and_each_noisy_chunk_has_a_level(batch):
    model = dataclasses.replace(MODEL, chunks=Chunks(sizes=(1, 1)))
    loss, dit = seen(batch, model)
    np.testing.assert_array_equal(dit.clean, batch["target"])
    level = dit.t[:, :, None, None, None] / 1000
    assert len(set(level.ravel().tolist())) == 4  # two samples of two chunks
    noise = (dit.noisy - (1 - level) * dit.clean) / level
    assert loss == pytest.approx(float(jnp.square(noise - dit.clean).mean()), rel=1e-4)
    task = Denoising(model=model)
    errors = task.validate(Networks(dit=dit), batch | {"record": jnp.arange(2)})
    assert {error.shape for error in errors.values()} == {(2,)}
    whole = Denoising(model=MODEL)
    assert whole.flops(2) < task.flops(2) < 2 * whole.flops(2)


def test_the_loss_of_navigation_is_that_of_the_camera_alone(batch):
    loss, dit = seen(batch, navigation=1.0)
    np.testing.assert_array_equal(dit.part("hands"), 0)
    np.testing.assert_array_equal(dit.part("prior"), batch["prior"])
    plain, dit = seen(batch)
    np.testing.assert_array_equal(dit.part("hands"), batch["hands"])
    still, _ = seen(batch | {"target": batch["prior"]})
    assert loss == pytest.approx(still)
    assert abs(loss - plain) > 1e-3


def test_a_model_of_zero_image_tokens_is_trained_and_validated_with_zeros(batch):
    model = dataclasses.replace(MODEL, image=None, zero_image_tokens=3)
    given = batch.pop("image")
    loss, dit = seen(batch, model)
    np.testing.assert_array_equal(dit.image, np.zeros((2, 3, 32), np.float32))
    assert loss == seen(batch | {"image": jnp.zeros_like(given)}, model)[0]
    Denoising(model=model).validate(Networks(dit=dit), batch | {"record": jnp.arange(2)})
    np.testing.assert_array_equal(dit.image, np.zeros((2, 3, 32), np.float32))
    np.testing.assert_array_equal(seen(batch | {"image": given}, model)[1].image, given)


def test_a_validation_error_is_of_the_sample_and_its_record_alone(batch):
    dit = Seen()
    batch = batch | {"record": jnp.array([3, 8])}
    both = Denoising(model=MODEL).validate(Networks(dit=dit), batch)
    turned = {name: array[::-1] for name, array in batch.items()}
    other = Denoising(model=MODEL).validate(Networks(dit=dit), turned)
    assert set(both) == {"loss", "loss_0.2", "loss_0.5", "loss_0.8", "loss_0.97"}
    for name in both:
        np.testing.assert_allclose(other[name][::-1], both[name], rtol=1e-6)
    assert both["loss"][0] != both["loss"][1]


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
