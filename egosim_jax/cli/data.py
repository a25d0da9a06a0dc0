"""`egosim data`: import and annotate recordings; make, encode and inspect shards."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro

from egosim_jax.cli.annotate import Annotate
from egosim_jax.cli.export import Export
from egosim_jax.cli.imports import Import
from egosim_jax.cli.triplets import Align, Mix, Static, ToDwm
from egosim_jax.data.clip_files import ClipFiles, Prompts
from egosim_jax.runtime.command import ExitCode, Writes, group
from egosim_jax.runtime.progress import track
from egosim_jax.runtime.terminal import make_console, print_line, printable
from egosim_jax.types import WAN_GRID, InputError, VideoGrid, VideoSpec, check_counts


def _grid(name: str | None) -> VideoGrid:
    """Return the latent grid of a model; Wan's if `name` is None."""
    if name is None:
        return WAN_GRID
    from egosim_jax import configs

    return configs.get(name).grid


@dataclass(frozen=True, kw_only=True)
class Pack:
    """Pack the clips of a metadata file into shards.

    Stores the source files of each clip, or decoded frames if a size is given. A clip that fails
    the strict checks is reported and skipped (exit code 3). Prints the folder.
    """

    metadata: Path
    """CSV or JSONL with EgoSim's columns, or a DWM list (.txt).

    The columns: video, ego_prior_video, hand_keypoint_video, first_frame, prompt and video_id."""
    out: Path
    """Folder of the shards."""
    where: str | None = None
    """Select rows by the value of a column, for instance split=test."""
    limit: int | None = None
    """Maximum number of clips."""
    prompts: Prompts = "prompts_rewrite"
    """Captions to read from a DWM list.

    prompts_rewrite: rewritten captions, as in the released models, or the original caption where
    there is no rewritten one; prompts: original captions, as in the paper's evaluation."""
    size: tuple[int, int] | None = None
    """Height and width of decoded frames, stored instead of the source files.

    Use it for small models, whose training step is shorter than decoding."""
    num_frames: int = 61
    """With --size, number of frames to store of each clip."""
    resampling: Literal["first", "stride", "linspace", "rate", "step"] = "first"
    """With --size, frames to take.

    first: the first frames, without gaps; stride: at the largest even spacing, as DWM's loader;
    linspace: from the first to the last, as DWM's encoder; rate: the nearest in time at the model's
    rate; step: every n-th, with the clip's rate over the model's rounded down, as DWM's evaluation.
    The first frames must have the model's rate."""
    fps: int | None = None
    """Frame rate of the model; by default the one of --config.

    Without both, 8 with --resampling rate or step, and else any."""
    shard_megabytes: int = 256
    """Maximum size of a shard file in MiB."""
    overwrite: bool = False
    """Replace the shards in the folder."""
    decoding: Literal["accurate", "official"] = "accurate"
    """With --size, color decoding; official: as in EgoSim's loader, one gray level darker."""
    config: str | None = None
    """Name of a model whose latent grid the clips must fit; by default Wan's."""

    def run(self) -> int:
        """Check and pack each clip."""
        from egosim_jax import configs
        from egosim_jax.data.metadata import read_metadata, select
        from egosim_jax.data.pack import pack
        from egosim_jax.io.digest import sha256

        check_counts({"--shard-megabytes": self.shard_megabytes, "--fps": self.fps})
        clips = read_metadata(self.metadata, prompts=self.prompts)
        items = select(clips, where=self.where, limit=self.limit)
        fps = self.fps or (None if self.config is None else configs.get(self.config).video.fps)
        spec = self._spec(fps, items[0])
        progress = pack(
            items,
            out=self.out,
            spec=spec,
            provenance={"metadata": self.metadata.name, "sha256": sha256(self.metadata)},
            shard_bytes=self.shard_megabytes * 2**20,
            overwrite=self.overwrite,
            decoding=self.decoding,
            grid=_grid(self.config),
            resampling=self.resampling,
            fps=fps,
        )
        skipped = 0
        for problem in filter(None, track(progress, "packing", total=len(items))):
            # at once: if all are skipped, `pack` raises
            print(printable(f"skipped: {problem}"), file=sys.stderr)
            skipped += 1
        print_line(self.out)
        return ExitCode.PARTIAL if skipped else ExitCode.DONE

    def _spec(self, fps: int | None, first: ClipFiles) -> VideoSpec | None:
        """Return length, size and rate of frames to store; None for source files."""
        if self.size is None:
            self._refuse("num_frames", without="--size")
            self._refuse("decoding", without="--size")
            return None
        if self.resampling in ("stride", "linspace"):  # which do not look at rates
            self._refuse("fps", without="--resampling first, rate or step")
        from egosim_jax.io.video import probe_video

        if fps is None and self.resampling == "first":  # all clips have the rate of the first one
            fps = round(probe_video(first.target or first.prior).fps) or 1
        fps = 8 if fps is None else fps
        spec = VideoSpec(frames=self.num_frames, height=self.size[0], width=self.size[1], fps=fps)
        _grid(self.config).check(spec)
        return spec

    def _refuse(self, name: str, *, without: str) -> None:
        """Raise `InputError` if an option without effect is not at its default."""
        if (value := getattr(self, name)) != getattr(Pack, name):
            raise InputError(
                f"--{name.replace('_', '-')} {value} has no effect without {without}: give it, or "
                "omit this option."
            )


