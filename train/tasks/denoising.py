"""Training of the denoiser on cached latents, and of its small encoders if the model trains them.

The loss is the diffusion objective (`diffusion/objective.py`). Condition dropout removes prior,
mask, hands and text at random (`conditioning/condition.py`). DWM draws the latents from their
posteriors at each update (`conditioning/posterior.py`). A causal student learns by teacher forcing:
each chunk has its own noise level, and sees the clean chunks of the target before it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float, Key

from egosim_jax.conditioning import Condition
from egosim_jax.conditioning.condition import ConditionDropout
from egosim_jax.conditioning.posterior import STD, draw
from egosim_jax.configs.model import ModelConfig, Networks
from egosim_jax.diffusion.objective import Objective
from egosim_jax.diffusion.process import DenoiseFn
from egosim_jax.generation.encoding import encode_condition
from egosim_jax.models import CausalDenoiser, CausalDenoiserConfig, Flops, lora
from egosim_jax.train.task import Batch, Metrics
from egosim_jax.types import InputError

VALIDATION_SIGMAS = (0.2, 0.5, 0.8, 0.97)
"""Noise levels of the validation loss."""


@dataclass(frozen=True, kw_only=True)
class Denoising:
    """The task of training the denoiser."""

    model: ModelConfig
    """Model of the denoiser."""
    objective: Objective = field(default_factory=Objective)
    """Distribution and weighting of the noise levels."""
    dropout: ConditionDropout = field(default_factory=ConditionDropout)
    """Dropout rate of each condition."""
    change_loss_weight: float = 0.0
    """Additional loss weight where the clip differs from its prior.

    It differs at hands, at moved objects and in unobserved regions. They cover little of a frame
    and are all that there is to learn."""
    rank: int | None = None
    """Rank of a LoRA to train instead of the weights; None: no LoRA."""
    navigation: float = 0.0
    """Rate of samples without hands whose target is the prior: only the camera moves.

    This is DWM's regularizer, which no release of it uses."""

    def __post_init__(self) -> None:
        if not 0 <= self.navigation <= 1:
            raise InputError(
                f"The rate of samples without hands must be in [0, 1], not {self.navigation}. "
                "(--navigation)"
            )
        if self.navigation and not {"prior", "hands"} <= {*dict(self.model.layout.parts)}:
            raise InputError(
                f"{self.model.name} has no prior or no hands, so it cannot be trained to move "
                "the camera alone: omit the rate of such samples. (--navigation)"
            )
        if self.change_loss_weight and "prior" not in self.model.layout:
            raise InputError(
                f"{self.model.name} has no prior, from which a clip could change: the loss weight "
                f"of changes must be 0, not {self.change_loss_weight}. (change_loss_weight)"
            )

    @property
    def trained(self) -> Any:
        """The nnx filter of the trained weights: all, or the LoRA.

        A student keeps the text and image encoders of its teacher.
        """
        if self.rank is not None:
            return lora.trained(self.model.dit.also_train)
        return nnx.Param if self.model.chunks is None else _of_denoiser

    @property
    def frozen_dtype(self) -> str:
        """The compute dtype of the denoiser."""
        return self.model.dit.dtype

    def networks(self, rngs: nnx.Rngs) -> Networks:
        """Return the networks with random weights."""
        networks = Networks.build(self.model, only=self.model.trained_networks, rngs=rngs)
        if self.rank is not None:
            dit = self.model.dit
            lora.start(
                networks.dit,
                self.rank,
                targets=dit.lora_targets,
                also_train=dit.also_train,
                rngs=rngs,
            )
        return networks

    def examples(self) -> None:
        """Return None, the identity: a latents record is an example."""

    def shapes(self, batch: int) -> Mapping[str, jax.ShapeDtypeStruct]:
        """Return the shapes of a batch of latents records."""
        from egosim_jax.train.encode import example_shapes

        return example_shapes(self.model, batch)

    def keys(self, key: Key[Array, ""], batch: int) -> Key[Array, "b 2"]:
        """Return two keys per sample: one for condition dropout, one for noise."""
        drop, draw = jax.random.split(key)
        return jnp.stack([jax.random.split(drop, batch), jax.random.split(draw, batch)], axis=1)

    def loss(
        self, networks: Any, batch: Batch, keys: Key[Array, "b 2"]
    ) -> tuple[jax.Array, Metrics]:
        """Return the diffusion loss of a batch under condition dropout."""
        batch, condition = self.conditioned(networks, batch, keys)
        process, target = self.model.process, batch["target"]
        denoise = denoising(self.model, networks, condition, target)
        weights = loss_weights(target, batch.get("prior", target), self.change_loss_weight)
        chunks = self.model.chunks and self.model.chunks.sizes
        loss, _ = self.objective.loss(
            process, denoise, target, keys[:, 1], loss_weights=weights, chunks=chunks
        )
        return loss, {}

    def conditioned(
        self, networks: Any, batch: Batch, keys: Key[Array, "b 2"]
    ) -> tuple[Batch, Condition]:
        """Return the batch as it is learned, and its condition after dropout."""
        if self.model.posterior == "sampled":
            batch = draw_latents(batch, keys[:, 1])
        if self.navigation:
            batch = without_hands(batch, keys[:, 0], self.navigation)
        condition = condition_of(networks, batch, self.model)
        return batch, self.dropout.apply(condition, keys[:, 0])

    def validate(self, networks: Networks, batch: Batch) -> Metrics:
        """Return each sample's errors at fixed noise levels, under the full condition.

        The record number alone seeds the noise, so the batch size has no effect.
        """
        target = batch["target"]
        condition = condition_of(networks, batch, self.model)
        denoise = denoising(self.model, networks, condition, target)
        keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(0), batch["record"])
        noise = jax.vmap(lambda key: jax.random.normal(key, target.shape[1:]))(keys)
        axes = 1 if self.model.chunks is None else 2  # a student's chunks have their own times
        errors = {}
        for sigma in VALIDATION_SIGMAS:
            time = jnp.full(target.shape[:axes], sigma)
            error = self.objective.loss_at(self.model.process, denoise, target, noise, time)
            errors[f"loss_{sigma}"] = error if axes == 1 else error.mean(axis=1)
        return {"loss": jnp.stack(list(errors.values())).mean(axis=0), **errors}

    def flops(self, samples: int) -> float:
        """Return the model FLOPs of an update, of the denoiser alone, which has nearly all."""
        return samples * self.with_gradient(self.forward())

    def forward(self) -> Flops:
        """Return the FLOPs of a forward pass of one sample; of a student, of packed chunks."""
        if self.model.chunks is None:
            return self.model.dit.forward_flops(**self.sizes)
        dit = cast(CausalDenoiserConfig, self.model.dit)
        return dit.packed_flops(**self.sizes, chunks=self.model.chunks)

    def with_gradient(self, forward: Flops) -> float:
        """Return the FLOPs of a forward pass with its gradients of activations and of weights.

        The gradient of a LoRA's weights costs little.
        """
        return (3 if self.rank is None else 2) * forward.weights + 3 * forward.attention

    @property
    def sizes(self) -> dict[str, Any]:
        """Latent cells of a clip, and its numbers of text and image tokens."""
        model = self.model
        return {
            "latents": model.latent_shape,
            "text": model.tokenizer.max_tokens,
            "image": model.image_tokens,
        }


