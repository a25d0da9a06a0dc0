"""`egosim evaluate`: generated clips against the recorded ones, beside simple baselines."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from egosim_jax.cli.generate import RESULTS
from egosim_jax.command import DONE, PARTIAL
from egosim_jax.progress import track
from egosim_jax.types import InputError

if TYPE_CHECKING:
    import numpy as np

    from egosim_jax.data.metadata import ClipFiles
    from egosim_jax.metrics.report import Score, Summary

METHODS = {
    "generated": "generated",
    "prior": "prior",
    "prior_fit": "prior, colours fitted to the truth",
    "still": "first true frame, repeated",
    "vae": "truth through the autoencoder",
}
"""What is compared with the truth, and its name in the table."""


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Compare generated clips with the recorded ones by PSNR and SSIM.

    Every {id}.mp4 is compared with the truth of its metadata row, stretched to the generated size,
    over the same frames; so are the prior, the prior with a least-squares change of colours, the
    first true frame repeated and, where there is an {id}_vae.mp4, the autoencoder's copy of the
    truth. Frame 0 does not count, because there the repeated frame is the truth. Prints a table;
    writes metrics.jsonl (a line a clip) and report.json.
    """

    generated: Path
    """Folder of {id}.mp4; its results.jsonl, if it has one, says which clips and windows."""
    metadata: Path
    """CSV or JSONL in EgoSim's columns, with video."""
    where: str | None = None
    """Take rows whose column has this value, for instance split=test."""
    out: Path | None = None
    """Folder of the report, if not that of the clips."""

    def run(self) -> int:
        """Compare clip after clip, then summarise."""
        from egosim_jax.io.run import write_json, write_text
        from egosim_jax.metrics.report import DEFINITIONS, summarise_splits

        windows, failed = self._windows()
        compared: list[tuple[_Window, dict[str, Score]]] = []
        for window in track(windows, "comparing", total=len(windows)):
            try:
                compared.append((window, self._scores(window)))
            except InputError as error:
                failed.append(f"{window.output_id}: {error}")
        for line in failed:
            print(f"left out: {line}", file=sys.stderr)
        if not compared:
            raise InputError(f"Nothing in {self.generated} could be compared. (--generated)")

        lines = [
            {
                "video_id": window.output_id,
                "split": window.split,
                **{method: asdict(score) for method, score in scores.items()},
            }
            for window, scores in compared
        ]
        splits = summarise_splits([(window.split, scores) for window, scores in compared])
        out = self.out or self.generated
        write_text(out / "metrics.jsonl", "".join(f"{json.dumps(line)}\n" for line in lines))
        report = {
            "definitions": {**DEFINITIONS, "frames": "1 to the last"},
            "splits": {
                split: {method: asdict(summary) for method, summary in methods.items()}
                for split, methods in splits.items()
            },
        }
        write_json(out / "report.json", report)
        _print(splits)
        return PARTIAL if failed else DONE

    def _windows(self) -> tuple[list[_Window], list[str]]:
        """What was generated and can be compared, and what cannot."""
        from egosim_jax.data.metadata import read_metadata, select

        if not self.generated.is_dir():
            raise InputError(f"There is no folder {self.generated}. (--generated)")
        rows = {
            files.video_id: files
            for files in select(read_metadata(self.metadata), where=self.where)
        }
        results = _results(self.generated / RESULTS)
        if results is None:
            return [_Window(files, 0, video_id) for video_id, files in rows.items()], []
        windows, failed = [], []
        for output_id, line in results.items():
            files = rows.get(str(line.get("source_id")))
            if files is None:
                continue
            if line.get("status") == "failed":
                failed.append(f"{output_id}: it was not generated")
            else:
                windows.append(_Window(files, int(line.get("start", 0)), output_id))
        return windows, failed

    def _scores(self, window: _Window) -> dict[str, Score]:
        import numpy as np

        from egosim_jax.io.video import read_video
        from egosim_jax.metrics.image import fit_colours
        from egosim_jax.metrics.report import score

        generated = read_video(self.generated / f"{window.output_id}.mp4").frames
        if len(generated) < 2:
            raise InputError("a single frame cannot be compared: frame 0 does not count.")
        if window.files.truth is None:
            raise InputError(f"{window.files.row} names no truth.")
        truth = _read_like(window.files.truth, generated, window.start)
        prior = _read_like(window.files.prior, generated, window.start)
        videos = {
            "generated": generated,
            "prior": prior,
            "prior_fit": fit_colours(prior, truth),
            "still": np.broadcast_to(truth[:1], truth.shape),
        }
        vae = self.generated / f"{window.output_id}_vae.mp4"
        if vae.exists():
            videos["vae"] = _read_like(vae, generated, 0)
        return {method: score(video[1:], truth[1:]) for method, video in videos.items()}


@dataclass(frozen=True)
class _Window:
    """A generated clip and where its truth lies."""

    files: ClipFiles
    start: int
    output_id: str

    @property
    def split(self) -> str:
        """The metadata's split, or "all"."""
        return self.files.extra.get("split", "all")


def _results(path: Path) -> dict[str, dict[str, Any]] | None:
    """The last line of each clip in results.jsonl; None without the file."""
    if not path.is_file():
        return None
    try:
        lines = [json.loads(line) for line in path.read_text("utf-8").splitlines()]
        return {str(line["video_id"]): line for line in lines}
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"{path} cannot be read: {error!r}.") from error


def _read_like(path: Path, like: np.ndarray, start: int) -> np.ndarray:
    """As many frames of a video as `like` has, from `start` on, stretched to its size."""
    from egosim_jax.data.transforms import resize_video
    from egosim_jax.io.video import read_video

    count, height, width, _ = like.shape
    frames = read_video(path, start=start, stop=start + count).frames
    if len(frames) < count:
        raise InputError(f"{path} ends before frame {start + count}, which was generated.")
    return resize_video(frames, height, width)


def _print(splits: Mapping[str, Mapping[str, Summary]]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    for split, methods in splits.items():
        clips = max(summary.clips for summary in methods.values())
        table = Table("", "PSNR dB", "SSIM", title=f"{split}, {clips} clips: mean ± spread")
        for method, name in METHODS.items():
            if method in methods:
                summary = methods[method]
                table.add_row(
                    name,
                    f"{summary.psnr:.2f} ± {summary.psnr_spread:.2f}",
                    f"{summary.ssim:.4f} ± {summary.ssim_spread:.4f}",
                )
        console.print(table)
