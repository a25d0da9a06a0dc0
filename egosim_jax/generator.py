"""From conditions to a clip: encode, denoise, decode.

    triplet --tokenize, pack--> Inputs --encode--> Condition --denoise--> latents --decode--> clip

Each arrow is one compiled program (`program.py`). All denoising steps are one, a scan without a
round trip to the host; what the steps share (embeddings, cross-attention keys and values, the
condition's part of the patch embedding) is computed before the scan, and the noise is donated. An
item's noise depends on its own seed only, so that a clip does not depend on its batch.

On a mesh (`sharding.py`) every batch is dealt out over data x fsdp; the devices along context share
the denoising of a clip, and each of them encodes and decodes it, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int, Key, UInt8, UInt32

from egosim_jax.conditioning.condition import Condition
from egosim_jax.conditioning.condition import Name as ConditionName
from egosim_jax.conditioning.image import clip_pixels
from egosim_jax.conditioning.posterior import (
    EncodingNoise,
    NormalizedCodec,
    add_pixel_noise,
    draw,
    posterior,
)
from egosim_jax.conditioning.video import to_model, to_uint8
from egosim_jax.diffusion.process import DenoiseFn
from egosim_jax.diffusion.solver import integrate
from egosim_jax.io.fingerprint import fingerprint
from egosim_jax.io.run import plain
from egosim_jax.models import Denoiser
from egosim_jax.networks import ModelConfig, Networks
from egosim_jax.program import CompiledFn, replicate_params, shard_params
from egosim_jax.rendering import Renderer, jitted
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


@no_type_check
@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Inputs:
    """Batch of triplets as arrays."""

    prior: UInt8[Any, "b f h w 3"] | None
    hands: UInt8[Any, "b f h w 3"] | None
    mask: UInt8[Any, "b lf lh lw m"] | None
    ids: Int[Any, "b n"]
    ids_mask: Bool[Any, "b n"]
    null_ids: Int[Any, "b n"] | None
    """Token ids of the model's `unconditional_prompt`."""
    null_mask: Bool[Any, "b n"] | None
    pixels: Float[Any, "b s s 3"] | None
    image: Float[Any, "b m e"] | None = None
    """Image tokens of zeros, of a model that has them in place of an encoder's."""
    seeds: UInt32[Any, " b"] | None = None
    """Seeds of the model's `encoding_noise`; None without."""

    @classmethod
    def of(
        cls, triplets: Sequence[Triplet], config: ModelConfig, seeds: Sequence[int] | None = None
    ) -> Inputs:
        """Tokenize the prompts, pack the masks and prepare the image for CLIP.

        `seeds` are only needed, and kept, where the encoding is random.
        """
        tokens, layout = config.tokenizer.tokenize([t.prompt for t in triplets]), config.layout
        masks = [layout.pack_mask(t.mask, config.grid) for t in triplets if "mask" in layout]
        null = config.unconditional_prompt
        nulls = None if null is None else config.tokenizer.tokenize([null] * len(triplets))
        return cls(
            prior=np.stack([t.prior for t in triplets]) if "prior" in layout else None,
            hands=np.stack([t.hands for t in triplets]) if "hands" in layout else None,
            mask=np.stack(masks) if "mask" in layout else None,
            ids=tokens.ids,
            ids_mask=tokens.mask,
            null_ids=nulls and nulls.ids,
            null_mask=nulls and nulls.mask,
            pixels=config.image
            and clip_pixels(
                np.stack([t.first_frame for t in triplets]),
                image_size=config.image.image_size,
                image_range=config.image_range,
            ),
            image=config.given_image(triplets),
            seeds=None if seeds is None or config.encoding_noise is None else _uint32(seeds),
        )

    @classmethod
    def shapes(cls, batch: int, config: ModelConfig) -> Inputs:
        """Return the shapes and dtypes of a batch, to compile for before there is one."""
        shape = lambda dtype, *sizes: jax.ShapeDtypeStruct((batch, *sizes), dtype)  # noqa: E731
        video, tokens, layout = config.video, config.tokenizer.max_tokens, config.layout
        frames = shape(np.uint8, video.frames, video.height, video.width, 3)
        size = config.image and config.image.image_size
        mask = shape(np.uint8, *config.latent_shape, layout.count("mask"))
        null, zeros = config.unconditional_prompt is not None, config.zero_image(1)
        return cls(
            prior=frames if "prior" in layout else None,
            hands=frames if "hands" in layout else None,
            mask=mask if "mask" in layout else None,
            ids=shape(np.int32, tokens),
            ids_mask=shape(np.bool_, tokens),
            null_ids=shape(np.int32, tokens) if null else None,
            null_mask=shape(np.bool_, tokens) if null else None,
            pixels=size and shape(np.float32, size, size, 3),
            image=None if zeros is None else shape(zeros.dtype, *zeros.shape[1:]),
            seeds=None if config.encoding_noise is None else shape(np.uint32),
        )


