"""`egosim table`: make a paper's table from folders of clips."""

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
    """Make a table of the EgoSim or DWM paper from folders of clips of any model.

    Clips are grouped by a metadata column (dataset) and compared by the paper's definitions, inside
    the crop of the recorded image that all folders show. The paper's own figures are separate rows.
    Prints the tables with spreads and paired differences.
    Writes report.json, metrics.jsonl, scores.csv (one row per clip), table.tex, scores.png and
    index.html with the clips in columns. Scores are cached by content: a repeated command computes
    only new ones.
    """

    name: Annotated[Name, tyro.conf.Positional]
    """Table to make."""
    out: Path
    """Folder of the report."""

    def run(self) -> int:
        """Compare all clips, then summarize."""
        from egosim_jax.evaluation.methods import Folder
        from egosim_jax.evaluation.tables import TABLES

        table = TABLES[self.name]
        folders = Folder.parse_all(self.generated)
        clips = [c for c in self.read_clips() if c.extra.get(table.group) in table.groups]
        if not clips:
            raise InputError(
                f"No clip belongs to this table: the column {table.group} must be one of "
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
