"""The papers' tables: their groups, columns, protocol and published figures.

The authors measured the published figures on other, and more, clips. EgoSim has published neither
its evaluation code nor the formulas of its depth and camera errors (arXiv 2604.01001): these have
separate columns. DWM's definitions are from its public code (arXiv 2512.17907).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Literal

from egosim_jax.evaluation.scoring import Protocol

Figures = Mapping[str, Mapping[str, float]]
"""Published figures by row and column."""

EGOSIM = "EgoSim, arXiv 2604.01001; sizes, frames and LPIPS network of its evaluation are unknown"
DWM = "DWM, arXiv 2512.17907"
_EGOSIM_SHOWN = (
    "psnr",
    "ssim",
    "lpips_alex",
    "depth_error",
    "camera_error",
    "depth_err",
    "cam_err",
)
_DWM_SHOWN = ("psnr_clip", "ssim", "lpips_vgg", "dreamsim")


@dataclass(frozen=True, kw_only=True)
class Table:
    """Definition of a published table."""

    title: str
    shown: tuple[str, ...]
    """Keys of the columns."""
    group: str
    """Metadata column whose values are the groups."""
    groups: Mapping[str, str]
    """Titles of the groups; other clips are ignored."""
    protocol: Protocol
    lpips: Literal["alex", "vgg"]
    """Network of LPIPS."""
    published: Mapping[str, Figures] = field(default_factory=lambda: MappingProxyType({}))
    """Published figures by group."""
    source: str = ""
    """Source of the published figures."""


def _egosim(*values: float) -> dict[str, float]:
    keys = ("psnr", "ssim", "lpips_alex", "depth_err", "cam_err")
    return dict(zip(keys, values, strict=False))


def _dwm(*values: float) -> dict[str, float]:
    return dict(zip(_DWM_SHOWN, values, strict=True))


_EGOSIM_PROTOCOL = Protocol(size="target", lengths="common", registered="all")
_DWM_PROTOCOL = Protocol(size="target", lengths="common", frame_0=True)


_egosim_table = partial(
    Table,
    shown=_EGOSIM_SHOWN,
    group="dataset",
    protocol=_EGOSIM_PROTOCOL,
    lpips="alex",
    source=EGOSIM,
)
_dwm_table = partial(
    Table, shown=_DWM_SHOWN, group="dataset", protocol=_DWM_PROTOCOL, lpips="vgg", source=DWM
)

_SINGLE = {
    "egodex": {
        "Wan-2.1-14B-InP": _egosim(17.998, 0.447, 0.708, 42.335, 0.0300),
        "Mask2IV": _egosim(20.622, 0.814, 0.299, 38.339, 0.0181),
        "InterDyn": _egosim(22.250, 0.830, 0.255, 44.345, 0.0226),
        "EgoSim": _egosim(25.056, 0.896, 0.170, 8.888, 0.0013),
    },
    "egovid": {
        "InterDyn": _egosim(14.612, 0.466, 0.484, 38.180, 0.0308),
        "EgoSim": _egosim(16.684, 0.509, 0.421, 19.260, 0.0105),
    },
}
_SETS = {
    "synthetic_dynamic": "synthetic, moving camera",
    "real_static": "real, static camera",
    "real_dynamic": "real, moving camera",
}
TABLES = {
    "egosim": _egosim_table(
        title="EgoSim: single clips",
        groups={"egodex": "EgoDex", "egovid": "EgoVid"},
        published=_SINGLE,
    ),
    "egosim_continuous": _egosim_table(
        title="EgoSim: continuous generation, two clips of 61 frames",
        groups={"egodex": "EgoDex"},
        published={
            "egodex": {
                "EgoSim, single clips": _SINGLE["egodex"]["EgoSim"],
                "EgoSim continuous": _egosim(19.165, 0.835, 0.220, 10.943, 0.0017),
            }
        },
    ),
    "egosim_ablation": _egosim_table(
        title="EgoSim: without trajectory and without mask",
        groups={"egodex": "EgoDex"},
        published={
            "egodex": {
                "EgoSim": _SINGLE["egodex"]["EgoSim"],
                "without trajectory": _egosim(23.380, 0.845, 0.244),
                "without mask": _egosim(23.988, 0.886, 0.186),
            }
        },
    ),
    "egosim_robot": _egosim_table(
        title="EgoSim: transfer to a robot",
        groups={"agibot": "AgiBot"},
        published={
            "agibot": {
                "EgoSim, pre-trained on humans": _egosim(18.670),
                "EgoSim, not pre-trained": _egosim(15.180),
            }
        },
    ),
    "egosim_few_shot": _egosim_table(
        title="EgoSim: a few clips of EgoCap", groups={"egocap": "EgoCap"}
    ),
    "dwm_1": _dwm_table(
        title="DWM: Table 1",
        groups=_SETS,
        published={
            "synthetic_dynamic": {
                "CVX SDEdit": _dwm(19.424, 0.675, 0.464, 0.257),
                "CVX-Fun, fine-tuned": _dwm(20.541, 0.767, 0.370, 0.175),
                "DWM": _dwm(25.031, 0.844, 0.289, 0.086),
            },
            "real_static": {
                "CVX SDEdit": _dwm(16.194, 0.586, 0.446, 0.224),
                "CVX-Fun, fine-tuned": _dwm(18.951, 0.780, 0.265, 0.089),
                "InterDyn": _dwm(19.331, 0.744, 0.240, 0.135),
                "DWM": _dwm(21.547, 0.816, 0.227, 0.057),
            },
            "real_dynamic": {
                "CVX SDEdit": _dwm(19.154, 0.507, 0.676, 0.492),
                "CVX-Fun, fine-tuned": _dwm(18.129, 0.472, 0.591, 0.328),
                "DWM": _dwm(21.654, 0.550, 0.557, 0.225),
            },
        },
    ),
    "dwm_2": _dwm_table(
        title="DWM: Table 2, data sets of the training",
        groups=_SETS,
        published={
            name: {"TRUMANS alone": alone, "TRUMANS and TASTE-Rob": both}
            for name, alone, both in (
                (
                    "synthetic_dynamic",
                    _dwm(24.151, 0.834, 0.304, 0.093),
                    _dwm(25.031, 0.844, 0.289, 0.086),
                ),
                (
                    "real_static",
                    _dwm(17.959, 0.766, 0.304, 0.124),
                    _dwm(21.547, 0.816, 0.227, 0.057),
                ),
                (
                    "real_dynamic",
                    _dwm(20.654, 0.520, 0.543, 0.273),
                    _dwm(21.654, 0.550, 0.557, 0.225),
                ),
            )
        },
    ),
    "dwm_3": _dwm_table(
        title="DWM: Table 3, conditioning on hands",
        groups={"synthetic_dynamic": _SETS["synthetic_dynamic"]},
        published={
            "synthetic_dynamic": {
                "AdaLN, global": _dwm(21.962, 0.806, 0.306, 0.127),
                "AdaLN, per frame": _dwm(22.789, 0.827, 0.288, 0.110),
                "hand mask": _dwm(22.876, 0.797, 0.338, 0.137),
                "DWM": _dwm(24.151, 0.834, 0.304, 0.094),
            }
        },
    ),
    "dwm_4": _dwm_table(
        title="DWM: Table 4, initial weights, by training step",
        groups={"synthetic_dynamic": f"{_SETS['synthetic_dynamic']}; in the paper not stated"},
        published={
            "synthetic_dynamic": {
                f"{name}, step {1000 * number}": {"dreamsim": value}
                for name, values in (
                    ("image-to-video", (0.337, 0.240, 0.221, 0.150, 0.103)),
                    ("DWM", (0.110, 0.166, 0.098, 0.103, 0.088)),
                )
                for number, value in enumerate(values)
            }
        },
    ),
}
"""Tables by name."""