def _of_denoiser(path: tuple[Any, ...], value: Any) -> bool:
    """Return whether a variable of the networks is a weight of the denoiser, as an nnx filter."""
    return isinstance(value, nnx.Param) and path[0] == "dit"


def draw_latents(batch: Batch, keys: Key[Array, " b"]) -> Batch:
    """Return a batch with latents drawn from their posteriors."""
    latents = {}
    # Count from 2: the objective's `split(key)` gives the same keys as `fold_in` of 0 and 1.
    for number, name in enumerate(("target", "prior", "hands"), start=2):
        if name in batch:
            own = jax.vmap(jax.random.fold_in, (0, None))(keys, number)
            latents[name] = draw(batch[name], batch[f"{name}{STD}"], own)
    return {**batch, **latents}


def without_hands(batch: Batch, keys: Key[Array, " b"], rate: float) -> Batch:
    """Return a batch in which samples at `rate` have no hands and the prior as target."""
    own = jax.vmap(jax.random.fold_in, (0, None))(keys, 1)
    where = (jax.vmap(jax.random.uniform)(own) < rate)[:, None, None, None, None]
    return {
        **batch,
        "hands": jnp.where(where, 0, batch["hands"]),
        "target": jnp.where(where, batch["prior"], batch["target"]),
    }


def condition_of(networks: Networks, batch: Batch, model: ModelConfig) -> Condition:
    """Return the condition of a batch of latents records, encoded by the trained networks."""
    zeros = model.zero_image(len(batch["target"]))
    image = {} if zeros is None else {"image": jnp.asarray(zeros)}
    return encode_condition(networks, {**image, **batch})


def loss_weights(
    target: Float[Array, "b f h w c"], prior: Float[Array, "b f h w c"], change: float
) -> Float[Array, "b f h w 1"]:
    """Return the loss weight of each location, with mean 1 over a sample.

    Before normalization it is 1 + change * min(d, 1). d is the mean squared difference of the
    latents, whose channels have standard deviation 1.
    """
    difference = jnp.square(target - prior).mean(axis=-1, keepdims=True)
    weight = 1 + change * jnp.minimum(difference, 1)
    return weight / weight.mean(axis=(1, 2, 3), keepdims=True)


def denoising(
    model: ModelConfig, networks: Networks, condition: Condition, latents: Float[Array, "b f h w c"]
) -> DenoiseFn:
    """Return the denoising of clips: of a student, with clean `latents` before each chunk."""
    dit, chunks = networks.dit, model.chunks
    channels = model.layout.condition_channels(condition, latents)
    context = dit.prepare(channels, condition.text, condition.image)
    if chunks is None:
        return lambda x, t: dit.denoise(x, t, context)
    # Each latent frame has a timestep.
    first = np.array(chunks.bounds[:-1])
    student = cast(CausalDenoiser, dit)
    return lambda x, t: student.denoise_packed(latents, x, t[:, first], context, chunks)
