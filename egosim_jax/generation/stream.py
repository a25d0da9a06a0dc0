"""Streaming: frames of a clip as soon as they are decoded.

    conditions of chunk n --encode--> latents --denoise--> latents --decode--> frames of chunk n

A causal student makes a clip chunk by chunk. Its VAE is causal too: encoding and decoding take over
the cache of the chunk before, so a chunk needs no later frame of its conditions, and the frames are
equal however many chunks have been made. `ClipStream.put` only dispatches the programs: the device
denoises chunk n + 1 while chunk n is decoded and fetched. Any other model makes one chunk, the
whole clip, whose frames are also decoded one latent frame after the other.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, UInt8

from egosim_jax.conditioning.condition import Condition
from egosim_jax.conditioning.condition import Name as ConditionName
from egosim_jax.conditioning.pixels import to_model, to_uint8
from egosim_jax.configs.model import ModelConfig
from egosim_jax.generation.causal import ChunkDenoiser, chunks_of
from egosim_jax.generation.compiled import CompiledFn
from egosim_jax.generation.encoding import last_32_bits, pack_clip, pack_videos, video_shapes
from egosim_jax.sharding import fetch, parts
from egosim_jax.types import Action, InputError, Triplet, View

VIDEOS = ("prior", "mask", "hands")
"""Fields of a triplet that have frames."""


class NonFiniteError(FloatingPointError):
    """Some clips of a batch have NaN or infinite latents; the others are valid."""

    def __init__(self, names: Sequence[str], bad: Sequence[int]):
        """`names` are the ids of all clips of the batch, `bad` the indices of the failed ones."""
        failed = [names[n] for n in bad]
        super().__init__(f"The latents of {failed} are not finite (NaN or infinity).")
        self.bad = tuple(bad)


@runtime_checkable
class CausalCodec(Protocol):
    """Video VAE that codes a video piece by piece (`WanVAE`)."""

    def encode_next(
        self, video: Float[Array, "b f h w 3"], cache: Any
    ) -> tuple[Float[Array, "b f2 h2 w2 z"], Any]:
        """Return the latents of the next frames, and the cache for those after them."""
        ...

    def decode_next(
        self, latents: Float[Array, "b 1 h w z"], cache: Any
    ) -> tuple[Float[Array, "b g h2 w2 3"], Any]:
        """Return the frames of the next latent frame, and the cache for the one after it."""
        ...


class CodecPrograms:
    """Compiled programs of a causal codec; each takes over the cache of the one before."""

    def __init__(self, config: ModelConfig, codec: Any, mesh: Mesh | None = None):
        self.config = config
        self._encode = CompiledFn(_encode_next, codec, mesh=mesh, cache_key=("encode next", config))
        self._decode = CompiledFn(_decode_next, codec, mesh=mesh, cache_key=("decode next", config))

    def encode(
        self, videos: dict[str, Any], caches: Any
    ) -> tuple[dict[str, Float[Array, "b f h w z"]], Any]:
        """Return the latents of the next frames of conditions, by name, and the new caches."""
        return self._encode(videos, caches) if videos else ({}, caches)

    def decode(
        self, latents: Float[Array, "b f h w z"], cache: Any
    ) -> tuple[list[tuple[UInt8[Array, "b g h2 w2 3"], Bool[Array, " b"]]], Any]:
        """Return the frames of each latent frame, and a mask of the finite clips; do not wait."""
        groups = []
        for number in range(latents.shape[1]):
            group, cache = self._decode(latents[:, number : number + 1], cache)
            group[0].copy_to_host_async()
            groups.append(group)
        return groups, cache

    def encode_programs(self, batch: int) -> Iterator[tuple[str, CompiledFn, tuple]]:
        """Yield name, function and input shapes of each program of `encode`."""
        caches = None
        for number, videos in self.encoded_chunks(batch).items():
            yield f"encode chunk {number + 1}", self._encode, (videos, caches)
            if number == 0:  # later chunks leave caches of equal shapes
                caches = self._encode.shapes(videos, caches)[1]

    def encoded_chunks(self, batch: int) -> dict[int, dict[str, Any]]:
        """Return the shapes of the videos of each chunk that needs its own program of `encode`."""
        shapes, kinds = {}, set()
        for number, frames in enumerate(self.config.chunk_frames):
            videos = video_shapes(batch, self.config, number)
            videos.pop("mask", None)
            if videos and (kind := (frames, number > 0)) not in kinds:
                kinds.add(kind)
                shapes[number] = videos
        return shapes

    def count_decoders(self) -> int:
        """Return the number of `decode_programs`, without tracing any."""
        return min(self.config.latent_shape[0], 2)

    def decode_programs(self, batch: int) -> Iterator[tuple[str, CompiledFn, tuple]]:
        """Yield name, function and input shapes of each program of `decode`."""
        frames, *cells = self.config.latent_shape
        shape = (batch, 1, *cells, self.config.vae.latent_channels)
        latents, cache = jax.ShapeDtypeStruct(shape, jnp.float32), None
        yield "decode 1", self._decode, (latents, cache)
        if frames > 1:
            yield "decode 2", self._decode, (latents, self._decode.shapes(latents, cache)[1])


class ClipStream:
    """One clip for each seed, chunk by chunk: conditions in (`put`), frames out (`take`)."""

    def __init__(self, generator: Any, seeds: Sequence[int], without: ConditionName | None = None):
        """Begin clips of a `Generator`; `without` drops one condition (`ConditionDropout`)."""
        self._generator, self._seeds = generator, seeds
        self._without: ConditionName | None = without
        self._names: list[str] = []
        self._begun = 0
        self._waiting: deque[Iterable[tuple[Any, Any]]] = deque()
        self._given: deque[Sequence[Triplet]] = deque()
        self._latents: Iterator[Array] | None = None
        self._cache: Any = None

    @property
    def chunk(self) -> int:
        """Index of the next chunk. Raises `InputError` after the last one."""
        config = self._generator.config
        if self._begun == len(config.chunk_frames):
            raise InputError(
                f"All {self._begun} chunks of this clip of {config.name} are made: begin another "
                "clip."
            )
        return self._begun

    def put(self, triplets: Sequence[Triplet]) -> None:
        """Begin the next chunk, from the conditions of its frames; do not wait for it.

        The prompts and first frames of the first chunk count. Raises `InputError` for conditions
        of another length, and after the last chunk.
        """
        latents, codec = self.denoise(triplets), self._generator.codec
        if codec is None:
            frames = self._generator.decode(latents)
            self._waiting.append([(frames, jnp.ones(len(frames), bool))])
        else:
            groups, self._cache = codec.decode(latents, self._cache)
            self._waiting.append(groups)

    def take(self) -> Iterator[UInt8[np.ndarray, "b g h w 3"]]:
        """Yield the frames of the oldest chunk that was put, in groups, as they are decoded.

        Raises `NonFiniteError` naming the clips whose latents are not finite.
        """
        for frames, finite in self._waiting.popleft():
            bad = np.flatnonzero(~fetch(finite)).tolist()
            if bad:
                raise NonFiniteError(self._names, bad)
            yield fetch(frames)

    def denoise(self, triplets: Sequence[Triplet]) -> Float[Array, "b f h w z"]:
        """Return the latents of the next chunk, which `put` decodes; raises the same errors."""
        self._check(triplets)
        self._names = [triplet.video_id for triplet in triplets]
        self._begun += 1
        denoiser: ChunkDenoiser | None = self._generator.denoiser
        if denoiser is None:
            return self._generator.latents(triplets, self._seeds, without=self._without)
        self._given.append(triplets)
        if self._latents is None:
            clip = self._generator.encode(pack_clip(triplets, denoiser.config))
            noise, drop = self._generator.noise(self._seeds), self._without
            text = clip.text if drop is None else clip.drop(drop).text
            given = text, clip.image, self._conditions(clip, noise), noise
            self._latents = denoiser.latents(*given, last_32_bits(self._seeds))
        return next(self._latents)

    def _conditions(
        self, clip: Condition, noise: Float[Array, "b f h w z"]
    ) -> Iterator[Float[Array, "b f h w c"]]:
        """Yield the condition channels of each chunk, from the triplets that were put."""
        config, codec = self._generator.config, self._generator.codec
        caches = None
        for start, end in pairwise(chunks_of(config).bounds):
            videos = pack_videos(self._given.popleft(), config, continued=start > 0)
            mask = videos.pop("mask", None)
            latents, caches = codec.encode(videos, caches)
            condition = replace(clip, mask=mask, **latents)
            if self._without is not None:
                condition = condition.drop(self._without)
            yield config.layout.condition_channels(condition, noise[:, start:end])

    def _check(self, triplets: Sequence[Triplet]) -> None:
        """Raise `InputError` unless the conditions have the frames of the next chunk."""
        name, frames = self._generator.config.name, self._generator.config.chunk_frames
        wanted = frames[self.chunk]
        for triplet in triplets:
            if any(len(getattr(triplet, video)) != wanted for video in VIDEOS):
                raise InputError(
                    f"Chunk {self.chunk + 1} of a clip of {name} has {wanted} frames; the "
                    f"conditions of {triplet.video_id} have {len(triplet.prior)}. The chunks have "
                    f"{', '.join(map(str, frames))} frames."
                )


class ViewStream:
    """One clip of a simulation, chunk by chunk (`streams.ClipStream`).

    On a mesh whose devices share a batch, all of them make the same clip.
    """

    def __init__(self, generator: Any, first_frame: UInt8[np.ndarray, "h w 3"], seed: int):
        """Begin a clip of a `Generator`."""
        self._generator, self._first_frame = generator, first_frame
        self._copies = 1 if generator.mesh is None else parts("batch", generator.mesh)
        self._clips = ClipStream(generator, [seed] * self._copies)

    def put(self, view: View, action: Action) -> None:
        """Begin the next chunk, from the view and the action of its frames; do not wait for it."""
        chunk = self._clips.chunk
        triplet = self._generator.condition(view, action, self._first_frame, chunk=chunk)
        self._clips.put([triplet] * self._copies)

    def take(self) -> Iterator[UInt8[np.ndarray, "g h w 3"]]:
        """Yield the frames of the oldest chunk that was put, in groups, as they are decoded."""
        for frames in self._clips.take():
            yield frames[0]


def split_triplet(triplet: Triplet, lengths: Sequence[int]) -> list[Triplet]:
    """Return the conditions of each chunk of a clip, by the numbers of frames of the chunks."""
    ends = np.cumsum(lengths).tolist()
    return [
        replace(
            triplet,
            **{name: getattr(triplet, name)[end - length : end] for name in VIDEOS},
            target=None,
        )
        for length, end in zip(lengths, ends, strict=True)
    ]


def _encode_next(codec: CausalCodec, videos: dict[str, Any], caches: Any) -> tuple[Any, Any]:
    """Return the latents of the next frames of several videos, and the new caches."""
    before = caches or dict.fromkeys(videos)
    split = {
        name: codec.encode_next(to_model(video), before[name]) for name, video in videos.items()
    }
    latents, after = ({name: pair[n] for name, pair in split.items()} for n in range(2))
    return latents, after


def _decode_next(
    codec: CausalCodec, latents: Float[Array, "b 1 h w z"], cache: Any
) -> tuple[tuple[UInt8[Array, "b g h2 w2 3"], Bool[Array, " b"]], Any]:
    """Return the frames of the next latent frame, if it is finite, and the new cache."""
    frames, cache = codec.decode_next(latents, cache)
    finite = jnp.isfinite(latents).all(axis=(1, 2, 3, 4))
    return (to_uint8(jnp.asarray(frames)), finite), cache
