"""From conditions to a clip: encode, denoise, decode.

    triplets --pack--> Batch --encode--> Condition --denoise--> latents --decode--> clips

`pack` is NumPy; each other arrow is one compiled program (`compiled.py`). All denoising steps are
one scan, without a round trip to the host. Embeddings, cross-attention keys and values and the
condition's part of the patch embedding do not change between steps: they are computed before the
scan. The noise is donated. An item's noise depends only on its seed, so a clip does not depend on
its batch.

A causal student makes its chunks one after the other (`causal.py`).

On a mesh (`sharding.py`), data x fsdp splits the batch. Devices along context share the denoising
of a clip; each of them encodes and decodes the complete clip. If the devices belong to several
processes, all of them make the same calls and get all clips.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax.sharding import Mesh
from jaxtyping import Array, Float, Key, UInt8

from egosim_jax.conditioning.condition import Condition
from egosim_jax.conditioning.condition import Name as ConditionName
from egosim_jax.conditioning.pixels import to_model, to_uint8
from egosim_jax.configs.model import ModelConfig, Networks
from egosim_jax.diffusion.process import DenoiseFn
from egosim_jax.diffusion.solver import integrate
from egosim_jax.generation.causal import ChunkDenoiser, chunks_of, denoise_chunks
from egosim_jax.generation.compiled import CompiledFn
from egosim_jax.generation.encoding import (
    SOLVER_NOISE,
    batch_shapes,
    encode_condition,
    keys_for,
    last_32_bits,
    pack,
)
from egosim_jax.io.digest import fingerprint
from egosim_jax.io.run import plain
from egosim_jax.models import CausalDenoiser, Denoiser
from egosim_jax.rendering import Renderer, jitted
from egosim_jax.sharding import fetch, shard_params
from egosim_jax.types import (
    Action,
    Clip,
    InputError,
    Triplet,
    View,
    check_seed,
    check_video,
)

T = TypeVar("T")


class NonFiniteError(FloatingPointError):
    """Some clips of a batch have NaN or infinite latents; the others are valid."""

    def __init__(self, names: Sequence[str], bad: Sequence[int]):
        """`names` are the ids of all clips of the batch, `bad` the indices of the failed ones."""
        failed = [names[n] for n in bad]
        super().__init__(f"The latents of {failed} are not finite (NaN or infinity).")
        self.bad = tuple(bad)


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
    if config.strength is not None and condition.prior is not None:
        # SDEdit: the prior, noised to the first level, is the start instead of a condition.
        start = jnp.asarray(config.process.times(config.visited)[0], jnp.float32)
        noise = config.process.add_noise(condition.prior, noise, start)
        condition = condition.drop("prior")
    channels = config.layout.condition_channels(condition, noise)

    def branch(text: Array) -> DenoiseFn:
        context = dit.prepare(channels, text, condition.image)
        return lambda x, t: dit.denoise(x, t, context)

    text = jnp.asarray(condition.text)
    conditional = branch(text)
    # At scale 1 guidance returns the conditional branch: do not compute the other one.
    guided = config.guidance.scale != 1
    unconditional = branch(condition.drop("text").text) if guided else conditional
    return integrate(
        config.guidance.guide(conditional, unconditional),
        noise,
        process=config.process,
        solver=config.solver,
        steps=config.visited,
        keys=keys,
    )


class Generator:
    """Model that is ready to generate, on one device or on a mesh."""

    def __init__(
        self,
        config: ModelConfig,
        networks: Networks,
        mesh: Mesh | None = None,
        *,
        renderer: Renderer = jitted,
    ):
        self.config = config
        self.mesh = mesh
        self.renderer = renderer
        self.networks = networks = shard_params(networks, mesh)
        self._encode = CompiledFn(
            lambda networks, batch: encode_condition(networks, batch, config.encoding_noise),
            networks,
            mesh=mesh,
            cache_key=("encode", config),
        )
        self._latents = CompiledFn(
            lambda vae, video: vae.encode(to_model(video)), networks.vae, mesh=mesh
        )
        shape = (*config.latent_shape, config.vae.latent_channels)
        self._noise = CompiledFn(
            lambda _, seeds: jax.vmap(lambda seed: jax.random.normal(jax.random.key(seed), shape))(
                seeds
            ),
            nnx.Module(),
            mesh=mesh,
            cache_key=("noise", shape),
        )
        self._denoise = CompiledFn(
            lambda dit, condition, noise, *seeds: denoise(
                dit, condition, noise, config, *(keys_for(s, SOLVER_NOISE) for s in seeds)
            ),
            networks.dit,
            mesh=mesh,
            cache_key=("denoise", config),
            donate_argnums=2,
        )
        self._chunks = (
            None
            if config.chunks is None
            else ChunkDenoiser(config, cast(CausalDenoiser, networks.dit), mesh)
        )
        self._decode = CompiledFn(
            lambda vae, x: to_uint8(vae.decode(x)),
            networks.vae,
            mesh=mesh,
            cache_key=("decode", config),
        )

    @property
    def point_px(self) -> int:
        """Side of the points of a prior in pixels."""
        return self.config.point_px

    @classmethod
    def load(
        cls,
        config: str | ModelConfig,
        weights: Path | str | None = None,
        *,
        mesh: Mesh | None = None,
        lora: Path | None = None,
        lora_scale: float = 1.0,
        renderer: Renderer = jitted,
    ) -> Generator:
        """Load a model, by name or config, from a weights folder.

        Without a folder, loads the weights that are shipped with the package or were fetched.
        `lora` is a file or folder in any naming that `egosim convert` reads. Raises `InputError`
        if config, weights or LoRA are missing or do not fit each other, or if the LoRA names
        another base model.
        """
        from egosim_jax import configs

        config = configs.get(config) if isinstance(config, str) else config
        folder = configs.weights_of(config.name, None if weights is None else Path(weights))
        networks = Networks.load(config, folder, mesh=mesh)
        if lora is not None:
            from egosim_jax.convert.lora import check_base, read_lora
            from egosim_jax.io.weights import hashes
            from egosim_jax.models.lora import apply

            check_base(lora, [hashes(folder, only=["dit"])["dit"]])
            apply(networks.dit, read_lora(lora, config.dit), scale=lora_scale)
        return cls(config.at(folder), networks, mesh, renderer=renderer)

    def programs(self, batch: int) -> Iterator[tuple[str, CompiledFn, tuple]]:
        """Yield name, function and input shapes of each function that `generate` calls."""
        arrays = batch_shapes(batch, self.config)
        yield "encode", self._encode, (arrays,)
        seeds = jax.ShapeDtypeStruct((batch,), np.uint32)
        yield "noise", self._noise, (seeds,)
        noise = self._noise.shapes(seeds)
        inputs = self._encode.shapes(arrays), noise, *self._step_seeds(seeds)
        if self._chunks is None:
            yield "denoise", self._denoise, inputs
        else:
            yield from self._chunks.programs(*inputs)
        yield "decode", self._decode, (noise,)

    def compile(self, batch: int) -> None:
        """Compile all functions of `generate` for batches of this size."""
        for _, program, inputs in self.programs(batch):
            program.compile(*inputs)

    def generate(
        self,
        triplets: Sequence[Triplet],
        seeds: Sequence[int],
        *,
        without: ConditionName | None = None,
    ) -> list[Clip]:
        """Generate one clip for each triplet, from the noise of its seed.

        `without` drops one condition, as training does (`conditioning/condition.py`). Raises
        `InputError` if a mesh does not divide the batch, and `NonFiniteError` naming the clips
        whose latents are not finite.
        """
        return self._clips(self.latents(triplets, seeds, without=without))

    def latents(
        self,
        triplets: Sequence[Triplet],
        seeds: Sequence[int],
        *,
        without: ConditionName | None = None,
    ) -> Float[Array, "b f h w z"]:
        """Return the latents that `generate` decodes; raises the same errors."""
        condition = self._encode(pack(triplets, self.config, seeds))
        if without is not None:
            condition = condition.drop(without)
        if self.config.chunks is None:
            step_seeds = self._step_seeds(last_32_bits(seeds))
            latents = self._denoise(condition, self.noise(seeds), *step_seeds)
        else:
            latents = jnp.concatenate(list(self.chunks(condition, seeds)), axis=1)
        bad = [n for n, latent in enumerate(fetch(latents)) if not np.isfinite(latent).all()]
        if bad:
            raise NonFiniteError([triplet.video_id for triplet in triplets], bad)
        return latents

    def chunks(
        self, condition: Condition, seeds: Sequence[int]
    ) -> Iterator[Float[Array, "b f h w z"]]:
        """Yield the latents of a causal student's chunks, without waiting for them.

        Raises `InputError` for a model that makes clips at once.
        """
        bounds, noise = chunks_of(self.config).bounds, self.noise(seeds)
        channels = self.config.layout.condition_channels(condition, noise)
        parts = (channels[:, start:end] for start, end in pairwise(bounds))
        given = condition.text, condition.image, parts, noise, last_32_bits(seeds)
        yield from cast(ChunkDenoiser, self._chunks).latents(*given)

    def __call__(
        self, view: View, action: Action, first_frame: UInt8[np.ndarray, "h w 3"], seed: int
    ) -> UInt8[np.ndarray, "f h w 3"]:
        """Generate one clip of a simulation (`simulator.VideoGenerator`).

        Raises the errors of `condition` and `generate`.
        """
        check_seed(seed, name="seed")
        return self.generate([self.condition(view, action, first_frame)], [seed])[0].frames

    def condition(
        self, view: View, action: Action, first_frame: UInt8[np.ndarray, "h w 3"]
    ) -> Triplet:
        """Return the conditions of one clip of a simulation.

        Raises `InputError` unless view, action and first frame have the length and size of the
        model's clips, and for a model of static videos and hand meshes.
        """
        if self.config.layout.mask_packing == "observed":
            raise InputError(
                f"{self.config.name} is conditioned on a video of the whole scene and on hand "
                "meshes; the view of a state has holes, and its hands are skeletons. Generate from "
                "triplets (egosim generate --metadata), or simulate with an EgoSim model."
            )
        video = self.config.video
        shape = (video.frames, video.height, video.width)
        check_video("The view", view.frames, shape)
        check_video("The first frame (a video of one frame)", first_frame[None], (1, *shape[1:]))
        if len(action.joints_m) != video.frames:
            raise InputError(
                f"The action has {len(action.joints_m)} frames, the clips of {self.config.name} "
                f"have {video.frames}: give cameras and hands for {video.frames} frames."
            )
        return Triplet(
            video_id="clip",
            prompt=action.prompt,
            prior=view.frames,
            mask=view.mask,
            hands=self.renderer.draw_hands(action.joints_m, action.cameras, kind=action.kind)[0],
            first_frame=first_frame,
        )

    def fingerprint(self) -> str:
        """Return the content hash of the config and all weights in memory."""
        state = nnx.to_flat_state(nnx.state(self.networks, nnx.Param))
        return fingerprint(
            {
                "config": plain(self.config),
                **{".".join(map(str, path)): np.asarray(leaf.get_value()) for path, leaf in state},
            }
        )

    def reconstruct(self, triplets: Sequence[Triplet]) -> list[Clip]:
        """Encode and decode the targets: an upper bound for any denoiser."""
        return self._clips(self._latents(targets_of(triplets)))

    def noise(self, seeds: Sequence[int]) -> Float[Array, "b f h w z"]:
        """Return the initial noise of each seed; only its last 32 bits matter."""
        return self._noise(last_32_bits(seeds))

    def _step_seeds(self, seeds: T) -> tuple[T, ...]:
        """Return the seeds as last argument of `denoise`; nothing if the solver adds no noise."""
        return (seeds,) if self.config.solver.stochastic else ()

    def _clips(self, latents: Float[Array, "b f h w z"]) -> list[Clip]:
        frames = fetch(self._decode(latents))
        return [Clip(frames=video, fps=self.config.video.fps) for video in frames]


def batches(items: Sequence[T], size: int) -> Iterator[Sequence[T]]:
    """Yield the items in batches of `size`; the last one may be smaller."""
    for first in range(0, len(items), size):
        yield items[first : first + size]


def targets_of(triplets: Sequence[Triplet]) -> UInt8[np.ndarray, "b f h w 3"]:
    """Return the target videos. Raises `InputError` naming the clips without one."""
    without = [t.video_id for t in triplets if t.target is None]
    if without:
        raise InputError(f"{', '.join(without)}: no target to encode. (column video)")
    return np.stack([t.target for t in triplets if t.target is not None])
