"""Self-forcing of a causal student: it learns from clips that it makes itself, chunk by chunk.

The student makes each chunk from its own earlier chunks, as at generation, without gradient. One
of a chunk's denoising steps, drawn for each clip, then runs again with gradient (replayed
back-propagation). Its prediction of the data, y, is compared in two ways:

    regression    mean w |y - x0|^2            with the recorded clip x0
    matching      the gradient (f - r) / mean |y - r| at y, where r and f are the predictions of
                  teacher and critic for the noised y: distribution matching (DMD, Yin et al. 2024)

The teacher denoises whole clips and does not change. The critic learns to denoise the student's
clips, by updates between the student's. w weights the locations (`denoising.loss_weights`). With
`matching` 0 there is no critic, and the training is regression on self-forced clips.

Sources: Self Forcing (Huang et al. 2025) for the clips, Causal-rCM for the replay.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from egosim_jax.conditioning import Condition
from egosim_jax.diffusion.objective import Objective
from egosim_jax.diffusion.solver import Visited, integrate_visiting
from egosim_jax.generation.causal import chunks_of, steps_of
from egosim_jax.models import CausalDenoiser, CausalDenoiserConfig
from egosim_jax.train.config import CriticConfig
from egosim_jax.train.task import Batch, Metrics, Roles
from egosim_jax.train.tasks.denoising import Denoising, condition_of, loss_weights
from egosim_jax.types import InputError

MATCHED_TIMES = 0.02, 0.98
"""Range of the uniform positions of the noise under which teacher and critic are compared."""


class Chunk(NamedTuple):
    """A chunk that the student has made."""

    visited: Visited
    """Its denoising steps."""
    cache: Any
    """Keys and values of the chunks before it."""
    latents: Float[Array, "b f h w z"]
    """Finished latents."""


@dataclass(frozen=True, kw_only=True)
class Matching(Denoising):
    """The task of training a causal student on its own clips."""

    matching: float = 1.0
    """Weight of distribution matching; 0: regression alone, without a critic."""
    regression: float = 0.25
    """Weight of the squared distance to the recorded clip."""
    training: CriticConfig | None = None
    """Training of the critic; None: the defaults."""

    def __post_init__(self) -> None:
        super().__post_init__()
        chunks_of(self.model)
        if min(self.matching, self.regression) < 0 or not self.matching + self.regression:
            raise InputError(
                "The weights of matching and regression must be at least 0 and not both 0: "
                f"{self.matching} and {self.regression} were given. (--matching, --regression)"
            )

    @property
    def critic(self) -> CriticConfig | None:
        """Training of the critic; None without distribution matching."""
        return (self.training or CriticConfig()) if self.matching else None

    def loss(
        self, networks: Any, batch: Batch, keys: Key[Array, "b 2"]
    ) -> tuple[jax.Array, Metrics]:
        """Return the weighted sum of both terms on clips that the student makes."""
        roles: Roles = networks
        condition = self._condition(roles, batch, keys)
        target = batch["target"]
        weights = loss_weights(target, batch.get("prior", target), self.change_loss_weight)
        clip = self.replay(roles.student.dit, condition, target, keys[:, 1])
        error = (weights * jnp.square(clip - target)).mean()
        loss, metrics = self.regression * error, {"regression": error}
        if self.matching:
            gap = self._gap(roles, condition, jax.lax.stop_gradient(clip), keys[:, 1])
            # The gradient of half the squared distance to a fixed clip - gap is gap.
            fixed = jax.lax.stop_gradient(clip - gap)
            loss = loss + self.matching * 0.5 * (weights * jnp.square(clip - fixed)).mean()
            metrics["gap"] = jnp.sqrt(jnp.square(gap).mean())
        return loss, metrics

    def critic_loss(
        self, roles: Roles, batch: Batch, keys: Key[Array, "b 2"]
    ) -> tuple[jax.Array, Metrics]:
        """Return the critic's diffusion loss on clips that the student makes."""
        condition = self._condition(roles, batch, keys)
        target = batch["target"]
        chunks = self.rollout(roles.student.dit, condition, target, keys[:, 1])
        drawn = self._steps(keys[:, 1])
        predicted = [
            self._data(_at(chunk.visited.latents, step), _at(chunk.visited.outputs, step), time)
            for chunk, (step, time) in zip(chunks, drawn, strict=True)
        ]
        clip = jax.lax.stop_gradient(jnp.concatenate(predicted, axis=1))
        own = jax.vmap(jax.random.fold_in, (0, None))(keys[:, 1], 3)
        denoise = self._whole(roles.critic.dit, condition, clip)
        return Objective().loss(self.model.process, denoise, clip, own)[0], {}

    def rollout(
        self,
        dit: CausalDenoiser,
        condition: Condition,
        target: Float[Array, "b f h w z"],
        keys: Key[Array, " b"],
    ) -> list[Chunk]:
        """Return the chunks of clips that a student makes from noise, as generation makes them."""
        model = self.model
        chunks = chunks_of(model)
        own = jax.vmap(jax.random.fold_in, (0, None))(keys, 0)
        noise = jax.vmap(lambda key: jax.random.normal(key, target.shape[1:]))(own)
        channels = model.layout.condition_channels(condition, noise)
        shared = dit.share(condition.text, condition.image)
        cache, made = dit.empty_cache(len(noise), model.latent_shape), []
        for number, (start, end) in enumerate(pairwise(chunks.bounds)):
            context = dit.prepare_chunk(channels[:, start:end], shared, start)
            added = jax.vmap(jax.random.fold_in, (0, None))(keys, 10 + number)
            latents, kept, visited = integrate_visiting(
                lambda x, t, context=context, cache=cache: dit.denoise_chunk(x, t, context, cache),
                noise[:, start:end],
                process=model.process,
                solver=model.solver,
                steps=steps_of(self.model, number),
                keys=added if model.solver.stochastic else None,
            )
            made.append(Chunk(visited, cache, latents))
            if number == len(chunks.sizes) - 1:
                break
            if chunks.refresh:
                _, kept = dit.denoise_chunk(latents, jnp.zeros(len(latents)), context, cache)
            cache = cache.put(kept)
        return made

    def replay(
        self,
        dit: CausalDenoiser,
        condition: Condition,
        target: Float[Array, "b f h w z"],
        keys: Key[Array, " b"],
    ) -> Float[Array, "b f h w z"]:
        """Return predictions of the data by one drawn step of each chunk, with gradient."""
        made = jax.lax.stop_gradient(self.rollout(dit, condition, target, keys))
        channels = self.model.layout.condition_channels(condition, target)
        shared = dit.share(condition.text, condition.image)
        predicted, bounds = [], chunks_of(self.model).bounds
        drawn = self._steps(keys)
        for chunk, (start, end), (step, time) in zip(made, pairwise(bounds), drawn, strict=True):
            context = dit.prepare_chunk(channels[:, start:end], shared, start)
            noisy = _at(chunk.visited.latents, step)
            timesteps = chunk.visited.timesteps[step]
            output, _ = dit.denoise_chunk(noisy, timesteps, context, chunk.cache)
            predicted.append(self._data(noisy, output, time))
        return jnp.concatenate(predicted, axis=1)

    def validate(self, networks: Any, batch: Batch) -> Metrics:
        """Also return the squared error of the clip that the student makes, of latents."""
        errors = super().validate(networks, batch)
        keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(1), batch["record"])
        condition = condition_of(networks, batch, self.model)
        made = self.rollout(networks.dit, condition, batch["target"], keys)
        clip = jnp.concatenate([chunk.latents for chunk in made], axis=1)
        error = jnp.square(clip - batch["target"]).mean(axis=(1, 2, 3, 4))
        return {**errors, "made": error}

    def flops(self, samples: int) -> float:
        """Return the model FLOPs of an update of the student, and of the critic's before it."""
        model = self.model
        chunks, dit = chunks_of(model), cast(CausalDenoiserConfig, model.dit)
        made = replayed = 0.0
        for number, (start, end) in enumerate(pairwise(chunks.bounds)):
            shape = (end - start, *model.latent_shape[1:])
            one = dit.chunk_flops(**{**self.sizes, "latents": shape}, seen=start)
            made += one.total * self._count(number)
            made += one.total * (chunks.refresh and number < len(chunks.sizes) - 1)
            replayed += self.with_gradient(one)
        total = made + replayed
        if self.critic is not None:
            whole = model.dit.forward_flops(**self.sizes)
            total += 2 * whole.total + self.critic.updates * (made + self.with_gradient(whole))
        return samples * total

    def _count(self, number: int) -> int:
        """Return the number of denoising steps of a chunk."""
        return len(self.model.process.times(steps_of(self.model, number))) - 1

    def _condition(self, roles: Roles, batch: Batch, keys: Key[Array, "b 2"]) -> Condition:
        condition = condition_of(roles.student, batch, self.model)
        return self.dropout.apply(condition, keys[:, 0])

    def _steps(self, keys: Key[Array, " b"]) -> list[tuple[jax.Array, jax.Array]]:
        """Return a step of each chunk and its time, drawn at one position of all chunks."""
        own = jax.vmap(jax.random.fold_in, (0, None))(keys, 1)
        position = jax.vmap(jax.random.uniform)(own)
        found = []
        for number in range(len(chunks_of(self.model).sizes)):
            times = self.model.process.times(steps_of(self.model, number))[:-1]
            times = jnp.asarray(times, jnp.float32)
            count = len(times)
            step = jnp.minimum((position * count).astype(jnp.int32), count - 1)
            found.append((step, times[step]))
        return found

    def _data(
        self,
        noisy: Float[Array, "b f h w z"],
        output: Float[Array, "b f h w z"],
        time: Float[Array, " b"],
    ) -> Float[Array, "b f h w z"]:
        process, level = self.model.process, time.reshape(-1, 1, 1, 1, 1)
        output = output.astype(jnp.float32)
        return process.to_x0(noisy, output, process.alpha(level), process.sigma(level))

    def _whole(self, dit: Any, condition: Condition, clip: Float[Array, "b f h w z"]) -> Any:
        """Return the denoising of whole clips, as the teacher does it."""
        channels = self.model.layout.condition_channels(condition, clip)
        context = dit.prepare(channels, condition.text, condition.image)
        return lambda x, t: dit.denoise(x, t, context)

    def _gap(
        self,
        roles: Roles,
        condition: Condition,
        clip: Float[Array, "b f h w z"],
        keys: Key[Array, " b"],
    ) -> Float[Array, "b f h w z"]:
        """Return the distance of critic and teacher at noised clips, over the teacher's error."""
        process = self.model.process
        own = jax.vmap(lambda k: jax.random.split(jax.random.fold_in(k, 2)))(keys)
        low, high = MATCHED_TIMES
        position = low + (high - low) * jax.vmap(jax.random.uniform)(own[:, 0])
        time = process.warp(position)
        timesteps = process.timesteps(time)
        noise = jax.vmap(lambda k: jax.random.normal(k, clip.shape[1:]))(own[:, 1])
        noisy = process.add_noise(clip, noise, time.reshape(-1, 1, 1, 1, 1))
        real, fake = (
            self._data(noisy, self._whole(dit, condition, clip)(noisy, timesteps), time)
            for dit in (roles.teacher.dit, roles.critic.dit)
        )
        error = jnp.abs(clip - real).mean(axis=(1, 2, 3, 4), keepdims=True)
        return jax.lax.stop_gradient((fake - real) / jnp.maximum(error, np.float32(1e-5)))


def _at(steps: Float[Array, "s b f h w z"], step: Int[Array, " b"]) -> Float[Array, "b f h w z"]:
    """Return each sample's entry of a step."""
    return steps[step, jnp.arange(steps.shape[1])]
