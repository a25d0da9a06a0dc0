"""From conditions to a clip: encode, denoise, decode.

    triplets --pack--> Batch --encode--> Condition --denoise--> latents --decode--> clips

`pack` is NumPy; each other arrow is one compiled program (`compiled.py`). All denoising steps are
one scan, without a round trip to the host. Embeddings, cross-attention keys and values and the
condition's part of the patch embedding do not change between steps: they are computed before the
scan. The noise is donated. An item's noise depends only on its seed, so a clip does not depend on
its batch.

A causal student makes its chunks one after the other (`causal.py`), and each of its arrows takes
one chunk (`stream.py`).

On a mesh (`sharding.py`), data x fsdp splits the batch. Devices along context share the denoising
of a clip; each of them encodes and decodes the complete clip. If the devices belong to several
processes, all of them make the same calls and get all clips.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax.sharding import Mesh
from jaxtyping import Array, Float, UInt8

from egosim_jax.conditioning.condition import Name as ConditionName
from egosim_jax.conditioning.pixels import to_model, to_uint8
from egosim_jax.configs.model import ModelConfig, Networks
from egosim_jax.generation.causal import ChunkDenoiser
from egosim_jax.generation.compiled import CompiledFn
from egosim_jax.generation.denoising import denoise
from egosim_jax.generation.encoding import (
    SOLVER_NOISE,
    batch_shapes,
    clip_shapes,
    encode_condition,
    keys_for,
    last_32_bits,
    pack,
    targets_of,
)
from egosim_jax.generation.stream import (
    CausalCodec,
    ClipStream,
    CodecPrograms,
    NonFiniteError,
    ViewStream,
    split_triplet,
)
from egosim_jax.io.digest import fingerprint
from egosim_jax.io.run import plain
from egosim_jax.models import CausalDenoiser, eight_bit
from egosim_jax.rendering import PriorKind, Renderer, jitted
from egosim_jax.runtime.phases import phase
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
        self.encode = CompiledFn(
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
        self.decode = CompiledFn(
            lambda vae, x: to_uint8(vae.decode(x)),
            networks.vae,
            mesh=mesh,
            cache_key=("decode", config),
        )
        vae = networks.vae
        self.codec: CodecPrograms | None = None
        self.denoiser: ChunkDenoiser | None = None
        if isinstance(vae, CausalCodec):
            self.codec = CodecPrograms(config, vae, mesh)
        if config.chunks is not None:
            if self.codec is None:
                raise InputError(
                    f"{config.name} makes clips chunk by chunk, but its {type(vae).__name__} codes "
                    "only whole clips. (chunks, vae)"
                )
            self.denoiser = ChunkDenoiser(config, cast(CausalDenoiser, networks.dit), mesh)

    @property
    def point_px(self) -> int:
        """Side of the points of a prior in pixels."""
        return self.config.point_px

    @property
    def prior(self) -> PriorKind:
        """Objects in a prior: at rest, or on their predicted paths."""
        return self.config.prior

    @classmethod
    def load(
        cls,
        config: str | ModelConfig,
        weights: Path | str | None = None,
        *,
        mesh: Mesh | None = None,
        lora: Path | str | None = None,
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
        if lora is not None:
            eight_bit.check_lora(folder)
        with phase(f"loads the weights of {config.name}"):
            networks = Networks.load(config, folder, mesh=mesh)
        if lora is not None:
            from egosim_jax.convert.lora import check_base, read_lora
            from egosim_jax.io.weights import hashes
            from egosim_jax.models.lora import apply

            check_base(Path(lora), [hashes(folder, only=["dit"])["dit"]])
            apply(networks.dit, read_lora(Path(lora), config.dit), scale=lora_scale)
        return cls(config.at(folder), networks, mesh, renderer=renderer)

    @property
    def chunk_frames(self) -> tuple[int, ...]:
        """Frames of each chunk of a clip; a model that makes clips at once has one chunk."""
        return self.config.chunk_frames

    def programs(
        self, batch: int, *, streamed: bool = False
    ) -> Iterator[tuple[str, CompiledFn, tuple]]:
        """Yield name, function and input shapes of each function that `generate` calls.

        `streamed` yields the functions of `groups`.
        """
        config, codec = self.config, self.codec
        whole = self.denoiser is None
        arrays = batch_shapes(batch, config) if whole else clip_shapes(batch, config)
        yield "encode", self.encode, (arrays,)
        if codec is not None and not whole:
            yield from codec.encode_programs(batch)
        seeds = jax.ShapeDtypeStruct((batch,), np.uint32)
        yield "noise", self._noise, (seeds,)
        noise = self._noise.shapes(seeds)
        condition, step_seeds = self.encode.shapes(arrays), self._step_seeds(seeds)
        if self.denoiser is None:
            yield "denoise", self._denoise, (condition, noise, *step_seeds)
        else:
            yield from self.denoiser.programs(condition.text, condition.image, noise, *step_seeds)
        if codec is not None and streamed:
            yield from codec.decode_programs(batch)
        else:
            yield "decode", self.decode, (noise,)

    def compile(self, *batches: int, streamed: bool = False) -> None:
        """Compile all functions of `generate`, or of `groups`, for batches of each size.

        One count numbers the functions of all sizes. Loading from the cache is silent, so the next
        line says how many functions were loaded.
        """
        count = len(batches) * self.count_programs(streamed=streamed)
        number = loaded = 0
        for batch in batches:
            together = f" for {batch} clips at once" if batch > 1 else ""
            for name, program, inputs in self.programs(batch, streamed=streamed):
                number += 1
                before = f" (after {loaded} from the cache)" if loaded else ""
                about = f"{number} of {count}: {name}{together}{before}"
                loaded = loaded + 1 if program.compile(*inputs, about=about) else 0

    def count_programs(self, *, streamed: bool = False) -> int:
        """Return the number of `programs`, without tracing any."""
        codec, whole = self.codec, self.denoiser is None
        count = 3 if self.denoiser is None else 2 + self.denoiser.count_programs()
        if codec is None:
            return count + 1
        decoders = codec.count_decoders() if streamed else 1
        return count + (0 if whole else len(codec.encoded_chunks(1))) + decoders

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
        return self._clips(fetch(self.decode(self.latents(triplets, seeds, without=without))))

    def latents(
        self,
        triplets: Sequence[Triplet],
        seeds: Sequence[int],
        *,
        without: ConditionName | None = None,
    ) -> Float[Array, "b f h w z"]:
        """Return the latents that `generate` decodes; raises the same errors."""
        if self.denoiser is None:
            condition = self.encode(pack(triplets, self.config, seeds))
            if without is not None:
                condition = condition.drop(without)
            step_seeds = self._step_seeds(last_32_bits(seeds))
            latents = self._denoise(condition, self.noise(seeds), *step_seeds)
        else:
            clips = ClipStream(self, seeds, without)
            chunks = [
                clips.denoise(triplets_of_chunk) for triplets_of_chunk in self._split(triplets)
            ]
            latents = jnp.concatenate(chunks, axis=1)
        bad = [n for n, latent in enumerate(fetch(latents)) if not np.isfinite(latent).all()]
        if bad:
            raise NonFiniteError([triplet.video_id for triplet in triplets], bad)
        return latents

    def groups(
        self,
        triplets: Sequence[Triplet],
        seeds: Sequence[int],
        *,
        without: ConditionName | None = None,
    ) -> Iterator[UInt8[np.ndarray, "b g h w 3"]]:
        """Yield the frames of one clip for each triplet in groups, as they are decoded.

        A group is one frame, then four for each latent frame; all frames if the VAE is not causal.
        Raises the errors of `generate`.
        """
        clips = ClipStream(self, seeds, without)
        for number, triplets_of_chunk in enumerate(self._split(triplets)):
            clips.put(triplets_of_chunk)  # before the frames of the chunk before are fetched
            if number:
                yield from clips.take()
        yield from clips.take()

    def begin(self, first_frame: UInt8[np.ndarray, "h w 3"], seed: int) -> ViewStream:
        """Begin a clip of a simulation (`streams.ChunkedGenerator`)."""
        check_seed(seed, name="seed")
        return ViewStream(self, first_frame, seed)

    def __call__(
        self, view: View, action: Action, first_frame: UInt8[np.ndarray, "h w 3"], seed: int
    ) -> UInt8[np.ndarray, "f h w 3"]:
        """Generate one clip of a simulation (`streams.VideoGenerator`).

        Raises the errors of `condition` and `generate`.
        """
        check_seed(seed, name="seed")
        return self.generate([self.condition(view, action, first_frame)], [seed])[0].frames

    def condition(
        self,
        view: View,
        action: Action,
        first_frame: UInt8[np.ndarray, "h w 3"],
        *,
        chunk: int | None = None,
    ) -> Triplet:
        """Return the conditions of one clip of a simulation, or of a chunk of it by index.

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
        frames = video.frames if chunk is None else self.chunk_frames[chunk]
        shape = (frames, video.height, video.width)
        check_video("The view", view.frames, shape)
        check_video("The first frame (a video of one frame)", first_frame[None], (1, *shape[1:]))
        if len(action.joints_m) != frames:
            whole = "clips" if chunk is None else f"chunks {chunk + 1}"
            raise InputError(
                f"The action has {len(action.joints_m)} frames, the {whole} of {self.config.name} "
                f"have {frames}: give cameras and hands for {frames} frames."
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
        return self._fingerprint

    @cached_property
    def _fingerprint(self) -> str:
        state = nnx.to_flat_state(nnx.state(self.networks, nnx.Param))
        return fingerprint(
            {
                "config": plain(self.config),
                **{".".join(map(str, path)): np.asarray(leaf.get_value()) for path, leaf in state},
            }
        )

    def reconstruct(self, triplets: Sequence[Triplet]) -> list[Clip]:
        """Encode and decode the targets: an upper bound for any denoiser."""
        return self._clips(fetch(self.decode(self._latents(targets_of(triplets)))))

    def noise(self, seeds: Sequence[int]) -> Float[Array, "b f h w z"]:
        """Return the initial noise of each seed; only its last 32 bits matter."""
        return self._noise(last_32_bits(seeds))

    def _step_seeds(self, seeds: T) -> tuple[T, ...]:
        """Return the seeds as last argument of `denoise`; nothing if the solver adds no noise."""
        return (seeds,) if self.config.solver.stochastic else ()

    def _split(self, triplets: Sequence[Triplet]) -> Iterator[list[Triplet]]:
        """Yield the conditions of each chunk of clips."""
        parts = [split_triplet(triplet, self.chunk_frames) for triplet in triplets]
        yield from map(list, zip(*parts, strict=True))

    def _clips(self, frames: UInt8[np.ndarray, "b f h w 3"]) -> list[Clip]:
        return [Clip(frames=video, fps=self.config.video.fps) for video in frames]
