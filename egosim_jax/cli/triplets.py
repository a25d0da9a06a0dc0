"""`egosim data static`, `align`, `mix` and `to-dwm`: triplets of static scenes."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

from egosim_jax.data.clip_files import Prompts
from egosim_jax.runtime.command import ExitCode
from egosim_jax.runtime.progress import track
from egosim_jax.types import InputError, check_counts

if TYPE_CHECKING:
    from egosim_jax.configs.model import ModelConfig
    from egosim_jax.rendering.mesh import MovingMesh


@dataclass(frozen=True, kw_only=True)
class Static:
    """Make a triplet of DWM: a static scene, hand meshes, and the recorded video if there is one.

    The scene is rendered along the cameras of the action, or is the first frame of the recorded
    video, repeated, if the camera is fixed. The files are those of `data pack`; other clips of the
    folder keep their rows in metadata.csv. Prints its path.
    """

    action: Path
    """File of cameras and hands, .npz or .json as of `episode make`; hands left before right."""
    out: Path
    """Folder of the triplet and of metadata.csv."""
    video_id: str
    """Id of the triplet."""
    height: int
    """Rows of a frame in pixels, that the intrinsics are of."""
    width: int
    """Columns of a frame in pixels."""
    scene: Path | None = None
    """Folder of a state, or a .ply of colored points or triangles; none for a fixed camera."""
    video: Path | None = None
    """Recorded video, of the length and size of the action."""
    prompt: str | None = None
    """Caption, instead of that in the file."""
    mano_poses: Path | None = None
    """.npz of the hands as global_orient, hand_pose, translation_m and betas of MANO.

    They replace the meshes of the keypoints."""
    mano_right: Path | None = None
    """MANO_RIGHT.pkl from mano.is.tue.mpg.de, which is read without executing it."""
    mano_left: Path | None = None
    """MANO_LEFT.pkl; without it, left hands are mirrored right ones."""
    add_mean: bool = False
    """Take the poses of MANO as relative to its mean pose."""
    fps: int | None = None
    """Frame rate in frames per second; None: that of the recorded video, or 8 without one."""

    def run(self) -> int:
        """Read, render and write."""
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
                "There is no scene: give one, or the video of a fixed camera, whose first frame is "
                "repeated. (--scene, --video)"
            )
        triplet = static_triplet(
            action, static, video_id=self.video_id, meshes=self._meshes(), target=target
        )
        print(write_clips(self.out, [triplet], fps=fps, append=True))
        return ExitCode.DONE

    def _meshes(self) -> MovingMesh | None:
        from egosim_jax.rendering.mano import mano_hands, read_mano, read_poses

        given = (self.mano_poses, self.mano_right, self.mano_left)
        if given == (None, None, None) and not self.add_mean:
            return None
        if self.mano_poses is None or self.mano_right is None:
            raise InputError(
                "Hands of MANO need its model and their poses: give both. (--mano-right, "
                "--mano-poses)"
            )
        left = None if self.mano_left is None else read_mano(self.mano_left)
        poses, right = read_poses(self.mano_poses), read_mano(self.mano_right)
        return mano_hands(right, poses, left=left, add_mean=self.add_mean)


@dataclass(frozen=True, kw_only=True)
class Align:
    """Compare the priors of clips with their recorded videos, and find the shift between both.

    For each clip the PSNR of the prior is printed, which is the baseline of copying it, and what
    the best shift by whole pixels adds: inside a margin of the largest shift, with and without it.
    Videos must agree in length and size. Exit code 3 if a clip is skipped.
    """

    metadata: Path
    """CSV or JSONL in EgoSim's columns, with video; or a list of DWM, .txt."""
    where: str | None = None
    """Take rows whose column has this value, for instance split=test."""
    limit: int | None = None
    """Maximum number of clips."""
    most_px: int = 12
    """Largest shift along each axis in pixels."""
    out: Path | None = None
    """File of the results to write, .json."""

    def run(self) -> int:
        """Align clip after clip."""
        import dataclasses
        import sys

        from rich.console import Console
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
        found = {}
        for files in track(clips, "aligning", total=len(clips)):
            try:
                result = align_clip(files.prior, files.target, most_px=self.most_px)
            except InputError as error:
                print(f"skipped: {files.video_id}: {error}", file=sys.stderr)
                continue
            found[files.video_id] = {**dataclasses.asdict(result), "gain": result.gain}
            levels = result.psnr_full, result.psnr_inside, result.psnr_aligned, result.gain
            table.add_row(
                files.video_id, *map(str, result.shift_px), *(f"{level:.2f}" for level in levels)
            )
        Console().print(table)
        if self.out is not None:
            write_json(self.out, {"most_px": self.most_px, "clips": found})
        if not found:
            return ExitCode.USAGE
        return ExitCode.PARTIAL if len(found) < len(clips) else ExitCode.DONE


