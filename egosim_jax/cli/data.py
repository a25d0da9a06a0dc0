"""`egosim data`: pack clips into shards, verify them, describe them."""

from __future__ import annotations

import contextlib
import os
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from egosim_jax.command import DONE, PARTIAL
from egosim_jax.progress import track
from egosim_jax.types import InputError, MeshConfig, VideoSpec, check_counts

if TYPE_CHECKING:
    from egosim_jax.data.shards import ShardReader


@dataclass(frozen=True, kw_only=True)
class Pack:
    """Pack the clips of a metadata file into shards.

    Stores each clip's own files, unchanged, or decoded frames if a size is given. A clip that
    fails the strict checks is reported and left out (exit code 3). Prints the folder.
    """

    metadata: Path
    """CSV or JSONL in EgoSim's columns: video, ego_prior_video, hand_keypoint_video, first_frame,
    prompt, video_id."""
    out: Path
    """Folder of the shards."""
    where: str | None = None
    """Take rows whose column has this value, for instance split=test."""
    limit: int | None = None
    """Take at most so many clips."""
    size: tuple[int, int] | None = None
    """Height and width: store decoded frames of this size, for small models, whose training step
    is shorter than decoding would be."""
    num_frames: int = 61
    """With a size: frames to store of each clip, from its first on."""
    shard_megabytes: int = 256
    """Largest size of a shard file."""
    overwrite: bool = False
    """Replace the shards that the folder holds."""
    decoding: Literal["accurate", "official"] = "accurate"
    """With a size: how colors are decoded; official: as in EgoSim's loader, a gray level darker."""

    def run(self) -> int:
        """Check and pack clip after clip."""
        from egosim_jax.data.metadata import read_metadata, select
        from egosim_jax.data.pack import pack
        from egosim_jax.io.digest import sha256

        check_counts({"--shard-megabytes": self.shard_megabytes})
        items = select(read_metadata(self.metadata), where=self.where, limit=self.limit)
        progress = pack(
            items,
            out=self.out,
            spec=self._spec(),
            provenance={"metadata": self.metadata.name, "sha256": sha256(self.metadata)},
            shard_bytes=self.shard_megabytes * 2**20,
            overwrite=self.overwrite,
            decoding=self.decoding,
        )
        problems = [problem for problem in track(progress, "packing", total=len(items)) if problem]
        for problem in problems:
            print(f"left out: {problem}", file=sys.stderr)
        print(self.out)
        return PARTIAL if problems else DONE

    def _spec(self) -> VideoSpec | None:
        if self.size is None:
            return None
        return VideoSpec(frames=self.num_frames, height=self.size[0], width=self.size[1])


@dataclass(frozen=True, kw_only=True)
class Encode:
    """Encode shards of clips once, so that training reads latents and embeddings.

    Every window of a clip becomes a record. The same command goes on where an interrupted one
    stopped. Several processes share the work, each with its own devices and all with one OUT: start
    them with Slurm or Open MPI, or give each JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and
    JAX_PROCESS_ID. Prints the folder.
    """

    config: str
    """Name of the model."""
    weights: Path
    """Folder of weights, of which the autoencoder and frozen encoders are used."""
    shards: Path
    """Folder of shards of videos or frames, with their truth."""
    out: Path
    """Folder of the latents shards."""
    stride: int = 1
    """Frames between the windows of a clip."""
    batch_size: int | None = None
    """Windows that a process encodes together: a multiple of its number of devices, which is what
    is taken if none is given."""
    shard_windows: int = 64
    """Windows in a shard file: what an interrupted run loses at most. Best a multiple of the batch
    size."""
    decoding: Literal["accurate", "official"] = "accurate"
    """How the colors of videos are decoded; official: as in EgoSim's loader, a gray level darker.
    The manifest says which."""

    def run(self) -> int:
        """Encode shard after shard."""
        from egosim_jax.train.distributed import NAMES, distributed_context

        counts = ("SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE")
        tasks = [os.environ.get(name, "1") for name in counts]
        several = os.environ.keys() & {*NAMES} or any(number != "1" for number in tasks)
        with distributed_context() if several else contextlib.nullcontext():
            self._encode()
        print(self.out)
        return DONE

    def _encode(self) -> None:
        import jax

        from egosim_jax import configs
        from egosim_jax.data.shards import ShardReader
        from egosim_jax.sharding import make_mesh
        from egosim_jax.train.encode import encode_shards

        mesh = make_mesh(MeshConfig(data=-1, fsdp=1), jax.local_devices())
        encode_shards(
            configs.get(self.config).at(self.weights),
            self.weights,
            source=ShardReader(self.shards),
            out=self.out,
            stride=self.stride,
            batch_size=mesh.size if self.batch_size is None else self.batch_size,
            mesh=mesh,
            shard_windows=self.shard_windows,
            decoding=self.decoding,
        )


