"""Updates of online training: the denoiser's, several in one program, and the decoder's.

The learning rate is an argument, because the schedule of a run of given minutes follows the clock.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from jaxtyping import Array, Float, Key

from egosim_jax.conditioning.pixels import to_model
from egosim_jax.configs.model import ModelConfig, Networks
from egosim_jax.generation.generator import denoise
from egosim_jax.train.config import OptimizerConfig, make_optimizer
from egosim_jax.train.online.pool import Rows, as_floats
from egosim_jax.train.task import Metrics
from egosim_jax.train.tasks.autoencoding import psnr
from egosim_jax.train.tasks.denoising import Denoising, condition_of
from egosim_jax.train.tasks.refining import Refining, lpips


@no_type_check
@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class OnlineState:
    """All arrays that an update changes."""

    step: jax.Array
    """Number of finished updates, int32."""
    params: nnx.State
    """Trained weights in float32."""
    opt_state: Any
    """State of the optax transformation."""
    average: nnx.State
    """Moving average of the weights, which is validated and written."""
    skipped: jax.Array
    """Number of updates that were skipped because loss or gradient were not finite, int32."""


Loss = Callable[[nnx.State, Any, jax.Array], tuple[jax.Array, Metrics]]


@dataclass(frozen=True, kw_only=True)
class Updater:
    """Optimizer of one network's training."""

    weight_decay: float = 0.0
    """Decoupled weight decay of matrices and kernels."""
    ema_decay: float
    """Decay of the moving average of the weights."""

    @property
    def optimizer(self) -> optax.GradientTransformation:
        """Muon at rate 1."""
        return make_optimizer(self.config)

    @property
    def config(self) -> OptimizerConfig:
        """Hyper-parameters; the learning rate is an argument of the update."""
        return OptimizerConfig(
            name="muon", weight_decay=self.weight_decay, ema_decay=self.ema_decay
        )

    def create(self, params: nnx.State) -> OnlineState:
        """Return the state before the first update."""
        params = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), params)
        average: Any = jax.tree.map(jnp.copy, params)
        return OnlineState(
            step=jnp.int32(0),
            params=params,
            opt_state=self.optimizer.init(params),
            average=average,
            skipped=jnp.int32(0),
        )

    def update(
        self, loss: Loss, state: OnlineState, batch: Any, keys: jax.Array, rate: jax.Array
    ) -> tuple[OnlineState, Metrics]:
        """Return the state after an update, and the metrics; a loss of NaN changes no weight."""
        gradient = jax.value_and_grad(loss, has_aux=True)
        (value, metrics), gradients = gradient(state.params, batch, keys)
        valid = jnp.isfinite(value) & jnp.isfinite(optax.tree.norm(gradients))
        updates, opt_state = self.optimizer.update(gradients, state.opt_state, state.params)
        params: Any = optax.apply_updates(state.params, jax.tree.map(lambda x: rate * x, updates))
        decay = self.config.ema_decay_at(state.step)
        average: Any = optax.incremental_update(params, state.average, 1 - decay)
        changed = OnlineState(
            step=state.step + 1,
            params=params,
            opt_state=opt_state,
            average=average,
            skipped=state.skipped,
        )
        kept = replace(state, step=state.step + 1, skipped=state.skipped + 1)
        state = jax.tree.map(lambda new, old: jnp.where(valid, new, old), changed, kept)
        return state, {**metrics, "loss": value}


def make_denoiser_updates(
    task: Denoising, updater: Updater, graph: nnx.GraphDef, *, batch: int, count: int, seed: int
) -> Any:
    """Return the jitted function of `count` updates on random rows of a pool.

    It takes state, the pool's arrays, its number of rows and `count` learning rates.
    """

    def loss(params: nnx.State, rows: Rows, keys: jax.Array) -> tuple[jax.Array, Metrics]:
        return task.loss(nnx.merge(graph, params), rows, keys)

    def updates(
        state: OnlineState, pool: Rows, rows: jax.Array, rates: Float[Array, " n"]
    ) -> tuple[OnlineState, Metrics]:
        def step(state: OnlineState, rate: jax.Array) -> tuple[OnlineState, Metrics]:
            draw, noise = jax.random.split(_key(seed, state.step))
            chosen = jax.random.randint(draw, (batch,), 0, rows)
            examples = as_floats({name: array[chosen] for name, array in pool.items()})
            return updater.update(loss, state, examples, task.keys(noise, batch), rate)

        state, metrics = jax.lax.scan(step, state, rates, length=count)
        return state, jax.tree.map(jnp.mean, metrics)

    return jax.jit(updates, donate_argnums=0)


def make_decoder_update(
    task: Refining, updater: Updater, graph: nnx.GraphDef, *, batch: int, seed: int
) -> Any:
    """Return the jitted decoder update on random rows of a frame pool.

    It takes state, frozen weights, the pool's arrays, its number of rows, the fraction of latents
    that are generated ones, and the learning rate.
    """

    def update(
        state: OnlineState,
        frozen: nnx.State,
        pool: Rows,
        rows: jax.Array,
        generated: jax.Array,
        rate: jax.Array,
    ) -> tuple[OnlineState, Metrics]:
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
        return updater.update(loss, state, examples, frames, rate)

    return jax.jit(update, donate_argnums=0)


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