@dataclass(frozen=True, kw_only=True)
class Encode:
    """Encode shards of clips once, so that training reads latents and embeddings.

    Every window of a clip becomes a record. An unreadable clip is reported and skipped (exit code
    3). The same command resumes an interrupted run. Several processes, each with its own devices,
    can share the work if they have the same OUT. Start them by Slurm or Open MPI, or set
    JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID for each. Prints the folder.
    """

    config: str
    """Name of the model."""
    weights: Path
    """Folder of weights with the autoencoder and the frozen encoders."""
    shards: Path
    """Folder of shards of videos or frames, with targets."""
    out: Path
    """Folder of the latents shards."""
    stride: int | None = None
    """Frames between the windows of a clip; by default a window's frames, without overlap."""
    batch_size: int | None = None
    """Windows per batch of a process: a multiple of its devices; by default one per device."""
    shard_windows: int = 64
    """Windows per shard file, preferably a multiple of the batch size.

    An interruption loses at most one shard."""
    decoding: Literal["accurate", "official"] = "accurate"
    """Color decoding of videos; official: as in EgoSim's loader, one gray level darker."""

    def run(self) -> int:
        """Encode all shards."""
        import jax

        from egosim_jax import configs
        from egosim_jax.data.shards import ShardReader
        from egosim_jax.io.executables import share_with_jax
        from egosim_jax.sharding import make_mesh
        from egosim_jax.train.distributed import launched_context
        from egosim_jax.train.encode import encode_shards
        from egosim_jax.types import MeshConfig

        share_with_jax()
        config = configs.get(self.config).at(self.weights)
        source = ShardReader(self.shards)
        with launched_context():
            mesh = make_mesh(MeshConfig(data=-1, fsdp=1), jax.local_devices())
            skipped = encode_shards(
                config,
                self.weights,
                source=source,
                out=self.out,
                stride=config.video.frames if self.stride is None else self.stride,
                batch_size=mesh.size if self.batch_size is None else self.batch_size,
                mesh=mesh,
                shard_windows=self.shard_windows,
                decoding=self.decoding,
            )
        for number in skipped:
            print(printable(f"skipped: {source.name(number)}"), file=sys.stderr)
        print_line(self.out)
        return ExitCode.PARTIAL if skipped else ExitCode.DONE


@dataclass(frozen=True, kw_only=True)
class Make:
    """Make shards of clips from a procedural world, in parallel. Prints the folder.

    The same command resumes an interrupted run.
    """

    world: Annotated[Literal["tabletop"], tyro.conf.Positional]
    """Name of the world."""
    out: Path
    """Folder of the shards."""
    scenes: int = 8
    """Number of scenes; their seeds are consecutive."""
    clips: int = 1
    """Number of consecutive clips per scene."""
    seed: int = 0
    """Seed of the first scene."""
    kind: Literal["human", "robot", "mixed"] = "human"
    """Human hands or a robot gripper; mixed: a gripper if the seed is a multiple of four."""
    frames: int = 17
    """Number of frames in a clip, 4k + 1."""
    height: int = 96
    """Height in pixels, a multiple of 16."""
    width: int = 160
    """Width in pixels, a multiple of 16."""
    fps: int = 8
    """Frames per second of the clips."""
    black_cloths: int = 0
    """Maximum number of black cloths on a table, which look like holes in the prior."""
    attempts: float = 0.0
    """Fraction of scenes with a policy that may fail and head turns, not a script."""
    point_px: int = 1
    """Side of the points of a rendered prior in pixels; must be the model's."""
    fixed_camera: bool = False
    """Keep the camera at its first pose."""
    prior: Literal["state", "predicted", "static"] | None = None
    """Rendering of the scene along the camera path; by default as for the model of --config.

    state: the points of the scene state, with holes, as in EgoSim; predicted: the same, with the
    objects on the paths that the hands predict; static: the exact scene of the first frame, as in
    DWM."""
    hands: Literal["skeleton", "mesh", "mask"] = "skeleton"
    """Rendering of the hands: skeletons (EgoSim), shaded meshes (DWM), or their binary mask."""
    workers: int = os.cpu_count() or 1
    """Number of worker processes."""
    config: str | None = None
    """Name of a model whose latent grid the clips must fit; by default Wan's."""

    def run(self) -> int:
        """Make all scenes."""
        from egosim_jax import configs
        from egosim_jax.worlds.tabletop.dataset import DatasetConfig, conditions_of, make_shards

        check_counts({"--workers": self.workers})
        prior = "state" if self.config is None else conditions_of(configs.get(self.config))[0]
        spec = VideoSpec(frames=self.frames, height=self.height, width=self.width, fps=self.fps)
        config = DatasetConfig(
            seeds=tuple(range(self.seed, self.seed + self.scenes)),
            clips=self.clips,
            spec=spec,
            kind=self.kind,
            black_cloths=self.black_cloths,
            attempts=self.attempts,
            prior=self.prior or prior,
            hands=self.hands,
            point_px=self.point_px,
            fixed_camera=self.fixed_camera,
        )
        progress = make_shards(config, out=self.out, workers=self.workers, grid=_grid(self.config))
        for _ in track(progress, "making", total=self.scenes):
            pass
        print_line(self.out)
        return ExitCode.DONE


