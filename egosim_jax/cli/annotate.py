"""`egosim data annotate`: make annotated clips from recorded videos."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import tyro

from egosim_jax.io.bounded import listing
from egosim_jax.perception.video.estimates import ChosenRung
from egosim_jax.rendering import PriorKind, RendererName
from egosim_jax.runtime.command import ExitCode, HelpGroups
from egosim_jax.runtime.progress import track
from egosim_jax.runtime.terminal import counted, print_line, printable
from egosim_jax.types import check_counts

if TYPE_CHECKING:
    from egosim_jax.annotate.clip import Job
    from egosim_jax.annotate.config import AnnotateConfig


@dataclass(frozen=True, kw_only=True)
class Annotate:
    """Make clips with prior, mask, hands, first frame and caption from recorded videos.

    VIDEO is a video file, a recording (`egosim data import`), or a folder of either. Values in a
    recording are used; hands, cameras, depth and scale that it lacks are estimated. No network
    weights are needed unless an option names their folder. Writes a folder for each clip,
    report.json, index.html, and a metadata.csv that `data pack`, `generate` and `train` read. A
    video without a usable clip is reported with the reason (exit code 3). The same command resumes
    an interrupted run. Prints the folder.
    """

    help_groups: ClassVar[HelpGroups] = {
        "format": ("size", "fps", "num_frames", "split", "caption"),
        "selection": (
            "min_hands", "min_sharpness", "max_black", "min_motion", "max_motion",
            "min_prior_gain",
        ),
        "hands and masks": ("hand_weights", "side", "masks", "detector", "phrases"),
        "cameras and scene": (
            "focal", "rung", "depth_unit", "scale", "camera_height", "state", "renderer", "prior",
        ),
        "run": (
            "device", "dtype", "offline", "workers", "ray", "ray_gpus", "ray_actors", "seed",
        ),
    }  # fmt: skip
    videos: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="VIDEO ...")]
    """Videos, recordings, or folders of them."""
    out: Path
    """Folder of the clips, metadata.csv and the report."""
    config: str | None = None
    """Model whose size, frame rate and length the clips get, instead of the video's."""
    size: tuple[int, int] | None = None
    """Height and width of the clips, multiples of 16."""
    fps: float | None = None
    """Frames per second of the clips; by default the video's, at most 60."""
    num_frames: int | None = None
    """Number of frames in a clip, 4k + 1; by default all."""
    clips: bool = False
    """Cut videos at shot changes; keep clips that are sharp, moving and show hands."""
    min_hands: float = 0.5
    """Minimum fraction of frames in which a hand is visible."""
    min_sharpness: float = 15.0
    """Minimum sharpness: variance of the Laplacian at 320 pixels, median over frames."""
    max_black: float = 0.0
    """Maximum fraction of black frames."""
    min_motion: float = 0.005
    """Minimum speed of the fastest motion, in image widths per second."""
    max_motion: float = 1.5
    """Maximum speed of the camera motion, in image widths per second."""
    min_prior_gain: float = -2.0
    """Minimum PSNR of the prior minus PSNR of the repeated first frame, in decibels."""
    hand_weights: Path | None = None
    """Folder of the hand networks; fetched at first use if not given."""
    offline: bool = False
    """Download nothing: stop with an error if files are missing."""
    side: Literal["auto", "left", "right"] = "auto"
    """Side of all hands; auto: as detected."""
    masks: str = "geometry"
    """Silhouettes of hands and objects: geometry, sam3=FOLDER, or a tracker with --detector.

    Trackers are grounded-sam3=FOLDER, grounded-sam2=FOLDER and grounded-edgetam=FOLDER."""
    detector: Path | None = None
    """Folder of Grounding DINO, which detects the objects for a tracker."""
    device: str = "auto"
    """Device of the networks: cpu, cuda, cuda:N, or auto for the first GPU if there is one."""
    dtype: Literal["float32", "bfloat16", "float16"] = "float32"
    """Floating-point type of the networks; Depth Anything 3 chooses its own."""
    phrases: tuple[str, ...] = ()
    """Names of the objects to segment."""
    cameras: str = "ladder"
    """Cameras: ladder (methods without weights, tried in turn) or depth-anything-3=FOLDER."""
    focal: float | None = None
    """Focal length in pixels of the video, instead of an estimate."""
    rung: ChosenRung | None = None
    """Camera method to try, instead of all of the ladder."""
    depth: str = "sweep"
    """Depth: sweep, depth-anything=FOLDER, depth-pro=FOLDER, depth-anything-3=FOLDER, files=FOLDER.

    files: one FOLDER/ID/000000.png (16 bits, millimeters) or .npy (meters) per frame."""
    depth_unit: float | None = None
    """Length in meters of a unit of depth files and of recorded depth, such as 0.0001."""
    scale: float | None = None
    """Meters per unit of the cameras, instead of an estimate from the hands."""
    camera_height: float | None = None
    """Height in meters of the camera above the table or floor, from which the scale follows."""
    state: Literal["first", "fused"] = "first"
    """Scene of the prior: the first frame, as in EgoSim's training, or fused key frames."""
    caption: str | None = None
    """Caption of all clips, or qwen=FOLDER to caption each clip by Qwen."""
    renderer: RendererName = "jax"
    """Renderer of prior and hands."""
    prior: PriorKind | None = None
    """Places of the objects in the prior; by default as the model of --config has them.

    static: as in the first frame; predicted: where the hands move them."""
    split: str = "train"
    """Value of the column `split` in metadata.csv, for all clips."""
    workers: int = 1
    """Number of worker processes."""
    ray: str | None = None
    """Run on a Ray cluster: auto for a local one, or its address."""
    ray_gpus: tuple[float, float] = (0.0, 0.0)
    """GPUs per actor: for hands and masks, and for the other stages."""
    ray_actors: tuple[int, int] = (1, 1)
    """Maximum number of actors: for hands and masks, and for the other stages."""
    seed: int = 0
    """Random seed."""

    def run(self) -> int:
        """Scan the videos, annotate their clips and write the report."""
        from egosim_jax.annotate import run
        from egosim_jax.annotate.sources import find_sources
        from egosim_jax.io.atomic import lock_folder

        check_counts({"--workers": self.workers})
        config = self._config()
        sources = find_sources(self.videos)
        config.build().prepare()
        with lock_folder(self.out):
            run.require_config(self.out, config)
            scans = run.scan_sources(sources, self.out, config, workers=self.workers)
            scanned = list(track(scans, "scanning", total=len(sources)))
            jobs = run.choose_jobs(scanned, self.out, config)
            for _ in track(self._annotate(jobs, config), "annotating", total=len(jobs)):
                pass
            retries = run.choose_retries(scanned, self.out)
            if retries:
                for _ in track(self._annotate(retries, config), "retrying", total=len(retries)):
                    pass
            report = run.write_report(scanned, self.out)
        return self._finish(report)

    def _annotate(self, jobs: Sequence[Job], config: AnnotateConfig) -> Iterator[str]:
        """Annotate clips on this machine or on Ray; yield the status of each."""
        from egosim_jax.annotate import run

        if self.ray is None:
            return run.annotate_jobs(jobs, self.out, config, workers=self.workers)
        from egosim_jax.annotate.cluster import annotate_on_ray

        gpus, actors = self.ray_gpus, self.ray_actors
        return annotate_on_ray(jobs, self.out, config, address=self.ray, gpus=gpus, actors=actors)

    def _finish(self, report: dict) -> int:
        from egosim_jax.annotate.gallery import HIDDEN, hides_scene, summary

        counts = report["clips"]
        empty = [name for name, video in report["videos"].items() if not video["done"]]
        for name, video in report["videos"].items():
            if "problem" in video:
                print(printable(f"{name}: no clip: {video['problem']}"), file=sys.stderr)
            if "note" in video:
                print(printable(f"{name}: {video['note']}"), file=sys.stderr)
        reasons: dict[str, list[str]] = {}
        for about in report["annotations"]:
            if about.get("reason"):
                reasons.setdefault(about["reason"], []).append(about["video_id"])
        for reason, names in reasons.items():
            print(printable(f"{listing(names)}: no annotation: {reason}"), file=sys.stderr)
        cameras = [about["cameras"] for about in report["annotations"] if about.get("cameras")]
        assumed = [camera for camera in cameras if camera["focal_source"] == "assumed"]
        if assumed:
            print(
                f"{counted(len(assumed), 'clip')} without a known focal length: a view of 90 "
                "degrees is assumed, so it is half of the video's longer side. Give it, in pixels "
                "of the video, if you know it. (--focal)",
                file=sys.stderr,
            )
        if hidden := [a["video_id"] for a in report["annotations"] if hides_scene(a)]:
            print(printable(f"{listing(hidden)}: {HIDDEN}"), file=sys.stderr)
        page = self.out / "index.html"
        print(printable(f"{summary(report)}; see {page}"), file=sys.stderr)
        print_line(self.out)
        return ExitCode.PARTIAL if empty or counts["failed"] else ExitCode.DONE

    def _config(self) -> AnnotateConfig:
        from egosim_jax.annotate.config import AnnotateConfig
        from egosim_jax.annotate.frames import Sampling
        from egosim_jax.annotate.prepare import Cutting, Quality

        size, fps, count, prior = self.size, self.fps, self.num_frames, self.prior or "static"
        if self.config is not None:
            from egosim_jax import configs

            model = configs.get(self.config)
            video, prior = model.video, self.prior or model.prior
            size = size or (video.height, video.width)
            fps, count = fps or float(video.fps), count or video.frames
        quality = Quality(
            min_hands=self.min_hands,
            min_sharpness=self.min_sharpness,
            max_black=self.max_black,
            min_motion=self.min_motion,
            max_motion=self.max_motion,
            min_prior_gain_db=self.min_prior_gain,
        )
        return AnnotateConfig(
            sampling=Sampling(size=size, fps=fps, num_frames=count),
            cutting=Cutting(clips=self.clips, quality=quality),
            hand_weights=self.hand_weights,
            offline=self.offline,
            side=self.side,
            masks=self.masks,
            detector=self.detector,
            device=self.device,
            dtype=self.dtype,
            phrases=self.phrases,
            cameras=self.cameras,
            focal_px=self.focal,
            rung=self.rung,
            depth=self.depth,
            depth_unit_m=self.depth_unit,
            scale=self.scale,
            camera_height_m=self.camera_height,
            state=self.state,
            caption=self.caption,
            renderer=self.renderer,
            prior=prior,
            split=self.split,
            seed=self.seed,
        )
