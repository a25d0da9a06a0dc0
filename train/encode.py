"""Encoding of clips to shards of latents and embeddings, which training reads instead of videos.

Every window of a clip is a separate record, because the causal VAE encodes a window's first frame
alone. The windows are split into parts of equal size. Each part is one shard, written atomically to
its folder OUT/parts/00000, ...; process p of n writes the missing ones of parts p, p + n, ... When
all parts exist, the first process renames their shards into OUT and writes the manifest. Its
provenance has the config, the source's fingerprint and the hashes of the encoders.

An unreadable clip is skipped with all its windows; the provenance has its record number. The
windows depend on the readable clips, so OUT/parts/00000.json lists the windows of a part. A part
whose list differs is written again.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from fractions import Fraction
from functools import partial
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax.experimental import multihost_utils
from jax.sharding import Mesh

from egosim_jax.conditioning.pixels import to_model
from egosim_jax.conditioning.posterior import STD
from egosim_jax.conditioning.posterior import posterior as moments_of
from egosim_jax.configs.model import ModelConfig, Networks
from egosim_jax.data.loader import Loader
from egosim_jax.data.manifest import MANIFEST, read_manifest
from egosim_jax.data.mixing import MIXTURE, read_mixture
from egosim_jax.data.shards import ShardReader, ShardWriter, gather
from egosim_jax.data.static import check_static
from egosim_jax.data.transforms import check_rates
from egosim_jax.generation.compiled import CompiledFn
from egosim_jax.generation.encoding import Batch, batch_shapes, batches, pack, targets_of
from egosim_jax.io.bounded import listing, quote
from egosim_jax.io.decoding import Decoding
from egosim_jax.io.run import open_folder
from egosim_jax.io.weights import hashes
from egosim_jax.runtime.progress import track
from egosim_jax.runtime.terminal import printable
from egosim_jax.sharding import check_batch, shard_params
from egosim_jax.train.distributed import leave_if_preempted
from egosim_jax.train.encode_windows import Damaged, PartWindows, Window, read_windows, windows
from egosim_jax.types import InputError, Triplet, check_counts

logger = logging.getLogger(__name__)

MAX_PARTS = 100_000
"""Maximum number of shards: their names have five digits."""


class Encoding:
    """Encoder of clips to the arrays of latents records, on one device or on a mesh."""

    def __init__(self, config: ModelConfig, encoders: Networks, mesh: Mesh | None = None):
        self.config = config
        self._encode = CompiledFn(
            partial(_encode, posterior=config.posterior), shard_params(encoders, mesh), mesh=mesh
        )

    def __call__(self, triplets: Sequence[Triplet]) -> list[dict[str, np.ndarray]]:
        """Return the arrays of each triplet's record.

        With frozen encoders the arrays are embeddings; with joint ones, the encoders' inputs.
        """
        packed = pack(triplets, self.config)
        encoded = self._encode({**packed, "target": targets_of(triplets)})
        arrays = {**_kept(packed, self.config), **encoded}
        if any(triplet.tokens is not None for triplet in triplets):
            arrays["image"] = packed["image"]
        arrays = {name: np.asarray(array) for name, array in arrays.items()}
        return [{name: a[i] for name, a in arrays.items()} for i in range(len(triplets))]


def _encode(
    encoders: Networks, batch: Batch, *, posterior: str | None = None
) -> dict[str, jax.Array]:
    """Encode the videos of a batch, and its prompts and first frames if their encoders are frozen.

    With the posterior `sampled` the arrays include standard deviations, so training can draw.
    """
    # One video after the other (`lax.map`): the VAE is compiled once and needs little memory.
    videos = [name for name in ("target", "prior", "hands") if name in batch]
    stacked = jnp.stack([jnp.asarray(batch[name]) for name in videos])
    if posterior is None:
        latents = jax.lax.map(lambda video: encoders.vae.encode(to_model(video)), stacked)
        arrays = dict(zip(videos, latents, strict=True))
    else:
        codec: Any = encoders.vae
        means, stds = jax.lax.map(lambda video: moments_of(codec, to_model(video)), stacked)
        arrays = dict(zip(videos, means, strict=True))
        arrays |= dict(zip((f"{name}{STD}" for name in videos), stds, strict=True))
    if encoders.text is not None:
        arrays["text"] = encoders.text(batch["ids"], batch["ids_mask"])
        if "null_ids" in batch:
            arrays["null_text"] = encoders.text(batch["null_ids"], batch["null_mask"])
    if encoders.image is not None and "pixels" in batch:
        arrays["image"] = encoders.image(batch["pixels"])
    return arrays


def _kept(batch: Batch, config: ModelConfig) -> dict[str, Any]:
    """Return the arrays of a batch that go unchanged into the records."""
    names = ["mask"]
    if config.encoders == "joint":
        names += ["ids", "ids_mask", "null_ids", "null_mask", "pixels"]
    return {name: batch[name] for name in names if name in batch}


def example_shapes(config: ModelConfig, batch: int) -> dict[str, jax.ShapeDtypeStruct]:
    """Return the shapes of a batch of latents records of a model."""
    packed, video = batch_shapes(batch, config), config.video
    target = jax.ShapeDtypeStruct((batch, video.frames, video.height, video.width, 3), np.uint8)
    graph, params = nnx.split(Networks.abstract(config, only=config.cached_networks))
    encoded = jax.eval_shape(
        lambda params, arrays: _encode(
            nnx.merge(graph, params), arrays, posterior=config.posterior
        ),
        params,
        {**packed, "target": target},
    )
    return {**_kept(packed, config), **encoded}


def mask_of(config: ModelConfig) -> dict[str, Any]:
    """Return packing and number of channels of a model's mask, in the words of a manifest."""
    return {"packing": config.layout.mask_packing, "channels": config.layout.count("mask")}