def encode_condition(
    networks: Networks, inputs: Inputs, noise: EncodingNoise | None = None
) -> Condition:
    """Encode the conditions: videos to latents, prompt and image to tokens.

    `noise` draws from the inputs' seeds.
    """
    noise = noise or EncodingNoise()
    if inputs.seeds is None and noise != EncodingNoise():
        raise InputError("A random encoding needs seeds: give each triplet one. (seeds)")
    keys: Any = () if inputs.seeds is None else (_keys(inputs.seeds, 2), _keys(inputs.seeds, 3))

    def encode(video: Array | None, *, std: float = 0.0, drawn: bool = False) -> Array | None:
        if video is None:
            return None
        pixels: Any = to_model(video)
        if std:
            pixels = add_pixel_noise(pixels, std, keys[0])
        if drawn:
            return draw(*posterior(cast(NormalizedCodec, networks.vae), pixels), keys[1])
        return networks.vae.encode(pixels)

    embed = replicate_params(networks.text)
    return Condition(
        mask=None if inputs.mask is None else inputs.mask.astype(jnp.float32),
        prior=encode(inputs.prior, std=noise.prior_pixels),
        hands=encode(inputs.hands, drawn=noise.hands),
        text=embed(inputs.ids, inputs.ids_mask),
        null_text=None
        if inputs.null_ids is None or inputs.null_mask is None
        else embed(inputs.null_ids, inputs.null_mask),
        image=inputs.image
        if networks.image is None or inputs.pixels is None
        else replicate_params(networks.image)(inputs.pixels),
    )


