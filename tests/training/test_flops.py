"""FLOPs: the known count of the 14B, the compiler's count, and MFU."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from egosim_jax import configs
from egosim_jax.models.wan.dit import WanDiT, WanDiTConfig
from egosim_jax.train.monitor import Clock
from egosim_jax.train.tasks.denoising import Denoising


def test_a_forward_of_the_14b_takes_1126_tflop():
    """Counted by hand from the published architecture, for 61 frames of 832 x 480."""
    model = configs.get("egosim_14b")
    flops = model.dit.forward_flops(latents=model.latent_shape, text=512, image=257)
    assert flops.total == pytest.approx(1126.17e12, rel=1e-5)
    assert flops.attention == pytest.approx((510.363 + 10.469 + 5.255) * 1e12, rel=1e-4)


@pytest.mark.parametrize("image", [0, 5])
def test_the_count_is_the_compilers_of_a_small_network(image):
    """The compiler counts norms and activations, too: a few percent at this width."""
    config = WanDiTConfig(
        dim=256, ffn_dim=512, heads=2, layers=1, text_dim=64, image_dim=64 if image else None
    )
    latents, text = (2, 16, 16), 16
    networks = nnx.eval_shape(lambda: WanDiT(config, rngs=nnx.Rngs(0)))
    graph, params = nnx.split(networks)
    shapes = [(1, *latents, 52), (1,), (1, text, 64), *([(1, image, 64)] if image else [])]
    given = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    program = jax.jit(lambda params, *args: nnx.merge(graph, params)(*args))
    counted = program.lower(params, *given).cost_analysis()["flops"]
    ours = config.forward_flops(latents=latents, text=text, image=image).total
    assert ours == pytest.approx(counted, rel=0.06)


def test_an_update_takes_three_forwards_and_a_loras_spares_the_gradients_of_weights():
    model = configs.get("debug")
    whole, low = Denoising(model=model).flops(3), Denoising(model=model, rank=2).flops(3)
    tokens = {"text": model.tokenizer.max_tokens, "image": 5}
    forward = model.dit.forward_flops(latents=model.latent_shape, **tokens)
    assert whole == pytest.approx(9 * forward.total)
    assert whole - low == pytest.approx(3 * forward.weights)


def test_rates_are_of_steps_with_their_waits(monkeypatch):
    now = iter(np.arange(0.0, 100.0))
    monkeypatch.setattr("time.monotonic", lambda: next(now))
    monkeypatch.setattr(
        "jax.devices", lambda: [dataclasses.make_dataclass("D", ["device_kind"])("NVIDIA H100")]
    )
    clock = Clock(flops=989.4e12)
    clock.begin(10)
    for phase in ("data", "step", "data", "step", "validate"):
        with clock.phase(phase):
            pass
    numbers = clock.tick(12, 132)
    assert numbers["step_time_s"] == 2.0
    assert numbers["data_wait_frac"] == 0.5
    assert numbers["mfu"] == pytest.approx(0.5)
    assert numbers["eta_min"] == 4.0
