"""`egosim experiment real_tiny`: train a small model on recorded clips and compare its clips."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from egosim_jax.cli.evaluate import Evaluate
from egosim_jax.cli.generate import RESULTS, Generate
from egosim_jax.command import DONE
from egosim_jax.data.sheet import SheetClip, draw_sheet
from egosim_jax.io.untrusted import read_json, read_lines

if TYPE_CHECKING:
    from egosim_jax.data.metadata import ClipFiles

SHEET_FRAMES = (4, 10, 16)
"""Frames of each clip on the contact sheet."""


@dataclass(frozen=True, kw_only=True)
class RealTiny:
    """Train `real_tiny` on the train split, generate both splits, compare, and draw a sheet."""

    metadata: Path
    """CSV or JSONL in EgoSim's columns, with video and split; clips of 61 frames."""
    out: Path
    """Folder of the run."""
    start: tuple[int, ...] = (0, 22, 44)
    """First frames of the windows that are generated."""
    seed: int = 0
    """Seed of the generated clips."""
    batch_size: int = 5
    """Clips generated together."""

    def run(self) -> int:
        """Train, generate, compare, draw."""
        from egosim_jax.train.recipes import REAL_TINY

        replace(REAL_TINY, metadata=self.metadata, out=self.out).run()
        return Comparison(
            config="real_tiny",
            metadata=self.metadata,
            out=self.out,
            start=self.start,
            seed=self.seed,
            batch_size=self.batch_size,
        ).run()


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """What a trained model makes of both splits, in numbers and pictures.

    Beside the clips as they are, generates each with the prior, mask and hands of another clip:
    what that costs is what the model takes from them. Writes report.json and contact_sheet.png.
    """

    config: str
    metadata: Path
    out: Path
    start: tuple[int, ...]
    seed: int
    batch_size: int

    def run(self) -> int:
        """Generate, compare, draw."""
        from egosim_jax.io.run import write_json

        swapped = self._swap()
        reports = {
            name: self._report(name, metadata)
            for name, metadata in (("generated", self.metadata), ("swapped", swapped))
        }
        for split, methods in reports["generated"]["splits"].items():
            other = reports["swapped"]["splits"][split]["generated"]["psnr"]
            cost = methods["generated"]["psnr"] - other
            print(f"{split}: another clip's prior and hands cost {cost:.2f} dB")
        write_json(self.out / "report.json", reports)
        sheet = self.out / "contact_sheet.png"
        draw_sheet(_blocks(self.out / "generated"), sheet, moments=SHEET_FRAMES)
        print(sheet)
        return DONE

    def _report(self, name: str, metadata: Path) -> dict[str, Any]:
        """Generate and compare; the comparison's report."""
        folder = self.out / name
        Generate(
            config=self.config,
            metadata=metadata,
            out=folder,
            weights=self.out / "weights",
            start=self.start,
            seed=self.seed,
            batch_size=self.batch_size,
            skip_existing=True,
            reconstruct=name == "generated",
        ).run()
        print(name)
        Evaluate(generated=folder, metadata=metadata).run()
        return read_json(folder / "report.json")

    def _swap(self) -> Path:
        """A metadata file in which each clip has the conditions of the next one of its split."""
        from egosim_jax.data.metadata import read_metadata
        from egosim_jax.io.run import write_text

        items = read_metadata(self.metadata)
        lines = []
        for split in sorted({item.extra["split"] for item in items}):
            clips = [item for item in items if item.extra["split"] == split]
            for clip, other in zip(clips, [*clips[1:], clips[0]], strict=True):
                lines.append(json.dumps(_row(clip, other)))
        path = self.out / "swapped.jsonl"
        write_text(path, "".join(f"{line}\n" for line in lines))
        return path


def _row(clip: ClipFiles, other: ClipFiles) -> dict[str, str]:
    """A metadata row with the prior (beside which the mask lies) and the hands of another clip."""
    return {
        "video": str(clip.target and clip.target.resolve()),
        "ego_prior_video": str(other.prior.resolve()),
        "hand_keypoint_video": str(other.hands.resolve()),
        "first_frame": str(clip.first_frame.resolve()),
        "prompt": clip.prompt,
        "video_id": clip.video_id,
        **clip.extra,
    }


def _blocks(folder: Path) -> list[SheetClip]:
    """The comparison video of each generated clip, by split and id."""
    from egosim_jax.io.video import read_video

    lines = [line for _, line in read_lines(folder / RESULTS)]
    shown = {line["source_id"]: line for line in reversed(lines) if line["status"] == "done"}
    ordered = sorted(shown.values(), key=lambda line: (line.get("split", ""), line["video_id"]))
    title = "{}  {}  prior | hands | generated | truth"
    return [
        SheetClip(
            title.format(line.get("split", ""), line["video_id"]),
            [read_video(folder / f"{line['video_id']}_cmp.mp4").frames],
        )
        for line in ordered
    ]