@dataclass(frozen=True, kw_only=True)
class ToDwm:
    """Write shards of frames or videos as DWM's folders, with a list. Prints the list.

    The folders are videos, videos_static, videos_hands, prompts and prompts_rewrite below OUT/NAME;
    `--metadata LIST` of every command reads them.
    """

    shards: Path
    """Folder of shards of frames or videos, with targets."""
    out: Path
    """Root of the folders."""
    name: str
    """Name of the dataset, which is that of its folder and of its list."""
    fps: int | None = None
    """Frame rate in frames per second; None: that of the shards.

    Frames that `data pack` took by another rule than rate do not say theirs."""
    limit: int | None = None
    """Maximum number of clips."""
    caches: str | None = None
    """Name of a model for which the caches of latents and captions are written, too.

    The folders are video_latents, static_video_latents, hand_video_latents and
    prompt_embeds_rewrite; `data from-caches` reads them."""
    weights: Path | None = None
    """With --caches, folder of weights with the VAE and the text encoder."""

    def run(self) -> int:
        """Write clip after clip."""
        from itertools import islice

        from egosim_jax.data.dwm import write_folders
        from egosim_jax.data.pack import frame_rates, read_triplets
        from egosim_jax.data.shards import ShardReader

        check_counts({"--fps": self.fps, "--limit": self.limit})
        model = self._cached_model()
        reader = ShardReader(self.shards)
        count = min(len(reader), self.limit or len(reader))
        fps = _one_rate(frame_rates(reader, count), self.fps, of="--shards")
        triplets = track(islice(read_triplets(reader), count), "writing", total=count)
        path = write_folders(self.out, triplets, name=self.name, fps=fps)
        if model is not None and self.weights is not None:
            from egosim_jax.data.dwm import read_list
            from egosim_jax.train.cached import write_caches

            clips = read_list(path, first_line=True)
            written = write_caches(model, self.weights, clips)
            for _ in track(written, "encoding", total=len(clips)):
                pass
        print(path)
        return ExitCode.DONE

    def _cached_model(self) -> ModelConfig | None:
        """Return the model whose caches are asked for, if any."""
        if self.caches is None and self.weights is None:
            return None
        if self.caches is None or self.weights is None:
            raise InputError(
                f"Caches are made by a model with its weights: give both, not --caches "
                f"{self.caches} with --weights {self.weights}. (--caches, --weights)"
            )
        from egosim_jax import configs
        from egosim_jax.train.cached import check_cached

        model = configs.get(self.caches).at(self.weights)
        check_cached(model)
        return model


def _one_rate(known: Collection[Fraction], given: int | None, *, of: str) -> Fraction:
    """Return the frame rate that is known or given. Raises `InputError` for none, or for several.

    `of` is the option that it is known of.
    """
    rates = {*known} if given is None else {*known, Fraction(given)}
    if not rates:
        raise InputError(f"The clips do not say their frame rate: give it. (--fps, {of})")
    if len(known) > 1:
        raise InputError(
            f"The videos have {_listed(rates)} frames per second: all must have one rate. Pack "
            f"those of each rate into other shards. ({of})"
        )
    if len(rates) > 1:
        raise InputError(
            f"The videos have {_listed(known)} frames per second, not {given}: their frames must "
            f"keep this rate. Leave it out. (--fps, {of})"
        )
    return rates.pop()


def _listed(rates: Collection[Fraction]) -> str:
    return ", ".join(f"{float(rate):g}" for rate in sorted(rates))


@dataclass(frozen=True, kw_only=True)
class Mix:
    """Mix shards by weight for training, such as rendered and recorded ones. Prints the folder.

    The folder holds only the names of the others and their weights; training reads it by the option
    --latents.
    """

    shards: tuple[Path, ...]
    """Folders of shards, with records of one kind and size."""
    out: Path
    """Folder of the mixture."""
    weights: tuple[float, ...] = ()
    """Share of each folder in the training samples; its number of records if not given."""

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
        print(self.out)
        return ExitCode.DONE


@dataclass(frozen=True, kw_only=True)
class FromCaches:
    """Make latents shards of DWM's caches of moments and embeddings. Prints the folder.

    The first clip is encoded as well and compared with its caches, which are refused if they are of
    another VAE or text encoder.
    """

    config: str
    """Name of the model."""
    weights: Path
    """Folder of weights with the VAE and the text encoder that the caches were made with."""
    metadata: Path
    """List of DWM, .txt."""
    out: Path
    """Folder of the latents shards."""
    prompts: Prompts = "prompts_rewrite"
    """Captions of the list, of whose first lines the caches must be.

    prompts_rewrite: the rewritten ones, of the released models, and the original one of a clip that
    has none; prompts: the original ones, of the paper's evaluation."""
    limit: int | None = None
    """Maximum number of clips."""

    def run(self) -> int:
        """Check the first clip, then read cache after cache."""
        from egosim_jax import configs
        from egosim_jax.data.dwm import read_list
        from egosim_jax.data.metadata import select
        from egosim_jax.train.cached import shard_caches

        clips = read_list(self.metadata, prompts=self.prompts, first_line=True)
        clips = select(clips, limit=self.limit)
        model = configs.get(self.config).at(self.weights)
        for _ in track(
            shard_caches(model, self.weights, clips, out=self.out), "reading", total=len(clips)
        ):
            pass
        print(self.out)
        return ExitCode.DONE
