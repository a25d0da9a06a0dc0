"""Updates of online training: the denoiser's, several in one program, and the decoder's.

The learning rate is an argument, because the schedule of a run of given minutes follows the clock.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, Key

from egosim_jax.conditioning.pixels import to_model
from egosim_jax.configs.model import ModelConfig, Networks
from egosim_jax.generation.generator import denoise
from egosim_jax.train.config import OptimizerConfig, TrainConfig
from egosim_jax.train.online.pool import Rows, as_floats
from egosim_jax.train.task import Metrics
from egosim_jax.train.tasks.autoencoding import psnr
from egosim_jax.train.tasks.denoising import Denoising, condition_of
from egosim_jax.train.tasks.refining import Refining, lpips
from egosim_jax.train.update import TrainState, advance


def muon(*, weight_decay: float = 0.0, ema_decay: float, batch: int) -> TrainConfig:
    """Return the training of a network by Muon; the learning rate is an argument of its update."""
    optimizer = OptimizerConfig(name="muon", weight_decay=weight_decay, ema_decay=ema_decay)
    return TrainConfig(steps=1, batch_size=batch, optimizer=optimizer)


def create(params: nnx.State, training: TrainConfig) -> TrainState:
    """Return the state of a network's training before the first update, in float32."""
    params = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), params)
    return TrainState.create(params, training.optimizer)


def make_denoiser_updates(
    task: Denoising, training: TrainConfig, graph: nnx.GraphDef, *, count: int, seed: int
) -> Any:
    """Return the jitted function of `count` updates on random rows of a pool.

    It takes state, the pool's arrays, its number of rows and `count` learning rates. It returns the
    state, the number of skipped updates and the mean metrics.
    """
    batch = training.batch_size

    def loss(params: nnx.State, rows: Rows, keys: jax.Array) -> tuple[jax.Array, Metrics]:
        return task.loss(nnx.merge(graph, params), rows, keys)

    def updates(
        state: TrainState, pool: Rows, rows: jax.Array, rates: Float[Array, " n"]
    ) -> tuple[TrainState, jax.Array, Metrics]:
        def step(state: TrainState, rate: jax.Array) -> tuple[TrainState, Metrics]:
            draw, noise = jax.random.split(_key(seed, state.step))
            chosen = jax.random.randint(draw, (batch,), 0, rows)
            examples = as_floats({name: array[chosen] for name, array in pool.items()})
            return advance(state, loss, examples, task.keys(noise, batch), training, rate)

        state, metrics = jax.lax.scan(step, state, rates, length=count)
        skipped = (metrics["consecutive_skips"] > 0).sum()
        return state, skipped, jax.tree.map(jnp.mean, _logged(metrics))

    return jax.jit(updates, donate_argnums=0)


def make_decoder_update(
    task: Refining, training: TrainConfig, graph: nnx.GraphDef, *, seed: int
) -> Any:
    """Return the jitted decoder update on random rows of a frame pool.

    It takes state, frozen weights, the pool's arrays, its number of rows, the fraction of latents
    that are generated ones, and the learning rate.
    """
    batch = training.batch_size

    def update(
        state: TrainState,
        frozen: nnx.State,
        pool: Rows,
        rows: jax.Array,
        generated: jax.Array,
        rate: jax.Array,
    ) -> tuple[TrainState, Metrics]:
        def loss(params: nnx.State, batch: Any, key: jax.Array) -> tuple[jax.Array, Metrics]:
            latents, video = batch
            return task.decoding_loss(nnx.merge(graph, params, frozen).vae, latents, video, key)

        draw, coin, frames = jax.random.split(_key(seed, state.step), 3)
        chosen = jax.random.randint(draw, (batch,), 0, rows)
        # Strided, so that each batch has the same number of generated latents.
        own = (jnp.arange(batch) + jax.random.uniform(coin)) / batch >= generated
        latents = jnp.where(
            own[:, None, None, None, None], pool["latents"][chosen], pool["generated"][chosen]
        )
        examples = latents.astype(jnp.float32), to_model(pool["frames"][chosen])
        state, metrics = advance(state, loss, examples, frames, training, rate)
        return state, _logged(metrics)

    return jax.jit(update, donate_argnums=0)


def _logged(metrics: Metrics) -> Metrics:
    """Return the metrics of an update that a run logs: the loss, and the task's."""
    return {n: v for n, v in metrics.items() if n not in ("grad_norm", "lr", "consecutive_skips")}


def make_generate(model: ModelConfig, graph: nnx.GraphDef, *, batch: int) -> Any:
    """Return the jitted function that generates the latents of part of a frame pool again.

    It takes the denoiser's weights, the arrays of the pool of latents, the frame pool's `row` and
    `generated`, the first of `batch` rows, and a seed; it returns `generated`.
    """

    def generate(
        params: nnx.State,
        pool: Rows,
        row: jax.Array,
        generated: jax.Array,
        start: jax.Array,
        seed: jax.Array,
    ) -> jax.Array:
        source = jax.lax.dynamic_slice_in_dim(row, start, batch)
        rows = as_floats({name: array[source] for name, array in pool.items()})
        latents = sample(params, rows, model, graph, jax.random.key(seed))
        latents = latents.astype(generated.dtype)
        return jax.lax.dynamic_update_slice_in_dim(generated, latents, start, 0)

    return jax.jit(generate, donate_argnums=3)


def sample(
    params: nnx.State, rows: Rows, model: ModelConfig, graph: nnx.GraphDef, key: Key[Array, ""]
) -> Float[Array, "b f h w z"]:
    """Return latents that the denoiser generates under the conditions of rows."""
    networks: Networks = nnx.merge(graph, params)
    noise = jax.random.normal(key, rows["target"].shape)
    return denoise(networks.dit, condition_of(networks, rows, model), noise, model)


def make_judge(task: Denoising, graph: nnx.GraphDef, vae_graph: nnx.GraphDef, batch: int) -> Any:
    """Return the jitted validation: losses, and PSNR and LPIPS of decoded and generated clips.

    It takes the weights of denoiser and decoder, the frozen ones, encoded rows and their frames.
    """

    def judge(
        params: nnx.State, decoder: nnx.State, frozen: nnx.State, rows: Rows, frames: jax.Array
    ) -> Metrics:
        vae: Any = nnx.merge(vae_graph, decoder, frozen).vae
        examples = {**as_floats(rows), "record": jnp.arange(batch, dtype=jnp.int32)}
        found = task.validate(nnx.merge(graph, params), examples)
        generated = sample(params, examples, task.model, graph, jax.random.key(0))
        video = to_model(frames)
        for name, latents in {"decoded": examples["target"], "generated": generated}.items():
            clip = vae.decode_whole(vae.denormalize(latents)).clip(-1, 1)
            found[f"{name}_psnr"] = psnr(clip, video)
            found[f"{name}_lpips"] = lpips(clip[:, ::4], video[:, ::4])
        return {name: values.mean() for name, values in found.items()}

    return jax.jit(judge)


def _key(seed: int, step: jax.Array) -> Key[Array, ""]:
    return jax.random.fold_in(jax.random.key(seed), step)
