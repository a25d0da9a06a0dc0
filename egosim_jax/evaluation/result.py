"""Result of an evaluation: summaries by group and method, paired differences, protocol."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from egosim_jax.evaluation.cache import Scores
from egosim_jax.evaluation.fvd import distance_of, is_feature
from egosim_jax.evaluation.measures import Column, columns_of
from egosim_jax.evaluation.methods import FIT
from egosim_jax.evaluation.metrics import lpips
from egosim_jax.evaluation.metrics.report import (
    DEFINITIONS,
    paired_difference,
    print_table,
    summarize,
)
from egosim_jax.evaluation.scoring import OWN, Protocol, Row, Scoring, row_of
from egosim_jax.runtime.terminal import counted, print_line

KNOWN = {
    "depth_err": Column("Depth ERR of the paper", "{:.3f}", "lower"),
    "cam_err": Column("Cam ERR of the paper", "{:.4f}", "lower"),
    "lpips_alex": Column("LPIPS-Alex", "{:.4f}", "lower"),
    "lpips_vgg": Column("LPIPS-VGG", "{:.4f}", "lower"),
    "dreamsim": Column("DreamSim", "{:.4f}", "lower"),
}
"""Columns that published rows may have without being measured here."""
SHOWN = ("psnr", "ssim", "lpips_alex")
"""Default columns of printed tables; files have all columns."""
FEW_CLIPS = 5
"""Number of clips below which a note says that intervals are wide."""
Summaries = Mapping[str, Mapping[str, Mapping[str, Any]]]
"""Number of clips, mean and spread of each measure by group and method."""


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Scores of methods on clips, with their definitions and protocol."""

    rows: Sequence[Row]
    """Scores of each clip and method."""
    titles: Mapping[str, str]
    """Titles of the methods in tables, by name."""
    columns: Mapping[str, Column]
    """Measured columns by key."""
    shown: Sequence[str]
    """Keys of the columns in tables."""
    definitions: Mapping[str, str]
    """Definitions by key."""
    protocol: Protocol
    group: str = "split"
    """Metadata column; each of its values is a separate group."""
    groups: Mapping[str, str] = field(default_factory=dict)
    """Titles of some groups."""
    published: Mapping[str, Mapping[str, Mapping[str, float]]] = field(default_factory=dict)
    """Published figures by group, row and column; their authors used other clips."""
    source: str = ""
    """Source of the published figures."""
    unavailable: Sequence[str] = ()
    """Measures that were not computed, with the reasons."""
    skipped: Sequence[str] = ()
    """Clips that were not compared, with the reasons."""
    absent: Sequence[str] = ()
    """Clips of the metadata that were not generated, in a line for each folder."""
    crops: Sequence[str] = ()
    """Crops of the recorded images that the folders show, in words."""

    @classmethod
    def of(cls, scoring: Scoring, rows: Sequence[Row], **options: Any) -> Evaluation:
        """Return the result of a scoring."""
        measured = columns_of(scoring.measures)
        definitions = {key: column.definition for key, column in measured.items()}
        options.setdefault("shown", SHOWN)
        present = {row.method for row in rows}
        titles = {row_of(method): method.title for method in scoring.methods}
        titles |= {f"{name}{OWN}": f"{title}, in its own crop" for name, title in titles.items()}
        return cls(
            rows=rows,
            titles={name: title for name, title in titles.items() if name in present},
            columns={**KNOWN, **measured},
            definitions=definitions,
            protocol=scoring.protocol,
            skipped=scoring.skipped,
            absent=scoring.absent,
            crops=scoring.crops,
            **options,
        )

    @property
    def measured(self) -> list[str]:
        """Keys of the columns that at least one row has."""
        keys = (key for row in self.rows for key in row.scores if not is_feature(key))
        return list(dict.fromkeys(keys))

    def group_of(self, row: Row) -> str:
        """Return the group of a row."""
        return row.window.files.extra.get(self.group, "all")

    def summaries(self) -> Summaries:
        """Return the summary of each method over the clips of each group."""
        return {
            group: {
                method: self._summary([row.scores for row in rows])
                for method, rows in by_method.items()
            }
            for group, by_method in self._grouped().items()
        }

    def _summary(self, scores: list[Scores]) -> dict[str, Any]:
        distance = distance_of(scores)
        fvd = {} if distance is None else {"fvd": {"mean": distance}}
        return {"clips": len(scores), **summarize(scores, self.measured), **fvd}

    def differences(self) -> dict[str, dict[str, dict[str, dict[str, float]]]]:
        """Return the paired differences of each method from the first method, by group."""
        by_group: dict[str, dict[str, dict[str, dict[str, float]]]] = {}
        reference, *others = self.titles
        for group, by_method in self._grouped().items():
            start = {row.window: row.scores for row in by_method.get(reference, ())}
            for method in others:
                if any(row.own for row in by_method.get(method, ())):
                    continue
                pairs = [(row.scores, start.get(row.window)) for row in by_method.get(method, ())]
                shared = [(scores, at) for scores, at in pairs if at is not None]
                if len(shared) > 1:
                    by_group.setdefault(group, {})[method] = {
                        key: paired_difference(
                            [scores[key] for scores, _ in shared], [at[key] for _, at in shared]
                        )
                        for key in shared[0][0]
                        if not is_feature(key)
                    }
        return by_group

    def by_index(self) -> dict[str, list[dict[str, Any]]]:
        """Return the summaries of each method over the first, second, ... windows of all clips.

        Empty unless some clip has several windows, as in continuous generation.
        """
        starts: dict[str, set[int]] = {}
        for row in self.rows:
            starts.setdefault(row.window.files.video_id, set()).add(row.window.start)
        if max(map(len, starts.values())) == 1:
            return {}
        places = {name: sorted(of_clip) for name, of_clip in starts.items()}
        scores: dict[str, dict[int, list[Scores]]] = {}
        for row in self.rows:
            if row.own:
                continue
            place = places[row.window.files.video_id].index(row.window.start)
            scores.setdefault(row.method, {}).setdefault(place, []).append(row.scores)
        return {
            method: [self._summary(by_place[place]) for place in sorted(by_place)]
            for method, by_place in scores.items()
        }

    def _grouped(self) -> dict[str, dict[str, list[Row]]]:
        """Return the rows by group (sorted by name) and method."""
        grouped: dict[str, dict[str, list[Row]]] = {}
        for row in self.rows:
            grouped.setdefault(self.group_of(row), {}).setdefault(row.method, []).append(row)
        return {
            group: {m: grouped[group][m] for m in self.titles if m in grouped[group]}
            for group in sorted(grouped)
        }

    @property
    def report(self) -> dict[str, Any]:
        """Scores and protocol: the contents of report.json."""
        return {
            "definitions": {
                **self.definitions,
                "spread": DEFINITIONS["spread"],
                "frames": f"{self.protocol.first} to the last",
                "differences": "from the first method on the same clips: mean and Student's 95 % "
                "interval of paired differences",
            },
            "protocol": {
                "description": self.protocol.describe(),
                "size": self.protocol.size,
                "pixels": sorted({f"{row.shape.width}x{row.shape.height}" for row in self.rows}),
                "frames": [self.protocol.first, max(row.shape.frames for row in self.rows) - 1],
                "last_frames": sorted({row.shape.frames - 1 for row in self.rows}),
                "resize": FIT,
                "crops": list(self.crops),
                "lpips_alex": lpips.protocol(),
                "unavailable": list(self.unavailable),
            },
            "splits": self.summaries(),
            "differences": self.differences(),
            "by_index": self.by_index(),
            "published": {"source": self.source, "rows": self.published} if self.published else {},
        }

    def table(self, group: str) -> dict[str, Mapping[str, Mapping[str, float]]]:
        """Return the rows of a group's table by title; published figures are last.

        If a method has fewer clips than others, its title includes their number.
        """
        methods = self.summaries()[group]
        total = max(summary["clips"] for summary in methods.values())
        rows = {
            _title(self.titles[name], summary["clips"], total): {
                key: summary[key] for key in self.shown if key in summary
            }
            for name, summary in methods.items()
        }
        published = {
            f"{name} (published)": {key: {"mean": value} for key, value in values.items()}
            for name, values in self.published.get(group, {}).items()
        }
        return {**rows, **published}

    def headings(self, group: str) -> dict[str, Column]:
        """Return the columns of a group's table that have values."""
        present = {key for row in self.table(group).values() for key in row}
        return {key: self.columns[key] for key in self.shown if key in present}

    def caption(self, group: str) -> str:
        """Return the title of a group's table, with its number of clips."""
        count = max(row["clips"] for row in self.summaries()[group].values())
        return f"{self.groups.get(group, f'{self.group} {group}')}, {counted(count, 'clip')}"

    def print(self) -> None:
        """Print the table and paired differences of each group, and the protocol."""
        differences = self.differences()
        for group in self.summaries():
            headings = {key: (c.heading, c.form) for key, c in self.headings(group).items()}
            title = f"{self.caption(group)}: mean ± spread"
            print_table("", self.table(group), headings, title=title)
            others = {self.titles[m]: values for m, values in differences.get(group, {}).items()}
            if others:
                reference = next(iter(self.titles.values()))
                print_table("", others, headings, title=f"difference from {reference}, 95 %")
        for method, summaries in self.by_index().items():
            shown = [{k: row[k] for k in self.shown if k in row} for row in summaries]
            rows = {str(number): row for number, row in enumerate(shown, start=1)}
            columns = {k: (self.columns[k].heading, self.columns[k].form) for k in shown[0]}
            print_table("clip", rows, columns, title=f"{self.titles[method]}: decay by clip")
        for line in self.notes():
            print_line(line)

    def notes(self) -> list[str]:
        """Return protocol, definitions and sources as lines of text."""
        protocol = self.report["protocol"]
        last = " or ".join(map(str, protocol["last_frames"]))
        sizes = ", ".join(protocol["pixels"])
        frames = f"frames {self.protocol.first} to {last}"
        lines = [
            f"{frames} at the size of the {protocol['size']}: {sizes}",
            f"protocol: {protocol['description']}",
            "reading: an interval without 0 shows a difference; a model that is no better than the "
            "baselines (prior, first frame repeated) does no better than copying",
        ]
        fewest = min(
            rows["clips"] for methods in self.summaries().values() for rows in methods.values()
        )
        if self.differences() and fewest < FEW_CLIPS:
            lines.append(
                f"reading: {counted(fewest, 'clip')} of a method are few: intervals of fewer than "
                f"{FEW_CLIPS} clips are wide, or missing, and decide little"
            )
        lines += [
            f"{key}: {text}"
            for key, text in self.definitions.items()
            if set(key.split(", ")) & set(self.shown)
        ]
        if "lpips_alex" in self.shown and "lpips_alex" not in self.definitions:
            lines.append(f"lpips_alex: {protocol['lpips_alex']}")
        lines += [f"absent: {line}" for line in self.absent]
        lines += [f"crop: {line}" for line in self.crops]
        lines += [f"unavailable: {line}" for line in self.unavailable]
        return lines + ([f"published: {self.source}"] if self.published else [])


def _title(name: str, clips: int, total: int) -> str:
    return name if clips == total else f"{name}, {clips} of {total} clips"