@dataclass(frozen=True, kw_only=True)
class Check:
    """Verify shards: hashes, counts, shapes and every video.

    Prints one line per problem. Exit code 3 if there are problems.
    """

    shards: Path
    """Folder of the shards."""

    def run(self) -> int:
        """Check all shards."""
        from egosim_jax.data.check import check
        from egosim_jax.data.manifest import read_manifest

        manifest = read_manifest(self.shards)
        count = 0
        for _, problems in track(check(self.shards), "checking", total=len(manifest.shards)):
            for problem in problems:
                print(printable(problem))
            count += len(problems)
        summary = f"{manifest.records} records in {len(manifest.shards)} shards"
        print(f"{summary}: {count or 'no'} problems", file=sys.stderr)
        return ExitCode.PARTIAL if count else ExitCode.DONE


@dataclass(frozen=True, kw_only=True)
class Look:
    """Draw a contact sheet of shards of videos or frames. Prints its path."""

    writes: ClassVar[Writes] = "file"
    shards: Path
    """Folder of the shards."""
    out: Path
    """Image to write, .png or .jpg."""
    by: Annotated[tuple[str, ...], tyro.conf.arg(metavar="COLUMN [COLUMN ...]")] = ()
    """Columns such as verb: draw the first clip of each combination of their values."""
    limit: int = 12
    """Maximum number of clips."""
    streams: tuple[Literal["target", "prior", "hands"], ...] = ("target", "prior", "hands")
    """Videos of each clip, from top to bottom."""
    moments: int = 6
    """Number of frames to draw per clip."""
    width: int = 240
    """Width of a frame in pixels."""

    def run(self) -> int:
        """Draw the contact sheet of the chosen clips."""
        from egosim_jax.data.inspect import choose_clips
        from egosim_jax.data.shards import ShardReader
        from egosim_jax.data.sheet import draw_sheet

        check_counts({"--limit": self.limit, "--moments": self.moments, "--width": self.width})
        clips = choose_clips(
            ShardReader(self.shards),
            by=self.by,
            streams=self.streams,
            limit=self.limit,
            moments=self.moments,
        )
        draw_sheet(clips, self.out, moments=range(self.moments), width=self.width)
        print_line(self.out)
        return ExitCode.DONE


@dataclass(frozen=True, kw_only=True)
class Stats:
    """Describe shards: kind, arrays, sizes, frames, prompts and splits."""

    shards: Path
    """Folder of the shards."""

    def run(self) -> int:
        """Read all records and print two tables."""
        from rich.table import Table

        from egosim_jax.data.inspect import split_statistics
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
        splits = Table("split", "records", "frames", "words per prompt")
        for name, split in split_statistics(reader).items():
            frames = ", ".join(f"{n} ({count})" for n, count in sorted(split.lengths.items()))
            words = f"{split.words / split.records:.1f}"
            splits.add_row(name, str(split.records), frames, words)
        console = make_console()
        console.print(table)
        console.print(splits)
        return ExitCode.DONE


Data = group(
    "Data",
    "Prepare data: import and annotate recordings, make procedural clips, pack shards.",
    {
        "annotate": Annotate,
        "import": Import,
        "export": Export,
        "make": Make,
        "pack": Pack,
        "encode": Encode,
        "look": Look,
        "check": Check,
        "stats": Stats,
        "static": Static,
        "align": Align,
        "mix": Mix,
        "to-dwm": ToDwm,
    },
)
