"""`egosim table`: the papers' tables of any folders of clips."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from egosim_jax.cli.comparison import Options
from egosim_jax.runtime.command import ExitCode
from egosim_jax.types import InputError

Name = Literal[
    "egosim",
    "egosim_continuous",
    "egosim_ablation",
    "egosim_robot",
    "egosim_few_shot",
    "dwm_1",
    "dwm_2",
    "dwm_3",
    "dwm_4",
]


@dataclass(frozen=True, kw_only=True)
class TableCommand(Options):
    """Make a table of EgoSim's or DWM's paper from folders of clips, by whomever they were made.

    Clips are grouped by the column dataset of the metadata and compared in the paper's definitions,
    and its figures are separate rows. Prints the tables with spreads and paired differences;
    writes report.json, metrics.jsonl, scores.csv (a row per clip), table.tex, scores.png and
    index.html with the clips in columns. Scores are cached by content: the same command computes
    what is new.
    """

    name: Annotated[Name, tyro.conf.Positional]
    """Table to make."""
    out: Path
    """Folder of the report."""

    def run(self) -> int:
        """Compare clip after clip, then summarize."""
        from egosim_jax.evaluation.methods import Folder
        from egosim_jax.evaluation.tables import TABLES

        table = TABLES[self.name]
        folders = [Folder.parse(text) for text in self.generated]
        clips = [c for c in self.read_clips() if c.extra.get(table.group) in table.groups]
        if not clips:
            raise InputError(
                f"No clip belongs to this table: its column {table.group} must be one of "
                f"{', '.join(table.groups)}. (--metadata)"
            )
        evaluation = self.compare(
            folders,
            clips,
            protocol=table.protocol,
            out=self.out,
            title=table.title,
            networks=tuple(dict.fromkeys((table.lpips, *self.lpips))),
            shown=table.shown,
            group=table.group,
            groups=table.groups,
            published=table.published,
            source=table.source,
        )
        return ExitCode.PARTIAL if evaluation.skipped else ExitCode.DONE