def denoise(
    dit: Denoiser,
    condition: Condition,
    noise: Float[Array, "b f h w z"],
    config: ModelConfig,
    keys: Key[Array, " b"] | None = None,
) -> Float[Array, "b f h w z"]:
    """Run the sampler; the unconditional branch gets the text embeddings of no prompt.

    `keys`, one for each item, draw the noise that a stochastic solver adds.
    """
    if config.strength is not None and condition.prior is not None:
        first = jnp.asarray(config.process.times(config.visited)[0], jnp.float32)
        noise = config.process.add_noise(condition.prior, noise, first)
        condition = condition.drop("prior")
    channels = config.layout.condition_channels(condition, noise)

    def branch(text: Array) -> DenoiseFn:
        context = dit.prepare(channels, text, condition.image)
        return lambda x, t: dit.denoise(x, t, context)

    text = jnp.asarray(condition.text)
    conditional = branch(text)
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
    """Model that is ready to generate, on one device or on the devices of a mesh."""

    def __init__(
        self,
        config: ModelConfig,
        networks: Networks,
        mesh: Mesh | None = None,
        *,
        renderer: Renderer = jitted,
    ):
        self.config = config
        self.renderer = renderer
        self.networks = networks = shard_params(networks, mesh)
        self._encode = CompiledFn(
            lambda networks, inputs: encode_condition(networks, inputs, config.encoding_noise),
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
                dit, condition, noise, config, *map(_step_keys, seeds)
            ),
            networks.dit,
            mesh=mesh,
            cache_key=("denoise", config),
            donate_argnums=2,
        )
        self._decode = CompiledFn(
            lambda vae, x: to_uint8(vae.decode(x)),
            networks.vae,
            mesh=mesh,
            cache_key=("decode", config),
        )

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

        Without a folder, these are the weights that come with the package or were fetched. `lora`
        is a file in any naming that `egosim-convert` reads. Raises `InputError` if config, weights
        or LoRA are missing or do not fit each other, or if the LoRA names another base.
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
        inputs = Inputs.shapes(batch, self.config)
        yield "encode", self._encode, (inputs,)
        seeds = jax.ShapeDtypeStruct((batch,), np.uint32)
        yield "noise", self._noise, (seeds,)
        given = self._encode.shapes(inputs), self._noise.shapes(seeds), *self._stepping(seeds)
        yield "denoise", self._denoise, given
        yield "decode", self._decode, (self._denoise.shapes(*given),)

    def compile(self, batch: int) -> None:
        """Compile all functions of `generate` for batches of this size."""
        for _, program, given in self.programs(batch):
            program.compile(*given)

    def generate(
        self,
        triplets: Sequence[Triplet],
        seeds: Sequence[int],
        *,
        without: ConditionName | None = None,
    ) -> list[Clip]:
        """Generate one clip for each triplet, from the noise of its seed.

        `without` hides one condition, as training does (`conditioning/dropout.py`). Raises
        `InputError` if a mesh does not divide the batch, and `FloatingPointError` naming the clips
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
        """Return the latents that `generate` decodes; raises what it raises."""
        condition = self._encode(Inputs.of(triplets, self.config, seeds))
        if without is not None:
            condition = condition.drop(without)
        latents = self._denoise(condition, self.noise(seeds), *self._stepping(_uint32(seeds)))
        bad = [
            triplet.video_id
            for triplet, latent in zip(triplets, np.asarray(latents), strict=True)
            if not np.isfinite(latent).all()
        ]
        if bad:
            raise FloatingPointError(f"The latents of {bad} are not finite (NaN or infinity).")
        return latents

    def __call__(
        self, view: View, action: Action, first_frame: UInt8[np.ndarray, "h w 3"], seed: int
    ) -> UInt8[np.ndarray, "f h w 3"]:
        """Generate one clip of a simulation (`simulator.VideoGenerator`).

        Raises what `condition` raises.
        """
        check_seed(seed, name="seed")
        return self.generate([self.condition(view, action, first_frame)], [seed])[0].frames

    def condition(
        self, view: View, action: Action, first_frame: UInt8[np.ndarray, "h w 3"]
    ) -> Triplet:
        """Return the conditions of one clip of a simulation.

        Raises `InputError` unless view, action and first frame have the length and size of the
        model's clips.
        """
        video = self.config.video
        shape = (video.frames, video.height, video.width)
        check_video("The view", view.frames, shape)
        check_video("The first frame, as a clip of one,", first_frame[None], (1, *shape[1:]))
        if len(action.joints_m) != video.frames:
            raise InputError(
                f"The action has {len(action.joints_m)} frames, the clips of {self.config.name} "
                f"have {video.frames}: give as many cameras and hands."
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
        """Return the content hash of the config and all weights, as they are in memory."""
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
        """Return the initial noise of each seed, of which the last 32 bits count."""
        return self._noise(_uint32(seeds))

    def _stepping(self, seeds: T) -> tuple[T, ...]:
        """Return what a stochastic solver gets besides the noise: the seeds."""
        return (seeds,) if self.config.solver.stochastic else ()

    def _clips(self, latents: Float[Array, "b f h w z"]) -> list[Clip]:
        frames = np.asarray(self._decode(latents))
        return [Clip(frames=video, fps=self.config.video.fps) for video in frames]


def _uint32(seeds: Sequence[int]) -> np.ndarray:
    return np.array([seed & 0xFFFFFFFF for seed in seeds], np.uint32)


def _step_keys(seeds: Array) -> Key[Array, " b"]:
    """Return the key of each seed's noise at the solver's steps, other than its starting noise."""
    return _keys(seeds, 1)


def _keys(seeds: Array, use: int) -> Key[Array, " b"]:
    """Return a key of each seed for one of its uses."""
    return jax.vmap(lambda seed: jax.random.fold_in(jax.random.key(seed), use))(seeds)


def batches(items: Sequence[T], size: int) -> Iterator[Sequence[T]]:
    """Iterate over the items in batches of `size`; the last one may be smaller."""
    for first in range(0, len(items), size):
        yield items[first : first + size]


def targets_of(triplets: Sequence[Triplet]) -> UInt8[np.ndarray, "b f h w 3"]:
    """Return the target videos. Raises `InputError` naming the clips that have none."""
    without = [t.video_id for t in triplets if t.target is None]
    if without:
        raise InputError(f"{', '.join(without)}: no target to encode. (column video)")
    return np.stack([t.target for t in triplets if t.target is not None])