@dataclass(frozen=True, kw_only=True)
class Make:
    """Make shards of clips of a procedural world, in parallel. Prints the folder.

    The same command goes on where an interrupted one stopped.
    """

    world: Annotated[Literal["tabletop"], tyro.conf.Positional]
    """Which world."""
    out: Path
    """Folder of the shards."""
    scenes: int = 8
    """How many scenes, of consecutive seeds."""
    clips: int = 1
    """Clips in a row in each scene, each from where the last one ended."""
    seed: int = 0
    """Seed of the first scene."""
    kind: Literal["human", "robot", "mixed"] = "human"
    """Whose hands; mixed: a robot's in the scenes whose seed is a multiple of four."""
    frames: int = 17
    """Frames of a clip, 4k+1."""
    height: int = 96
    """Rows in pixels, a multiple of 16."""
    width: int = 160
    """Columns in pixels, a multiple of 16."""
    fps: int = 8
    """Frames per second."""
    workers: int = os.cpu_count() or 1
    """Processes."""

    def run(self) -> int:
        """Make scene after scene."""
        from egosim_jax.worlds.tabletop.dataset import DatasetConfig, make_shards

        check_counts({"--workers": self.workers})
        plan = DatasetConfig(
            seeds=tuple(range(self.seed, self.seed + self.scenes)),
            clips=self.clips,
            spec=VideoSpec(frames=self.frames, height=self.height, width=self.width, fps=self.fps),
            kind=self.kind,
        )
        progress = make_shards(plan, out=self.out, workers=self.workers)
        for _ in track(progress, "making", total=self.scenes):
            pass
        print(self.out)
        return DONE


@dataclass(frozen=True, kw_only=True)
class Check:
    """Verify shards: hashes, counts, shapes, every video.

    Prints one line a problem; exit code 3 if there is any.
    """

    shards: Path
    """Folder of the shards."""

    def run(self) -> int:
        """Check shard after shard."""
        from egosim_jax.data.check import check
        from egosim_jax.data.manifest import read_manifest

        manifest = read_manifest(self.shards)
        found = 0
        for _, problems in track(check(self.shards), "checking", total=len(manifest.shards)):
            for problem in problems:
                print(problem)
            found += len(problems)
        summary = f"{manifest.records} records in {len(manifest.shards)} shards"
        print(f"{summary}: {found or 'no'} problems", file=sys.stderr)
        return PARTIAL if found else DONE


