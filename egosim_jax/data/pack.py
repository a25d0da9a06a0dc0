"""Pack clips into records: their source files, or frames decoded at a model's size."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.data.clip_files import ClipFiles
from egosim_jax.data.clips import check_clip, encoded_first_frame, load_triplet, videos_of
from egosim_jax.data.metadata import check_presence
from egosim_jax.data.records import Record
from egosim_jax.data.shards import ShardReader, ShardWriter
from egosim_jax.data.transforms import Resampling, decode_record, video_shape
from egosim_jax.io.atomic import lock_folder
from egosim_jax.io.bounded import listing, read_bytes
from egosim_jax.io.decoding import Decoding
from egosim_jax.io.video import probe_video
from egosim_jax.types import WAN_GRID, InputError, Triplet, VideoGrid, VideoSpec

MAX_FILE_BYTES = 1 << 28
"""Maximum size of a packed source file, in bytes."""


def pack(
    items: Sequence[ClipFiles],
    *,
    out: Path,
    spec: VideoSpec | None,
    provenance: Mapping[str, Any],
    shard_bytes: int = 256 * 2**20,
    overwrite: bool = False,
    decoding: Decoding = "accurate",
    grid: VideoGrid = WAN_GRID,
    resampling: Resampling = "first",
    fps: int | None = None,
) -> Iterator[str | None]:
    """Write clips as shards: frames decoded at `spec`, or source files if that is None.

    Clips must fit the latent `grid`, and have the rate `fps`, if it is given, or the one of `spec`,
    unless `resampling` chooses other frames than the first ones. After each
    clip, yields why it was skipped, or None. Raises `InputError` if all clips were skipped, or if
    another process writes to the same folder.
    """
    failed = 0
    check_presence(items)
    if spec is None and resampling != "first":
        raise InputError(
            f"Source files are packed as they are: frames taken by the rule {resampling} need a "
            "size. (--size, --resampling)"
        )
    decoded = {} if spec is None else {"decoding": decoding, "resampling": resampling}
    shards = ShardWriter(
        out,
        kind="frames" if spec else "videos",
        spec=spec,
        grid=grid,
        provenance={**provenance, **decoded},
        shard_bytes=shard_bytes,
        overwrite=overwrite,
    )
    with lock_folder(out), shards as writer:
        for files in items:
            problem = None
            try:
                if spec:
                    record = triplet_record(
                        load_triplet(
                            files, spec, decoding=decoding, grid=grid, resampling=resampling
                        )
                    )
                else:
                    record = encoded_record(files, grid, fps)
                writer.add(record.arrays, record.metadata)
            except InputError as error:
                failed, problem = failed + 1, str(error)
            yield problem
        if failed == len(items):
            raise InputError(f"None of the {failed} clips could be packed.")


def clip_metadata(clip: ClipFiles | Triplet) -> dict[str, object]:
    """Return the metadata of a clip's record."""
    return {"video_id": clip.video_id, "prompt": clip.prompt, "extra": dict(clip.extra)}


def encoded_record(files: ClipFiles, grid: VideoGrid = WAN_GRID, fps: int | None = None) -> Record:
    """Return a record with the bytes of a clip's files, after the strict checks.

    Raises `InputError` listing what `check_clip` finds.
    """
    problems = check_clip(files, None, grid=grid, fps=fps)
    if problems:
        raise InputError(listing(problems))
    arrays = {
        name: np.frombuffer(read_bytes(path, limit=MAX_FILE_BYTES), np.uint8)
        for name, path in videos_of(files).items()
    }
    arrays["first_frame"] = np.frombuffer(encoded_first_frame(files.first_frame), np.uint8)
    return Record(arrays=arrays, metadata=clip_metadata(files))


def triplet_record(triplet: Triplet) -> Record:
    """Return a record with the frames and metadata of a triplet."""
    arrays = {
        "prior": triplet.prior,
        "hands": triplet.hands,
        "mask": triplet.mask,
        "first_frame": triplet.first_frame,
    }
    if triplet.target is not None:
        arrays["target"] = triplet.target
    return Record(arrays=arrays, metadata=clip_metadata(triplet))


def read_triplets(source: ShardReader) -> Iterator[Triplet]:
    """Yield the clips in shards of frames or videos, at their own length and size.

    Raises `InputError` for shards of latents or without targets.
    """
    _check_targets(source)
    for number, record in enumerate(source):
        try:
            frames, height, width = video_shape(record.arrays)
            spec = VideoSpec(frames=frames, height=height, width=width)
            arrays: dict[str, Any] = decode_record(record.arrays, spec)
        except InputError as error:
            raise InputError(f"{source.name(number)}: {error}") from error
        names = {name: str(record.metadata.get(name, "")) for name in ("video_id", "prompt")}
        yield Triplet(**names, **arrays, extra=record.metadata.get("extra", {}))


def frame_rates(source: ShardReader, count: int) -> set[Fraction]:
    """Return the frame rates of the first `count` clips in shards; empty if they are unknown.

    Shards of frames know the rate only if the rules `first` or `rate` took the frames. Raises
    `InputError` as `read_triplets` does.
    """
    _check_targets(source)
    manifest = source.manifest
    if manifest.spec is None:
        return {
            probe_video(
                source[number].arrays["target"].tobytes(), name=f"{source.name(number)}: target"
            ).fps
            for number in range(count)
        }
    return set() if manifest.fps is None else {Fraction(manifest.fps)}


def _check_targets(source: ShardReader) -> None:
    """Raise `InputError` for shards of latents or without targets."""
    manifest = source.manifest
    if manifest.kind == "latents" or "target" not in manifest.arrays:
        raise InputError(
            f"{source.folder} holds {manifest.kind} of {', '.join(manifest.arrays)}: it must be "
            "videos or frames with their target. (--shards)"
        )