def encode_shards(
    config: ModelConfig,
    folder: Path,
    *,
    source: ShardReader,
    out: Path,
    stride: int,
    batch_size: int,
    mesh: Mesh | None = None,
    shard_windows: int = 64,
    decoding: Decoding = "accurate",
    process_index: int | None = None,
    process_count: int | None = None,
    verb: str = "encoding",
) -> list[int]:
    """Write the latents shards of all windows of `source`, resuming an interrupted run.

    Returns the record numbers of the skipped clips, which are unreadable.

    Reads the networks `config.cached_networks` of the weights in `folder`. Splits each batch over
    `mesh`, which has only devices of this process. All processes call this with the same arguments
    and share `out`, which is complete when they return. The manifest records `decoding`; packed
    frames already have one. Raises `InputError` if `out` was started with another config, source,
    stride, number of windows per shard or other encoders, or if more clips are unreadable than a
    training tolerates.
    """
    check_counts({"--stride": stride, "--batch-size": batch_size, "--shard-windows": shard_windows})
    if mesh is not None:
        check_batch(batch_size, mesh)
    index = jax.process_index() if process_index is None else process_index
    count = jax.process_count() if process_count is None else process_count
    if source.manifest.kind == "frames":
        decoding = _packed_decoding(source, decoding)
        if (fps := source.manifest.fps) is not None:
            check_rates(Fraction(fps), config.video.fps, source=str(source.folder))
    provenance = {
        "config": config.name,
        "source": source.manifest.fingerprint,
        "encoders": hashes(folder, only=config.cached_networks),
        "decoding": decoding,
        "mask": mask_of(config),
    }
    if config.layout.mask_packing == "observed":
        check_static(source.manifest, source=str(source.folder))
    _open(
        out, {**provenance, "video": config.video, "stride": stride, "shard_windows": shard_windows}
    )
    if (out / MANIFEST).exists():
        shutil.rmtree(out / "parts", ignore_errors=True)
        return read_manifest(out).provenance.get("skipped", [])
    todo = list(batches(windows(source, frames=config.video.frames, stride=stride), shard_windows))
    if len(todo) > MAX_PARTS:
        raise InputError(
            f"{len(todo)} shards of {shard_windows} windows are too many: the maximum is "
            f"{MAX_PARTS}. (--shard-windows, --stride)"
        )
    parts = [out / "parts" / f"{number:05d}" for number in range(len(todo))]
    missing = {
        parts[number]: todo[number]
        for number in range(index, len(todo), count)
        if not PartWindows.read(parts[number]).is_done(parts[number], todo[number])
    }
    if missing:
        networks = Networks.load(config, folder, only=config.cached_networks, mesh=mesh)
        encode = Encoding(config, networks, mesh)
        progress = _write(encode, missing, source, batch_size, provenance, decoding)
        for _ in track(progress, verb, total=sum(map(len, missing.values()))):
            leave_if_preempted(out)
    _wait_for_all("encoded")
    lists = {part: PartWindows.read(part) for part in parts}
    skipped = sorted({number for listed in lists.values() for number, _ in listed.skipped})
    written = [part for part, listed in lists.items() if not listed.is_empty]
    _check_skipped(skipped, source, none_left=not written)
    _wait_for_all("counted")
    if index == 0:
        gather(written, out, provenance={"skipped": skipped} if skipped else {})
        shutil.rmtree(out / "parts")
    _wait_for_all("gathered")
    return skipped


