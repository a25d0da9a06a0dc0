"""From noise to latents: the denoiser, its conditions and guidance, run by the sampler."""

from __future__ import annotations

from typing import cast

import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from egosim_jax.conditioning.condition import Condition
from egosim_jax.configs.model import ModelConfig
from egosim_jax.diffusion.process import DenoiseFn
from egosim_jax.diffusion.progressive import integrate_progressively, means
from egosim_jax.diffusion.solver import integrate
from egosim_jax.generation.causal import denoise_chunks
from egosim_jax.models import CausalDenoiser, Denoiser, HalfGridDenoiser


def denoise(
    dit: Denoiser,
    condition: Condition,
    noise: Float[Array, "b f h w z"],
    config: ModelConfig,
    keys: Key[Array, " b"] | None = None,
) -> Float[Array, "b f h w z"]:
    """Run the sampler; the unconditional branch uses the negative-prompt embeddings.

    `keys`, one for each item, draw the noise that a stochastic solver adds.
    """
    if config.chunks is not None:
        return denoise_chunks(cast(CausalDenoiser, dit), condition, noise, config, keys)
    start = noise
    if config.strength is not None and condition.prior is not None:
        # SDEdit: the prior, noised to the first level, is the start instead of a condition.
        time = jnp.asarray(config.process.times(config.visited)[0], jnp.float32)
        start = config.process.add_noise(condition.prior, noise, time)
        condition = condition.drop("prior")
    predict = _guided(dit, condition, start, config)
    if config.progressive is not None:
        return integrate_progressively(
            _guided(dit, config.layout.halve(condition), means(noise), config, half=True),
            predict,
            start,
            noise,
            progressive=config.progressive,
            process=config.process,
            solver=config.solver,
            steps=config.visited,
            cache=config.cache,
        )
    return integrate(
        predict,
        start,
        process=config.process,
        solver=config.solver,
        steps=config.visited,
        keys=keys,
        cache=config.cache,
    )


def _guided(
    dit: Denoiser,
    condition: Condition,
    noise: Float[Array, "b f h w z"],
    config: ModelConfig,
    *,
    half: bool = False,
) -> DenoiseFn:
    """Return the guided prediction under a condition, on the grid of `noise`."""
    channels = config.layout.condition_channels(condition, noise)
    prepare = cast(HalfGridDenoiser, dit).prepare_half if half else dit.prepare

    def branch(text: Array) -> DenoiseFn:
        context = prepare(channels, text, condition.image)
        return lambda x, t: dit.denoise(x, t, context)

    text = jnp.asarray(condition.text)
    conditional = branch(text)
    # At scale 1 guidance returns the conditional branch: do not compute the other one.
    guided = config.guidance.scale != 1
    unconditional = branch(condition.drop("text").text) if guided else conditional
    return config.guidance.guide(conditional, unconditional)
