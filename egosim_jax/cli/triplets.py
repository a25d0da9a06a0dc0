"""`egosim data align` and `to-dwm`: triplets of a static scene, hands and the recorded video."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from egosim_jax.command import ExitCode
from egosim_jax.progress import track


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
        from rich.table import Table

        from egosim_jax.data.metadata import read_metadata, select
        from egosim_jax.io.run import write_json
        from egosim_jax.metrics.alignment import align_clip
        from egosim_jax.types import InputError

        clips = select(read_metadata(self.metadata), where=self.where, limit=self.limit)
        table = Table("clip", "right px", "down px", "PSNR dB", "inside", "aligned", "gain")
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

    The folders are videos, videos_static, videos_hands, prompts and prompts_rewrite; `--metadata
    LIST` of every command reads them.
    """

    shards: Path
    """Folder of shards of frames or videos, with targets."""
    out: Path
    """Root of the folders."""
    name: str
    """Name of the dataset, which is that of its folder and of its list."""
    fps: int = 8
    """Frame rate of the videos in frames per second."""
    limit: int | None = None
    """Maximum number of clips."""

    def run(self) -> int:
        """Write clip after clip."""
        from itertools import islice

        from egosim_jax.data.dwm import write_folders
        from egosim_jax.data.pack import read_triplets
        from egosim_jax.data.shards import ShardReader
        from egosim_jax.types import check_counts

        check_counts({"--fps": self.fps, "--limit": self.limit})
        reader = ShardReader(self.shards)
        count = min(len(reader), self.limit or len(reader))
        triplets = track(islice(read_triplets(reader), count), "writing", total=count)
        print(write_folders(self.out, triplets, name=self.name, fps=self.fps))
        return ExitCode.DONE
