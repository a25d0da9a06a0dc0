"""`egosim data annotate`: clips with prior, mask, hands and caption from recorded videos."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import tyro

from egosim_jax.perception.estimates import ChosenRung
from egosim_jax.rendering import RendererName
from egosim_jax.runtime.command import ExitCode, HelpGroups
from egosim_jax.runtime.progress import track
from egosim_jax.types import check_counts

if TYPE_CHECKING:
    from egosim_jax.annotate.clip import Job
    from egosim_jax.annotate.config import AnnotateConfig


@dataclass(frozen=True, kw_only=True)
class Annotate:
    """Make clips with prior, mask, hands, first frame and caption from recorded videos.

    VIDEO is a video file, a recording (`egosim data import`), or a folder of either. Hands,
    cameras, depth and scale are estimated, without network weights unless a folder of them is
    given; what a recording knows is taken from it. Writes a folder for each clip, a metadata.csv
    that `data pack`, `generate` and `train` read, report.json, and index.html to look at. A video
    that gives no clip is reported with the reason (exit code 3). The same command resumes an
    interrupted one. Prints the folder.
    """

    help_groups: ClassVar[HelpGroups] = {
        "format": ("size", "fps", "num_frames", "split", "caption"),
        "selection": (
            "min_hands", "min_sharpness", "max_black", "min_motion", "max_motion",
            "min_prior_gain",
        ),
        "hands and masks": ("hand_weights", "side", "masks", "detector", "phrases"),
        "cameras and scene": (
            "focal", "rung", "scale", "camera_height", "state", "renderer",
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
    """Model whose size, rate and length the clips have; those of the video if not given."""
    size: tuple[int, int] | None = None
    """Height and width of the clips, multiples of 16."""
    fps: float | None = None
    """Frames per second of the clips, by default the video's, up to 60."""
    num_frames: int | None = None
    """Frames of a clip, 4k + 1, by default all."""
    clips: bool = False
    """Cut videos into clips by shot; each clip must be sharp, moving, and show hands."""
    min_hands: float = 0.5
    """Smallest fraction of frames in which a hand is visible."""
    min_sharpness: float = 15.0
    """Smallest sharpness: median over frames of the Laplacian's variance at 320 pixels."""
    max_black: float = 0.0
    """Largest fraction of black frames."""
    min_motion: float = 0.005
    """Smallest motion of what moves fastest, in widths of the image per second."""
    max_motion: float = 1.5
    """Largest motion of the camera, in widths of the image per second."""
    min_prior_gain: float = -2.0
    """Smallest PSNR of the prior in decibels, compared with that of the first frame repeated."""
    hand_weights: Path | None = None
    """Folder of the hand networks; fetched at first use if not given."""
    offline: bool = False
    """Fetch nothing: refuse if something is missing."""
    side: Literal["auto", "left", "right"] = "auto"
    """Side of all hands, instead of what is recognized."""
    masks: str = "geometry"
    """Silhouettes of hands and objects: geometry, sam3=FOLDER, or a tracker with --detector.

    Trackers are grounded-sam3=FOLDER, grounded-sam2=FOLDER and grounded-edgetam=FOLDER."""
    detector: Path | None = None
    """Folder of Grounding DINO, which finds what a tracker follows."""
    device: str = "auto"
    """Device of the networks: cpu, cuda, cuda:N, or auto for the first GPU if there is one."""
    dtype: Literal["float32", "bfloat16", "float16"] = "float32"
    """Floating-point type of the networks, but for Depth Anything 3, which chooses its own."""
    phrases: tuple[str, ...] = ()
    """Objects to segment, by name."""
    cameras: str = "ladder"
    """Cameras: ladder, of methods without weights, or depth-anything-3=FOLDER."""
    focal: float | None = None
    """Focal length of the video in its pixels, instead of estimating it."""
    rung: ChosenRung | None = None
    """Only method of cameras to try."""
    depth: str = "sweep"
    """Depth: sweep, depth-anything=FOLDER, depth-pro=FOLDER, depth-anything-3=FOLDER, files=FOLDER.

    files are FOLDER/ID/000000.png (16 bits, millimeters) or .npy (meters), by frame."""
    scale: float | None = None
    """Meters per unit of the cameras, instead of estimating it from the hands."""
    camera_height: float | None = None
    """Height in meters of the camera above the table or floor, to take the scale from."""
    state: Literal["first", "fused"] = "first"
    """Scene of the prior: from the first frame, as EgoSim trains, or fused from key frames."""
    caption: str | None = None
    """Caption of all clips, or qwen=FOLDER to write one for each."""
    renderer: RendererName = "jax"
    """Renderer of prior and hands."""
    split: str = "train"
    """Value of the column split of metadata.csv, for all clips."""
    workers: int = 1
    """Number of worker processes."""
    ray: str | None = None
    """Run on a Ray cluster: auto for a local one, or its address."""
    ray_gpus: tuple[float, float] = (0.0, 0.0)
    """GPUs of an actor for hands and masks, and of one for the other stages."""
    ray_actors: tuple[int, int] = (1, 1)
    """Largest number of actors for hands and masks, and for the other stages."""
    seed: int = 0
    """Seed of what is random."""

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
            for _ in track(self._annotate(retries, config), "retrying", total=len(retries)):
                pass
            report = run.write_report(scanned, self.out)
        return self._finish(report)

    def _annotate(self, jobs: Sequence[Job], config: AnnotateConfig) -> Iterator[str]:
        """Annotate clips here or on Ray; yield the status of each."""
        from egosim_jax.annotate import run

        if self.ray is None:
            return run.annotate_jobs(jobs, self.out, config, workers=self.workers)
        from egosim_jax.annotate.cluster import annotate_on_ray

        gpus, actors = self.ray_gpus, self.ray_actors
        return annotate_on_ray(jobs, self.out, config, address=self.ray, gpus=gpus, actors=actors)

    def _finish(self, report: dict) -> int:
        counts = report["clips"]
        empty = {name: video for name, video in report["videos"].items() if not video["done"]}
        reasons = {
            about["source"]: about["reason"] for about in report["annotations"] if "reason" in about
        }
        for name, video in empty.items():
            reason = video.get("problem") or reasons.get(name)
            print(f"{name}: no clip: {reason}", file=sys.stderr)
        print(
            f"{counts['done']} clips done, {counts['refused']} refused, {counts['failed']} failed; "
            f"see {self.out / 'index.html'}",
            file=sys.stderr,
        )
        print(self.out)
        return ExitCode.PARTIAL if empty or counts["failed"] else ExitCode.DONE

    def _config(self) -> AnnotateConfig:
        from egosim_jax.annotate.config import AnnotateConfig
        from egosim_jax.annotate.frames import Sampling
        from egosim_jax.annotate.prepare import Cutting, Quality

        size, fps, count = self.size, self.fps, self.num_frames
        if self.config is not None:
            from egosim_jax import configs

            video = configs.get(self.config).video
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
            scale=self.scale,
            camera_height_m=self.camera_height,
            state=self.state,
            caption=self.caption,
            renderer=self.renderer,
            split=self.split,
            seed=self.seed,
        )
