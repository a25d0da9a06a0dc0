"""The papers' tables: their groups, columns, protocol and published figures.

The authors measured the published figures (`published.csv`) on other, and more, clips. EgoSim has
published neither its evaluation code nor the formulas of its depth and camera errors
(arXiv 2604.01001): these have separate columns. DWM's definitions are from its public code
(arXiv 2512.17907).
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from importlib import resources
from typing import Literal

from egosim_jax.evaluation.scoring import Protocol

Figures = Mapping[str, Mapping[str, float]]
"""Published figures by row and column."""


@dataclass(frozen=True, kw_only=True)
class Table:
    """Definition of a published table."""

    title: str
    shown: tuple[str, ...]
    """Keys of the columns."""
    group: str = "dataset"
    """Metadata column whose values are the groups."""
    groups: Mapping[str, str]
    """Titles of the groups; other clips are ignored."""
    protocol: Protocol
    lpips: Literal["alex", "vgg"]
    """Network of LPIPS."""
    published: Mapping[str, Figures]
    """Published figures by group."""
    source: str
    """Source of the published figures."""


def _published(table: str) -> dict[str, dict[str, dict[str, float]]]:
    """Return the published figures of a table by group, row and column."""
    text = resources.files("egosim_jax.evaluation").joinpath("published.csv").read_text("utf-8")
    figures: dict[str, dict[str, dict[str, float]]] = {}
    for line in csv.DictReader(text.splitlines()):
        name, group, row = (line.pop(column) for column in ("table", "group", "row"))
        if name == table:
            values = {column: float(value) for column, value in line.items() if value}
            figures.setdefault(group, {})[row] = values
    return figures


_egosim = partial(
    Table,
    shown=("psnr", "ssim", "lpips_alex", "depth_error", "camera_error", "depth_err", "cam_err"),
    protocol=Protocol(size="target", lengths="common", registered="all"),
    lpips="alex",
    source="EgoSim, arXiv 2604.01001; sizes, frames and LPIPS network of its evaluation are "
    "unknown",
)
_dwm = partial(
    Table,
    shown=("psnr_clip", "ssim", "lpips_vgg", "dreamsim"),
    protocol=Protocol(size="target", lengths="common", frame_0=True),
    lpips="vgg",
    source="DWM, arXiv 2512.17907",
)
_EGODEX = {"egodex": "EgoDex"}
_SYNTHETIC = {"synthetic_dynamic": "synthetic, moving camera"}
_SETS = {
    **_SYNTHETIC,
    "real_static": "real, static camera",
    "real_dynamic": "real, moving camera",
}
_TITLES = {
    "egosim": (_egosim, "EgoSim: single clips", {**_EGODEX, "egovid": "EgoVid"}),
    "egosim_continuous": (
        _egosim,
        "EgoSim: continuous generation, two clips of 61 frames",
        _EGODEX,
    ),
    "egosim_ablation": (_egosim, "EgoSim: without trajectory and without mask", _EGODEX),
    "egosim_robot": (_egosim, "EgoSim: transfer to a robot", {"agibot": "AgiBot"}),
    "egosim_few_shot": (_egosim, "EgoSim: a few clips of EgoCap", {"egocap": "EgoCap"}),
    "dwm_1": (_dwm, "DWM: Table 1", _SETS),
    "dwm_2": (_dwm, "DWM: Table 2, data sets of the training", _SETS),
    "dwm_3": (_dwm, "DWM: Table 3, conditioning on hands", _SYNTHETIC),
    "dwm_4": (
        _dwm,
        "DWM: Table 4, initial weights, by training step",
        {"synthetic_dynamic": "synthetic, moving camera; in the paper not stated"},
    ),
}
TABLES: dict[str, Table] = {
    name: make(title=title, groups=groups, published=_published(name))
    for name, (make, title, groups) in _TITLES.items()
}
"""Tables by name."""