@dataclass(frozen=True, kw_only=True)
class Look:
    """Draw a contact sheet of shards of videos or frames. Prints its path."""

    shards: Path
    """Folder of the shards."""
    out: Path
    """The picture to write, .png or .jpg."""
    by: Annotated[tuple[str, ...], tyro.conf.arg(metavar="COLUMN [COLUMN ...]")] = ()
    """Take the first clip of each combination of values of these columns, for instance verb."""
    limit: int = 12
    """Take at most so many clips."""
    streams: tuple[Literal["target", "prior", "hands"], ...] = ("target", "prior", "hands")
    """What is shown of each, from top to bottom."""
    moments: int = 6
    """Frames of each."""
    width: int = 240
    """Pixels of a picture's width."""

    def run(self) -> int:
        """Choose, decode, draw."""
        import numpy as np

        from egosim_jax.data.shards import ShardReader
        from egosim_jax.data.sheet import SheetClip, draw_sheet
        from egosim_jax.data.transforms import decode_record

        check_counts({"--limit": self.limit, "--moments": self.moments, "--width": self.width})
        reader = ShardReader(self.shards)
        if reader.manifest.kind == "latents":
            raise InputError(f"{self.shards} holds latents, not pictures. (--shards)")
        spec = reader.manifest.spec or VideoSpec()
        blocks: dict[object, SheetClip] = {}
        for number, record in enumerate(track(reader, "reading", total=len(reader))):
            extra = record.metadata.get("extra", {})
            unknown = [name for name in self.by if name not in extra]
            if unknown:
                known = ", ".join(sorted(extra)) or "none"
                raise InputError(f"The clips have no column {', '.join(unknown)}; known: {known}.")
            key = tuple(extra[name] for name in self.by) if self.by else number
            if key not in blocks:
                videos = decode_record(record.arrays, spec)
                shown = [videos[name] for name in self.streams if name in videos]
                blocks[key] = SheetClip(str(record.metadata.get("prompt", "")), shown)
            if len(blocks) == self.limit:
                break
        moments = np.linspace(0, spec.frames - 1, self.moments).round().astype(int).tolist()
        draw_sheet(
            [blocks[key] for key in sorted(blocks, key=str)],
            self.out,
            moments=moments,
            width=self.width,
        )
        print(self.out)
        return DONE


@dataclass(frozen=True, kw_only=True)
class Stats:
    """Describe shards: kind, arrays, sizes, frames, prompts and splits."""

    shards: Path
    """Folder of the shards."""

    def run(self) -> int:
        """Read every record and print two tables."""
        from rich.console import Console
        from rich.table import Table

        from egosim_jax.data.shards import ShardReader

        reader = ShardReader(self.shards)
        manifest = reader.manifest
        megabytes = sum(shard.size for shard in manifest.shards) / 2**20
        spec = manifest.spec
        table = Table(title=str(self.shards), show_header=False)
        table.add_row("kind", manifest.kind)
        table.add_row("records", f"{manifest.records} in {len(manifest.shards)} shards")
        table.add_row("size", f"{megabytes:.1f} MB")
        if spec is not None:
            table.add_row("video", f"{spec.frames} frames of {spec.width}x{spec.height}")
        for name, info in manifest.arrays.items():
            shape = " ".join("*" if axis is None else str(axis) for axis in info.shape)
            table.add_row(name, f"{info.dtype} [{shape}]")
        for name, value in manifest.provenance.items():
            table.add_row(name, str(value))
        console = Console()
        console.print(table)
        console.print(self._clips(reader))
        return DONE

    def _clips(self, reader: ShardReader) -> object:
        """A row for each split: records, their lengths, words of the prompts."""
        from rich.table import Table

        from egosim_jax.data.transforms import record_length

        records: Counter[str] = Counter()
        lengths: dict[str, Counter[int]] = {}
        words: Counter[str] = Counter()
        for record in track(reader, "reading", total=len(reader)):
            split = str(record.metadata.get("extra", {}).get("split", "all"))
            records[split] += 1
            lengths.setdefault(split, Counter())[record_length(record.arrays)] += 1
            words[split] += len(str(record.metadata.get("prompt", "")).split())
        table = Table("split", "records", "frames", "words a prompt")
        for split, count in sorted(records.items()):
            frames = ", ".join(
                f"{length} ({number})" for length, number in sorted(lengths[split].items())
            )
            table.add_row(split, str(count), frames, f"{words[split] / count:.1f}")
        return table


@dataclass(frozen=True, kw_only=True)
class Data:
    """Prepare data: clips of a procedural world, shards of videos, frames or latents."""

    command: (
        Annotated[Make, tyro.conf.subcommand("make")]
        | Annotated[Pack, tyro.conf.subcommand("pack")]
        | Annotated[Encode, tyro.conf.subcommand("encode")]
        | Annotated[Look, tyro.conf.subcommand("look")]
        | Annotated[Check, tyro.conf.subcommand("check")]
        | Annotated[Stats, tyro.conf.subcommand("stats")]
    )

    def run(self) -> int:
        """Run the chosen command."""
        return self.command.run()
