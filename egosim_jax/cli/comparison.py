"""Options that `egosim evaluate` and `egosim table` share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from egosim_jax.runtime.command import HelpGroups
from egosim_jax.runtime.terminal import print_line
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from egosim_jax.data.clip_files import ClipFiles
    from egosim_jax.evaluation.measures import Measure
    from egosim_jax.evaluation.methods import Folder, Method
    from egosim_jax.evaluation.result import Evaluation
    from egosim_jax.evaluation.scoring import Protocol
    from egosim_jax.perception.video.estimates import DepthEstimator

Baseline = Literal["prior", "prior_fit", "still"]
Network = Literal["alex", "vgg"]


@dataclass(frozen=True, kw_only=True)
class Options:
    """Clips, baselines and measures of a comparison."""

    help_groups: ClassVar[HelpGroups] = {
        "measures": (
            "lpips",
            "dreamsim",
            "regions",
            "hands",
            "cameras",
            "depth",
            "fvd",
            "metrics",
            "device",
        ),
        "page": ("baselines", "page_clips"),
    }
    metadata: Path
    """CSV or JSONL with EgoSim's columns, including video."""
    generated: tuple[str, ...]
    """Folders of {id}.mp4, each as DIR or NAME=DIR.

    A clip may also be in a subfolder named after its dataset or split. If a folder has a
    results.jsonl, it lists the clips and windows. Paired differences are from the first folder.
    Several folders of one NAME are seeds of one method, and their scores are averaged by clip."""
    where: str | None = None
    """Select rows by the value of a column, for instance split=test."""
    baselines: tuple[Baseline, ...] = ("prior", "prior_fit", "still")
    """Baselines without a model: the prior, the prior with fitted colors, and frame 0 repeated."""
    lpips: tuple[Network, ...] = ("alex",)
    """Networks of LPIPS (extra `metrics`)."""
    dreamsim: Path | None = None
    """Folder of DreamSim's ensemble: its unpacked release v0.2.0-checkpoints."""
    regions: bool = False
    """Also PSNR near the drawn hands, and of the object if there is an object_mask_video.mp4."""
    hands: bool = False
    """Also IoU, keypoint error and recall of the hands detected in both videos (extra `video`)."""
    cameras: bool = False
    """Also the error of the camera path, estimated from both videos (extra `video`)."""
    depth: Path | None = None
    """Folder of Depth Anything V2 (metric) or 3: also the depth error (extra `networks`)."""
    fvd: Path | None = None
    """Folder of a VideoMAE: also the Fréchet video distance (extra `networks`)."""
    metrics: tuple[str, ...] = ()
    """Your own metrics, each as MODULE:NAME or an entry point of egosim_jax.metrics."""
    device: str = "auto"
    """Device of the networks: cpu, cuda, cuda:N, or auto for the first GPU if there is one."""
    page_clips: int = 8
    """Maximum number of clips of each group on the page; 0: no page and no scores.png."""

    def read_clips(self) -> list[ClipFiles]:
        """Read the selected rows of the metadata."""
        from egosim_jax.data.metadata import read_metadata, select

        return select(read_metadata(self.metadata), where=self.where)

    def methods(self, folders: Sequence[Folder]) -> list[Method]:
        """Return the rows of the table. Raises `InputError` if names are repeated."""
        from egosim_jax.evaluation.methods import BASELINES, check_names

        methods: list[Method] = [*folders, *(BASELINES[name] for name in self.baselines)]
        check_names(methods)
        return methods

    def measures(self, networks: Sequence[Network]) -> tuple[list[Measure], list[str]]:
        """Return the available measures, and the reason for each unavailable one."""
        from egosim_jax.evaluation.measures import (
            METRICS,
            dreamsim_distance,
            lpips_distance,
            pixels,
        )
        from egosim_jax.evaluation.metrics import lpips
        from egosim_jax.evaluation.metrics.dreamsim import DreamSim

        measures: list[Measure] = [pixels()]
        unavailable: list[str] = []
        for name in networks:
            network = lpips.load_if_installed(name)
            if network is None:
                unavailable.append(f"lpips_{name}: {lpips.MISSING}")
            else:
                measures.append(lpips_distance(network, name))
        if self.dreamsim is not None:
            measures.append(dreamsim_distance(DreamSim(self.dreamsim)))
        added = [METRICS.parse(name) for name in self.metrics]
        return [*measures, *self._estimated(), *added], unavailable

    def _estimated(self) -> Iterator[Measure]:
        """Yield the measures that need estimates or networks."""
        from egosim_jax.evaluation import estimated

        if self.regions:
            yield estimated.regions()
        if self.hands:
            from egosim_jax.perception.video.hands import LandmarkHands

            yield estimated.hands(LandmarkHands())
        if self.cameras:
            from egosim_jax.perception.video.cameras import CameraLadder

            yield estimated.cameras(CameraLadder())
        if self.depth is not None:
            yield estimated.depth(self._depth_network(self.depth))
        if self.fvd is not None:
            from egosim_jax.evaluation.fvd import features
            from egosim_jax.perception.networks import VideoMae

            yield features(VideoMae(self.fvd, device=self.device))

    def _depth_network(self, folder: Path) -> DepthEstimator:
        from egosim_jax.io.bounded import read_json
        from egosim_jax.perception.networks import DepthAnything, DepthAnything3

        config = folder / "config.json"
        content = read_json(config) if config.is_file() else {}
        third = isinstance(content, dict) and "model_name" in content
        return (DepthAnything3 if third else DepthAnything)(folder, device=self.device)

    def compare(
        self,
        folders: Sequence[Folder],
        clips: Sequence[ClipFiles],
        *,
        protocol: Protocol,
        out: Path,
        title: str,
        networks: Sequence[Network],
        **result: Any,
    ) -> Evaluation:
        """Compare the clips, print the table and write its files to a folder."""
        from egosim_jax.evaluation import pages
        from egosim_jax.evaluation.evaluate import compare
        from egosim_jax.evaluation.files import draw
        from egosim_jax.evaluation.metrics.dreamsim import MISSING

        if self.page_clips < 0:
            raise InputError(
                f"The number of clips must be at least 0, not {self.page_clips}. (--page-clips)"
            )
        methods = self.methods(folders)
        measures, unavailable = self.measures(networks)
        extra = [key for m in measures[1:] for key in m.columns if key not in result["shown"]]
        if "dreamsim" in result["shown"] and self.dreamsim is None:
            unavailable.append(f"dreamsim: {MISSING}")
        result["shown"] = (*result["shown"], *extra)
        paged = self.page_clips > 0 and pages.can_be_written()
        if self.page_clips and not paged:
            unavailable.append(f"{pages.PAGE}: {pages.MISSING}")
        evaluation = compare(
            methods, clips, measures, protocol=protocol, out=out, unavailable=unavailable, **result
        )
        if self.page_clips:
            draw(evaluation, out / "scores.png")
        if paged:
            path = out / pages.PAGE
            pages.write_page(evaluation, methods, path, title=title, clips=self.page_clips)
        evaluation.print()
        print_line(out / (pages.PAGE if paged else "report.json"))
        return evaluation
