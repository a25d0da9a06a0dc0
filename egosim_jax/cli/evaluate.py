"""`egosim evaluate`: generated clips against the recorded ones, beside simple baselines."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from egosim_jax.cli.generate import RESULTS
from egosim_jax.command import DONE, PARTIAL
from egosim_jax.data.metadata import is_safe_id
from egosim_jax.io.untrusted import quote_path, read_lines
from egosim_jax.progress import track
from egosim_jax.types import InputError

if TYPE_CHECKING:
    import numpy as np

    from egosim_jax.data.metadata import ClipFiles
    from egosim_jax.metrics.report import Score, Summary

METHODS = {
    "generated": "generated",
    "prior": "prior",
    "prior_fit": "prior, colors fitted to the truth",
    "still": "first true frame, repeated",
    "vae": "truth through the autoencoder",
}
"""What is compared with the truth, and its name in the table."""


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Compare generated clips with the recorded ones by PSNR and SSIM.

    Every {id}.mp4 is compared with the truth of its metadata row over the same frames, both at one
    size; so are the prior, the prior with a least-squares change of colors, the first true frame
    repeated and, where there is an {id}_vae.mp4, the autoencoder's copy of the truth. Frame 0 does
    not count, because there the repeated frame is the truth. A clip of another length than most
    is left out (exit code 3). Prints a table; writes metrics.jsonl (a line a clip) and report.json,
    which names the protocol.
    """

    generated: Path
    """Folder of {id}.mp4; its results.jsonl, if it has one, says which clips and windows."""
    metadata: Path
    """CSV or JSONL in EgoSim's columns, with video."""
    where: str | None = None
    """Take rows whose column has this value, for instance split=test."""
    size: Literal["output", "truth"] = "output"
    """Whose size the comparison has. That of the output flatters small ones: methods whose outputs
    differ in size compare at the truth's alone."""
    out: Path | None = None
    """Folder of the report, if not that of the clips."""

    def run(self) -> int:
        """Compare clip after clip, then summarize."""
        from egosim_jax.io.run import write_json, write_text
        from egosim_jax.metrics.report import DEFINITIONS, summarize_splits

        windows, failed = self._windows()
        windows, frames = self._whole(windows, failed)
        compared: list[tuple[_Window, dict[str, Score]]] = []
        sizes: set[str] = set()
        for window in track(windows, "comparing", total=len(windows)):
            try:
                scores, height, width = self._scores(window)
                compared.append((window, scores))
                sizes.add(f"{width}x{height}")
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
        splits = summarize_splits([(window.split, scores) for window, scores in compared])
        out = self.out or self.generated
        write_text(out / "metrics.jsonl", "".join(f"{json.dumps(line)}\n" for line in lines))
        report = {
            "definitions": {**DEFINITIONS, "frames": "1 to the last"},
            "protocol": {
                "size": self.size,
                "pixels": sorted(sizes),
                "frames": [1, frames - 1],
                "resize": "Pillow LANCZOS, to the size of the comparison",
            },
            "splits": {
                split: {method: asdict(summary) for method, summary in methods.items()}
                for split, methods in splits.items()
            },
        }
        write_json(out / "report.json", report)
        _print(splits)
        print(
            f"frames 1 to {frames - 1} at the size of the {self.size}: {', '.join(sorted(sizes))}"
        )
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
                windows.append(_Window(files, line.get("start", 0), output_id))
        return windows, failed

    def _whole(self, windows: Sequence[_Window], failed: list[str]) -> tuple[list[_Window], int]:
        """Return the clips that are as long as most are, and that length."""
        from egosim_jax.io.video import probe_video

        lengths: dict[_Window, int] = {}
        for window in windows:
            try:
                lengths[window] = probe_video(self._video(window)).frames
            except InputError as error:
                failed.append(f"{window.output_id}: {error}")
        counts = Counter(lengths.values())
        usual = max(counts, key=lambda length: (counts[length], length), default=0)
        failed += [
            f"{window.output_id}: it has {length} frames, most clips {usual}."
            for window, length in lengths.items()
            if length != usual
        ]
        if usual == 1:
            raise InputError("Single frames cannot be compared: frame 0 does not count.")
        return [window for window in lengths if lengths[window] == usual], usual

    def _scores(self, window: _Window) -> tuple[dict[str, Score], int, int]:
        """Return the scores of a clip, and the height and width at which it was compared."""
        import numpy as np

        from egosim_jax.io.video import probe_video
        from egosim_jax.metrics.image import fit_colors
        from egosim_jax.metrics.report import score

        path = self._video(window)
        if window.files.target is None:
            raise InputError(f"{window.files.row} names no truth.")
        output = probe_video(path)
        like = output if self.size == "output" else probe_video(window.files.target)
        shape = output.frames, like.height, like.width
        truth = _read_at(window.files.target, shape, window.start)
        prior = _read_at(window.files.prior, shape, window.start)
        videos = {
            "generated": _read_at(path, shape, 0),
            "prior": prior,
            "prior_fit": fit_colors(prior, truth),
            "still": np.broadcast_to(truth[:1], truth.shape),
        }
        vae = path.with_name(f"{path.stem}_vae.mp4")
        if vae.exists():
            videos["vae"] = _read_at(vae, shape, 0)
        scores = {method: score(video[1:], truth[1:]) for method, video in videos.items()}
        return scores, like.height, like.width

    def _video(self, window: _Window) -> Path:
        return self.generated / f"{window.output_id}.mp4"


@dataclass(frozen=True, eq=False)
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
    lines = {}
    for number, line in read_lines(path):
        output_id = line.get("video_id") if isinstance(line, dict) else None
        start = line.get("start", 0) if isinstance(line, dict) else None
        if not (isinstance(output_id, str) and is_safe_id(output_id)) or type(start) is not int:
            raise InputError(f"{quote_path(path)}, line {number} is no result of a clip.")
        lines[output_id] = line
    return lines


def _read_at(path: Path, shape: tuple[int, int, int], start: int) -> np.ndarray:
    """Frames of a video from `start` on, as many as `shape` has, stretched to its size."""
    from egosim_jax.data.transforms import resize_image
    from egosim_jax.io.video import read_video

    count, height, width = shape
    fit = partial(resize_image, height=height, width=width)
    frames = read_video(path, start=start, stop=start + count, each=fit).frames
    if len(frames) < count:
        raise InputError(f"{path} ends before frame {start + count}, which was generated.")
    return frames


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
