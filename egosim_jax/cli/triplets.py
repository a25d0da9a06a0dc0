"""`egosim data static`, `align`, `to-dwm` and `mix`: DWM's static-scene data."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from egosim_jax.runtime.command import ExitCode, Writes
from egosim_jax.runtime.progress import track
from egosim_jax.runtime.terminal import make_console, print_line, printable
from egosim_jax.types import InputError, check_counts

if TYPE_CHECKING:
    from egosim_jax.rendering.mesh import MovingMesh


@dataclass(frozen=True, kw_only=True)
class Static:
    """Make a DWM triplet: a static scene, hand meshes, and the recorded video if there is one.

    The scene is rendered along the action's cameras. For a fixed camera without --scene, it is the
    first frame of the recorded video, repeated. `data pack` reads the files. Other clips in the
    folder keep their rows in metadata.csv. Prints the path of metadata.csv.
    """

    action: Path
    """Cameras and hands, .npz or .json, as for `episode make`; left hand before right."""
    out: Path
    """Folder of the triplet and of metadata.csv."""
    video_id: str
    """Id of the triplet."""
    height: int
    """Height in pixels of the frames and the intrinsics."""
    width: int
    """Width in pixels of the frames and the intrinsics."""
    scene: Path | None = None
    """Folder of a state, or a .ply of colored points or triangles; omit it for a fixed camera."""
    video: Path | None = None
    """Recorded video, with the length and size of the action."""
    prompt: str | None = None
    """Caption, instead of the one in the file."""
    mano_poses: Path | None = None
    """MANO parameters of the hands, .npz: global_orient, hand_pose, translation_m, betas.

    MANO meshes replace the meshes made from the keypoints."""
    mano_right: Path | None = None
    """MANO_RIGHT.pkl from mano.is.tue.mpg.de; it is read without executing its code."""
    mano_left: Path | None = None
    """MANO_LEFT.pkl; by default left hands are mirrored right hands."""
    add_mean: bool = False
    """Add MANO's mean pose to the hand poses."""
    fps: int | None = None
    """Frames per second; by default the recorded video's, or 8 without a video."""

    def run(self) -> int:
        """Read the inputs, render and write the triplet."""
        from egosim_jax.data.clips import write_clips
        from egosim_jax.generation.export import repeated, static_of, static_triplet
        from egosim_jax.io.video import read_video
        from egosim_jax.simulation.actions import read_action

        check_counts({"--fps": self.fps})
        action = read_action(self.action, height=self.height, width=self.width, prompt=self.prompt)
        if self.video is None:
            target, fps = None, Fraction(self.fps or 8)
        else:
            video = read_video(self.video)
            target, fps = video.frames, _one_rate({video.fps}, self.fps, of="--video")
        if self.scene is not None:
            static = static_of(self.scene, action.cameras)
        elif target is not None:
            static = repeated(target, action.cameras)
        else:
            raise InputError(
                "There is no scene: give one, or give the video of a fixed camera, whose first "
                "frame is then repeated. (--scene, --video)"
            )
        triplet = static_triplet(
            action, static, video_id=self.video_id, meshes=self._meshes(), target=target
        )
        print_line(write_clips(self.out, [triplet], fps=fps, append=True))
        return ExitCode.DONE

    def _meshes(self) -> MovingMesh | None:
        from egosim_jax.rendering.mano import mano_hands, read_mano, read_poses

        given = (self.mano_poses, self.mano_right, self.mano_left)
        if given == (None, None, None) and not self.add_mean:
            return None
        if self.mano_poses is None or self.mano_right is None:
            raise InputError(
                "MANO hands need a model and poses: give both. (--mano-right, --mano-poses)"
            )
        left = None if self.mano_left is None else read_mano(self.mano_left)
        poses, right = read_poses(self.mano_poses), read_mano(self.mano_right)
        return mano_hands(right, poses, left=left, add_mean=self.add_mean)


