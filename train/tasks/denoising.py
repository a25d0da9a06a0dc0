"""Training the denoiser on cached latents, with its small encoders if the model has them.

The loss is the flow-matching objective (`diffusion/objective.py`) of the velocity under a condition
from which prior, mask, hands and text are dropped at random (`conditioning/dropout.py`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, Key

from egosim_jax.conditioning import condition_channels
from egosim_jax.conditioning.dropout import ConditionDropout
from egosim_jax.diffusion.objective import Objective
from egosim_jax.diffusion.schedule import VelocityFn
from egosim_jax.models import lora
from egosim_jax.models.layers import LowRankParam
from egosim_jax.networks import ModelConfig, Networks
from egosim_jax.train.encode import example_shapes
from egosim_jax.train.flops import count_forward
from egosim_jax.train.update import Batch, Metrics
from egosim_jax.types import Condition

VALIDATION_TIMES = (0.2, 0.5, 0.8, 0.97)
"""Noise levels at which the validation loss is measured."""


@dataclass(frozen=True, kw_only=True)
class Denoising:
    """The task of training the denoiser."""

    model: ModelConfig
    """The model whose denoiser is trained."""
    objective: Objective = field(default_factory=Objective)
    """How noise levels are drawn and errors weighted."""
    dropout: ConditionDropout = field(default_factory=ConditionDropout)
    """How often each condition is hidden."""
    change: float = 0.0
    """How much more a place counts where the clip is unlike its prior: at hands, at what they move
    and at what was not observed, which is little of a picture and all that has to be learnt."""
    rank: int | None = None
    """Of a LoRA on the linear layers of the blocks, which is then all that is trained."""

    @property
    def trained(self) -> Any:
        """All weights, or those of the LoRA."""
        return nnx.Param if self.rank is None else LowRankParam

    @property
    def frozen_dtype(self) -> str:
        """That in which the transformer computes."""
        return self.model.dit.dtype

    def networks(self, rngs: nnx.Rngs) -> Networks:
        """The networks with random weights."""
        networks = Networks.build(self.model, only=self.model.trained_networks, rngs=rngs)
        if self.rank is not None:
            lora.start(networks.dit, self.rank, rngs=rngs)
        return networks

    def examples(self) -> None:
        """A record of latents is an example as it is."""

    def shapes(self, batch: int) -> Mapping[str, jax.ShapeDtypeStruct]:
        """Those of cached latents."""
        return example_shapes(self.model, batch)

    def keys(self, key: Key[Array, ""], batch: int) -> Key[Array, "b 2"]:
        """For each sample, what drops its conditions and what draws its noise."""
        drop, draw = jax.random.split(key)
        return jnp.stack([jax.random.split(drop, batch), jax.random.split(draw, batch)], axis=1)

    def loss(
        self, networks: Networks, batch: Batch, keys: Key[Array, "b 2"]
    ) -> tuple[jax.Array, Metrics]:
        """The flow-matching loss of a batch under dropped conditions."""
        condition = self.dropout.apply(condition_of(networks, batch), keys[:, 0])
        velocity = _velocity(networks, condition)
        places = changed_places(batch["target"], batch["prior"], self.change)
        loss, _ = self.objective.loss(velocity, batch["target"], keys[:, 1], places=places)
        return loss, {}

    def validate(self, networks: Networks, batch: Batch) -> Metrics:
        """Errors at fixed noise levels and with fixed noise, under the full condition."""
        velocity = _velocity(networks, condition_of(networks, batch))
        truth = batch["target"]
        noise = jax.random.normal(jax.random.key(0), truth.shape)
        errors = {
            f"loss_{time}": self.objective.loss_at(
                velocity, truth, noise, jnp.full(truth.shape[:1], time)
            ).mean()
            for time in VALIDATION_TIMES
        }
        return {"loss": jnp.mean(jnp.stack(list(errors.values()))), **errors}

    def flops(self, samples: int) -> float:
        """Model FLOPs of an update, of the transformer alone, which has nearly all of them."""
        image = self.model.image
        forward = count_forward(
            self.model.dit,
            latents=self.model.video.latent_shape,
            text=self.model.tokenizer.max_tokens,
            image=0 if image is None else 1 + (image.image_size // image.patch) ** 2,
        )
        # Backward: by activations and by weights, of which a LoRA's are few.
        weights = 3 if self.rank is None else 2
        return samples * (weights * forward.weights + 3 * forward.attention)


def condition_of(networks: Networks, batch: Batch) -> Condition:
    """Return the condition of a cached batch, under encoders that are trained or cached."""
    text = (
        batch["text"] if networks.text is None else networks.text(batch["ids"], batch["ids_mask"])
    )
    image = batch.get("image") if networks.image is None else networks.image(batch["pixels"])
    return Condition(
        mask=batch["mask"].astype(jnp.float32),
        prior=batch["prior"],
        hands=batch["hands"],
        text=text,
        image=image,
    )


def changed_places(
    truth: Float[Array, "b f h w c"], prior: Float[Array, "b f h w c"], change: float
) -> Float[Array, "b f h w 1"]:
    """Weight of each place, 1 on average: 1 + change where the latents differ by 1 or more.

    Less where they differ by less; the latents of a channel have a deviation of 1.
    """
    difference = jnp.square(truth - prior).mean(axis=-1, keepdims=True)
    weight = 1 + change * jnp.minimum(difference, 1)
    return weight / weight.mean(axis=(1, 2, 3), keepdims=True)


def _velocity(networks: Networks, condition: Condition) -> VelocityFn:
    dit = networks.dit
    context = dit.prepare(condition_channels(condition), condition.text, condition.image)
    return lambda x, t: dit.denoise(x, t, context)