def _check_skipped(skipped: Collection[int], source: ShardReader, *, none_left: bool) -> None:
    if none_left or len(skipped) > Loader.MAX_BAD:
        raise InputError(
            f"{len(skipped)} of {len(source)} clips of {source.folder} cannot be read: at most "
            f"{Loader.MAX_BAD}, and not all, may be damaged. Pack them again. (--shards)"
        )


def _packed_decoding(source: ShardReader, decoding: Decoding) -> Decoding:
    packed = source.manifest.provenance.get("decoding", "accurate")
    if decoding not in ("accurate", packed):
        raise InputError(
            f"{source.folder} holds frames decoded as {quote(packed)}, not {decoding}. Pack the "
            "clips again. (--decoding)"
        )
    return packed


def _open(out: Path, settings: Mapping[str, Any]) -> None:
    if (out / MANIFEST).exists() and not (out / "config.json").exists():
        raise InputError(f"{out} already holds other shards. (--out)")
    open_folder(out, settings)


def _wait_for_all(event: str) -> None:
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(f"encode {event}")


def _write(
    encode: Encoding,
    parts: Mapping[Path, Sequence[Window]],
    source: ShardReader,
    batch_size: int,
    provenance: Mapping[str, Any],
    decoding: Decoding,
) -> Iterator[Window]:
    """Write part after part; yield each window when it is encoded or skipped."""
    jobs = [(part, batch) for part, todo in parts.items() for batch in batches(todo, batch_size)]
    damaged: set[int] = set()
    for part, group in groupby(
        read_windows(source, jobs, encode.config, decoding), key=itemgetter(0)
    ):
        skipped: list[Window] = []
        shutil.rmtree(part, ignore_errors=True)  # it had other windows
        with ExitStack() as stack:
            writer: ShardWriter | None = None
            for _, read in group:
                for bad in (each for each in read if isinstance(each, Damaged)):
                    skipped.append(bad.window)
                    if bad.window[0] not in damaged:
                        logger.warning("skipping %s", printable(bad.message))
                    damaged.add(bad.window[0])
                    _check_skipped(damaged, source, none_left=False)
                    yield bad.window
                clips = [each for each in read if not isinstance(each, Damaged)]
                if not clips:
                    continue
                writer = writer or stack.enter_context(
                    ShardWriter(
                        part,
                        kind="latents",
                        spec=encode.config.video,
                        grid=encode.config.grid,
                        provenance=provenance,
                        shard_bytes=2**62,
                    )
                )
                # Fill the batch up to its size: another shape would compile again.
                fill = [clips[-1]] * (batch_size - len(clips))
                examples = encode([triplet for _, _, triplet in (*clips, *fill)])
                for (window, metadata, _), arrays in zip(clips, examples, strict=False):
                    writer.add(arrays, {**metadata, "start": window[1]})
                    yield window
            PartWindows(parts[part], skipped).write(part)


def check_encoders(shards: Path, config: ModelConfig, weights: Path | None) -> None:
    """Raise `InputError` unless latents shards were encoded for a model with the given weights.

    Compares config, video and mask packing with the manifest in `shards`, and the hashes of the
    encoders with the weights folder, which must have the VAE. Without a folder, hashes are not
    compared. Checks every part of a mixture.
    """
    if (shards / MIXTURE).is_file():
        for part in read_mixture(shards):
            check_encoders(part, config, weights)
        return
    manifest = read_manifest(shards)
    encoders = manifest.provenance.get("encoders")
    if manifest.kind != "latents" or not isinstance(encoders, Mapping) or "vae" not in encoders:
        raise InputError(
            f"{shards} holds {manifest.kind} without the hashes of their encoders. Encode again. "
            "(egosim data encode)"
        )
    problems = [
        f"{name}: the shards have {found}, this training has {expected}"
        for name, found, expected in (
            ("config", manifest.provenance.get("config"), config.name),
            ("video", manifest.spec, config.video),
        )
        if found != expected
    ]
    mask = manifest.provenance.get("mask", "no record of it")
    if "mask" in config.layout and mask != mask_of(config):
        problems.append(f"mask: the shards have {mask}, this training has {mask_of(config)}")
    if config.posterior is not None and f"target{STD}" not in manifest.arrays:
        problems.append("deviations of the latents: the shards have none, this training draws")
    if weights is not None:
        ours = {"vae": "none", **hashes(weights, only=encoders)}
        problems += [
            f"{name}: the shards have {str(encoders[name])[:16]}, {weights} has {ours[name][:16]}"
            for name in sorted(encoders.keys() & ours.keys())
            if encoders[name] != ours[name]
        ]
    if problems:
        raise InputError(
            f"{shards} was not encoded for this training: {listing(problems)}. Encode again with "
            "these weights (egosim data encode), or use the weights that encoded it. "
            "(--weights)"
        )