@dataclass(frozen=True, kw_only=True)
class Align:
    """Compare priors with their recorded videos, and find the pixel shift between them.

    Prints the PSNR of each prior, which is the score of copying it, and the gain of the best shift
    by whole pixels. The gain compares PSNR with and without the shift, both without a margin of
    --most-px. Videos must agree in length and size. Exit code 3 if a clip is skipped.
    """

    writes: ClassVar[Writes] = "file"
    metadata: Path
    """CSV or JSONL with EgoSim's columns, including video; or a DWM list (.txt)."""
    where: str | None = None
    """Select rows by the value of a column, for instance split=test."""
    limit: int | None = None
    """Maximum number of clips."""
    most_px: int = 12
    """Maximum shift along each axis in pixels."""
    out: Path | None = None
    """File to write the results to, .json."""

    def run(self) -> int:
        """Align all clips and print their shifts."""
        import dataclasses
        import sys

        from rich.table import Column, Table

        from egosim_jax.data.metadata import read_metadata, select
        from egosim_jax.evaluation.metrics.alignment import align_clip
        from egosim_jax.io.run import write_json

        clips = select(read_metadata(self.metadata), where=self.where, limit=self.limit)
        table = Table(
            Column("clip", overflow="fold"),
            "right px",
            "down px",
            "PSNR dB",
            "inside",
            "aligned",
            "gain",
        )
        results = {}
        for files in track(clips, "aligning", total=len(clips)):
            try:
                result = align_clip(files.prior, files.target, most_px=self.most_px)
            except InputError as error:
                print(printable(f"skipped: {files.video_id}: {error}"), file=sys.stderr)
                continue
            results[files.video_id] = {**dataclasses.asdict(result), "gain": result.gain}
            levels = result.psnr_full, result.psnr_inside, result.psnr_aligned, result.gain
            table.add_row(
                files.video_id, *map(str, result.shift_px), *(f"{level:.2f}" for level in levels)
            )
        make_console().print(table)
        if self.out is not None:
            write_json(self.out, {"most_px": self.most_px, "clips": results})
        if not results:
            return ExitCode.USAGE
        return ExitCode.PARTIAL if len(results) < len(clips) else ExitCode.DONE


@dataclass(frozen=True, kw_only=True)
class ToDwm:
    """Write shards of frames or videos as DWM's folders and list. Prints the path of the list.

    The folders are videos, videos_static, videos_hands, prompts and prompts_rewrite in OUT/NAME.
    Every command reads them by `--metadata LIST`.
    """

    shards: Path
    """Folder of shards of frames or videos, with targets."""
    out: Path
    """Root of the folders."""
    name: str
    """Name of the dataset, its folder and its list."""
    fps: int | None = None
    """Frames per second; by default as recorded in the shards.

    Shards have no frame rate if `data pack` took frames by another --resampling than rate."""
    limit: int | None = None
    """Maximum number of clips."""

    def run(self) -> int:
        """Write all clips."""
        from itertools import islice

        from egosim_jax.data.dwm import write_folders
        from egosim_jax.data.pack import frame_rates, read_triplets
        from egosim_jax.data.shards import ShardReader

        check_counts({"--fps": self.fps, "--limit": self.limit})
        reader = ShardReader(self.shards)
        count = min(len(reader), self.limit or len(reader))
        fps = _one_rate(frame_rates(reader, count), self.fps, of="--shards")
        triplets = track(islice(read_triplets(reader), count), "writing", total=count)
        path = write_folders(self.out, triplets, name=self.name, fps=fps)
        print_line(path)
        return ExitCode.DONE


def _one_rate(rates_of_videos: Collection[Fraction], given: int | None, *, of: str) -> Fraction:
    """Return the one frame rate of all videos: from the input, or given by --fps.

    Raises `InputError` if there is no rate, or more than one. `of` is the option of the input.
    """
    rates = {*rates_of_videos} if given is None else {*rates_of_videos, Fraction(given)}
    if not rates:
        raise InputError(f"The clips have no frame rate: give it. (--fps, {of})")
    if len(rates_of_videos) > 1:
        raise InputError(
            f"The videos have {_listed(rates)} frames per second: all must have one rate. Pack "
            f"separate shards for each rate. ({of})"
        )
    if len(rates) > 1:
        raise InputError(
            f"The videos have {_listed(rates_of_videos)} frames per second, not {given}: their "
            f"frames must keep this rate. Omit --fps. (--fps, {of})"
        )
    return rates.pop()


def _listed(rates: Collection[Fraction]) -> str:
    return ", ".join(f"{float(rate):g}" for rate in sorted(rates))


@dataclass(frozen=True, kw_only=True)
class Mix:
    """Mix shards by weight for training, such as rendered and recorded ones. Prints the folder.

    The folder holds only the paths of the shards and their weights. Training reads it by --latents.
    """

    shards: tuple[Path, ...]
    """Folders of shards; their records must agree in kind and size."""
    out: Path
    """Folder of the mixture."""
    weights: tuple[float, ...] = ()
    """Weight of each folder in the training samples; by default its number of records."""

    def run(self) -> int:
        """Check the folders and write the mixture."""
        from egosim_jax.data.mixing import write_mixture
        from egosim_jax.data.shards import ShardReader

        weights = self.weights or tuple(float(len(ShardReader(part))) for part in self.shards)
        if len(weights) != len(self.shards) or len({*self.shards}) < len(self.shards):
            raise InputError(
                f"{len(weights)} weights for {len(self.shards)} folders: give one for each, and "
                "every folder once. (--weights, --shards)"
            )
        write_mixture(self.out, dict(zip(self.shards, weights, strict=True)))
        print_line(self.out)
        return ExitCode.DONE
