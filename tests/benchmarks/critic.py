"""Training a VAE's decoder against a critic of image patches, to measure whether that pays.

The critic D (Isola et al. 2017, section 3.2.2) sees single frames and is trained with the hinge
loss (Lim and Ye 2017) in the same update as the decoder, each with the other's weights held:

    decoder   loss of `refining` - adversarial_weight * mean D(y)
    critic    mean max(0, 1 - D(x)) + mean max(0, 1 + D(y))
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import jax
from flax import nnx
from jaxtyping import Array, Float, Key

from egosim_jax.conditioning.pixels import to_model
from egosim_jax.configs.model import Networks
from egosim_jax.train.task import Batch, Metrics
from egosim_jax.train.tasks.refining import Refining

WIDTHS = (32, 64, 128)
"""Channels of the critic's layers, each of half the size of the one before."""


class Critic(nnx.Module):
    """Convolutional critic of overlapping patches of 22 x 22 pixels."""

    def __init__(self, *, rngs: nnx.Rngs):
        sizes = (3, *WIDTHS)
        self.layers = nnx.List(
            nnx.Conv(a, b, (4, 4), strides=(2, 2), rngs=rngs) for a, b in pairwise(sizes)
        )
        self.head = nnx.Conv(WIDTHS[-1], 1, (1, 1), rngs=rngs)

    def __call__(self, images: Float[Array, "b h w 3"]) -> Float[Array, "b y x 1"]:
        """Return how real each patch looks."""
        for layer in self.layers:
            images = jax.nn.leaky_relu(layer(images), 0.2)
        return self.head(images)


class WithCritic(Networks):
    """A VAE and its critic."""

    def __init__(self, *, vae: Any, critic: Critic):
        super().__init__(vae=vae)
        self.critic = critic


@dataclass(frozen=True, kw_only=True)
class Adversarial(Refining):
    """The task of training the decoder against a critic."""

    adversarial_weight: float = 0.005
    """Weight of the critic's opinion in the decoder's loss."""
    part: str = "decoder"
    """Weights of the VAE that are trained."""

    def networks(self, rngs: nnx.Rngs) -> WithCritic:
        """Return VAE and critic with random weights."""
        return WithCritic(vae=super().networks(rngs).vae, critic=Critic(rngs=rngs))

    @property
    def trained(self) -> Any:
        """The nnx filter of the decoder's weights and the critic's."""
        return nnx.Any(super().trained, lambda path, value: path[0] == "critic")

    def loss(
        self, networks: WithCritic, batch: Batch, keys: Key[Array, " b"]
    ) -> tuple[jax.Array, Metrics]:
        """Return the sum of both losses."""
        video = to_model(batch["video"])
        draw = jax.random.fold_in(keys[0], 1)
        frames = jax.random.choice(
            draw, self.video.frames, (self.perceptual_frames,), replace=False
        )
        decoded, loss, metrics = self.refinement_loss(networks.vae, video, keys[0], frames)
        real, fake = (x[:, frames].reshape(-1, *x.shape[2:]) for x in (video, decoded))
        graph, state = nnx.split(networks.critic)
        held = nnx.merge(graph, jax.lax.stop_gradient(state))
        opinion = held(fake).mean()
        critic = networks.critic
        hinge = jax.nn.relu(1 - critic(real)).mean()
        hinge += jax.nn.relu(1 + critic(jax.lax.stop_gradient(fake))).mean()
        metrics = {**metrics, "opinion": opinion, "hinge": hinge}
        return loss - self.adversarial_weight * opinion + hinge, metrics
