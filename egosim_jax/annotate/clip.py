"""Annotation of one clip: run the stages, store their results and write the clip's files.

work/ID/            journal and results of finished stages; removed when the clip is done
ID/                 the triplet's files, in the layout of `data/metadata.py`
ID/action.npz       world_from_camera, intrinsics_px and joints_m, which `egosim episode` reads
ID/depth.npz        depth_m of the first frame, infinite where unknown
ID/masks.npz        pixels of hands and arms in each frame, for `egosim robot render`
ID/state            the scene (`state/snapshot.py`)
ID/annotation.json  choices and measurements, or the reason of a refusal; written last
"""

from __future__ import annotations

import shutil
import time
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.annotate import record as records
from egosim_jax.annotate.config import AnnotateConfig, Estimators
from egosim_jax.annotate.frames import plan, read_frames
from egosim_jax.annotate.prepare import RefusedError
from egosim_jax.annotate.record import Record
from egosim_jax.annotate.scene import FIRST_STAGES, STAGES, check_prior, to_triplet
from egosim_jax.annotate.stages import Stage
from egosim_jax.data.clips import write_clip
from egosim_jax.data.recording import Recording
from egosim_jax.data.sheet import SheetClip, draw_sheet
from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.bounded import quote_path, read_json
from egosim_jax.io.journal import Journal
from egosim_jax.io.run import write_json, write_text
from egosim_jax.io.untrusted.npz import MAX_PACKED_BYTES, read_arrays
from egosim_jax.runtime.failures import system_failure
from egosim_jax.runtime.phases import phase
from egosim_jax.state import snapshot
from egosim_jax.types import InputError
from egosim_jax.types.arrays import Masks

ANNOTATION, SHEET, WORK = "annotation.json", "sheet.jpg", "work"
MASKS = "masks.npz"
FINAL = ("done", "refused")
"""Statuses of clips that are not annotated again; failed clips are retried."""
MOMENTS = 6
"""Number of frames of each video on a clip's contact sheet."""
SHEET_PX = 208
"""Width of a frame on the contact sheet in pixels."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """One clip to annotate: paths and small values only, cheap to send to other processes."""

    video_id: str
    """Unique id of the clip."""
    recording: str
    """Folder of the recording."""
    start: int
    """First frame, at the clip's frame rate."""
    stop: int
    """End frame, exclusive, at the clip's frame rate."""
    figures: Mapping[str, float]
    """Quality figures of the clip (`prepare.Quality`)."""
    focal_px: float | None = None
    """Focal length in pixels of the clip, estimated from other clips of the video."""


def annotate(
    job: Job, out: Path, config: AnnotateConfig, estimators: Estimators, *, first_only: bool = False
) -> str:
    """Annotate a clip; return its status: done, refused, failed or (with `first_only`) started.

    Finished stages are not repeated. An unexpected error counts as a failure of this clip, with a
    traceback in `work`. System failures, such as a full disk, end the run.
    """
    if is_final(job, out):
        return read_annotation(job.video_id, out)["status"]
    notes: dict[str, Any] = {}
    try:
        record = _run_stages(job, out, config, estimators, notes, first_only=first_only)
        if record is None:
            return "started"
        last = len(STAGES) + 1
        about = f"{job.video_id}: draws and writes the clip, stage {last} of {last}"
        with phase(about, only_if_long=True):
            _write(job, out, config, record, notes)
        status = "done"
    except RefusedError as refused:
        status = "refused"
        notes |= {"rule": refused.rule, "reason": str(refused), "figures": refused.figures}
    except InputError as error:
        status, notes["reason"] = "failed", str(error)
    except Exception as error:
        if system_failure(error) is not None:
            raise
        status, notes["reason"] = "failed", f"{type(error).__name__}: {error}"
        write_text(out / WORK / job.video_id / "traceback.txt", traceback.format_exc())
    finish(job, out, config, status, notes)
    return status


def read_annotation(video_id: str, out: Path) -> dict[str, Any]:
    """Return the annotation of a clip; empty if it was not annotated."""
    path = out / video_id / ANNOTATION
    return read_json(path) if path.exists() else {}


def is_final(job: Job, out: Path) -> bool:
    """Return True if a clip needs no further attempt."""
    about = read_annotation(job.video_id, out)
    return about.get("status") in FINAL and not (can_retry(about) and job.focal_px is not None)


def can_retry(about: Mapping[str, Any]) -> bool:
    """Return True if no cameras were found, and a known focal length may still help."""
    return about.get("rule") == "cameras" and about.get("focal_px") is None


def finish(
    job: Job, out: Path, config: AnnotateConfig, status: str, notes: Mapping[str, Any]
) -> None:
    """Write the annotation of a clip; if there is no triplet, draw its video instead."""
    folder = out / job.video_id
    if status != "done":
        _draw_refused(job, out, config)
    about = {
        "video_id": job.video_id,
        "status": status,
        "start": job.start,
        "stop": job.stop,
        "quality": dict(job.figures),
        "focal_px": job.focal_px,
        **notes,
    }
    write_json(folder / ANNOTATION, about)
    if status != "failed" and not can_retry(about):
        shutil.rmtree(out / WORK / job.video_id, ignore_errors=True)


def open_record(job: Job, config: AnnotateConfig) -> Record:
    """Return the initial record of a clip, with its frames."""
    recording = Recording.load(Path(job.recording))
    fitted = plan(recording, config.sampling, cut=config.cutting.clips)
    frames = read_frames(recording, fitted, job.start, job.stop)
    numbers = fitted.indices(job.start, job.stop)[: len(frames)]
    first, last = numbers[[0, -1]]
    return Record(
        video_id=job.video_id,
        recording=recording.clip(int(first), int(last) + 1),
        plan=fitted,
        frames=frames,
        source_frames=numbers - first,
        device_focal_px=job.focal_px,
    )


def _run_stages(
    job: Job,
    out: Path,
    config: AnnotateConfig,
    estimators: Estimators,
    notes: dict[str, Any],
    *,
    first_only: bool,
) -> Record | None:
    """Run the stages or load their results; return the record, or None with `first_only`.

    Each finished stage adds its notes and time to `notes`, which survive an error of a later stage.
    """
    import cv2

    folder = out / WORK / job.video_id
    journal = Journal(folder)
    chosen = STAGES[:FIRST_STAGES] if first_only else STAGES
    stored = [stage.name for stage in chosen if stage.stored]
    if first_only and all(name in journal.done for name in stored):
        return None
    with phase(f"{job.video_id}: reads the video", only_if_long=True):
        record = open_record(job, config)
    times = notes.setdefault("seconds", {})
    for number, stage in enumerate(chosen, start=1):
        cv2.setRNGSeed(config.seed % 2**31)  # per stage: a resumed clip gets the same results
        then = time.monotonic()
        about = f"{job.video_id}: {stage.name}, stage {number} of {len(STAGES) + 1}"
        with phase(about, only_if_long=True):
            if stage.stored:
                record = _stored(journal, folder, stage, record, estimators, config)
                times[stage.name] = journal.done[stage.name]["seconds"]
            else:
                record = stage.run(record, estimators, config)
                times[stage.name] = round(time.monotonic() - then, 3)
        notes |= record.notes
    return None if first_only else record


def _stored(
    journal: Journal,
    folder: Path,
    stage: Stage,
    record: Record,
    estimators: Estimators,
    config: AnnotateConfig,
) -> Record:
    return journal.phase(
        stage.name,
        folder / f"{stage.name}.npz",
        make=lambda: stage.run(record, estimators, config),
        save=lambda path, result: records.save(path, result, stage.stored, stage.name),
        load=lambda path: records.load(path, record, stage.stored, stage.name),
    )


def write_masks(path: Path, hands: Masks) -> None:
    """Write the pixels of hands, eight in a byte: compressed if they are read so."""
    bits = np.packbits(hands, axis=2)
    write = np.savez_compressed if bits.nbytes < MAX_PACKED_BYTES else np.savez
    with atomic_write(path) as temporary:
        write(temporary, hands=bits)


def read_masks(path: Path, shape: tuple[int, int, int]) -> Masks:
    """Read the pixels of hands in frames of this shape. Raises `InputError` if they differ."""
    bits = read_arrays(path, {"hands": "uint8"}, packed=True)["hands"]
    frames, height, width = shape
    if bits.shape != (frames, height, -(-width // 8)):
        raise InputError(
            f"{quote_path(path)} has masks of {bits.shape} bytes, the video {shape} pixels, eight "
            "to a byte: they must agree. Annotate the clip again."
        )
    return np.unpackbits(bits, axis=2, count=width).astype(bool)


def _write(
    job: Job, out: Path, config: AnnotateConfig, record: Record, notes: dict[str, Any]
) -> None:
    """Write the triplet, its cameras, joints, depth, masks and state, and a contact sheet."""
    then = time.monotonic()
    triplet, figures = to_triplet(record, config)
    check_prior(record.require("estimate").verdict.rung, figures, config)
    folder, cameras = out / job.video_id, record.cameras
    notes["row"] = write_clip(out, triplet, fps=record.fps)
    with atomic_write(folder / "action.npz") as temporary:
        np.savez(
            temporary,
            world_from_camera=np.asarray(cameras.world_from_camera, float),
            intrinsics_px=np.asarray(cameras.intrinsics_px, float),
            joints_m=np.asarray(record.joints_m, float),
        )
    with atomic_write(folder / "depth.npz") as temporary:
        np.savez(temporary, depth_m=record.require("depth").depth_m[0])
    write_masks(folder / MASKS, record.moving)
    snapshot.save(folder / "state", record.require("state"))
    mask = np.repeat(triplet.mask[..., None], 3, axis=-1)
    videos = {
        "prior": triplet.prior,
        "mask": mask,
        "hands": triplet.hands,
        "video": record.frames,
    }
    _draw(folder, f"{job.video_id}: {', '.join(videos)}", list(videos.values()))
    notes["prior"] = figures
    notes["video"] = {
        "file": str(record.recording.video),
        "fps": float(record.fps),
        "source_fps": float(record.plan.source_fps),
        "frames": len(record.frames),
        "height": record.plan.height,
        "width": record.plan.width,
        "scale": record.plan.scale,
    }
    notes["seconds"]["write"] = round(time.monotonic() - then, 3)


def _draw_refused(job: Job, out: Path, config: AnnotateConfig) -> None:
    """Draw frames of a clip without a triplet, if its video is readable."""
    picked = np.linspace(job.start, job.stop - 1, MOMENTS).astype(int)
    try:
        recording = Recording.load(Path(job.recording))
        fitted = plan(recording, config.sampling, cut=config.cutting.clips)
        shown = [read_frames(recording, fitted, int(k), int(k) + 1) for k in picked]
    except InputError:
        return
    _draw(out / job.video_id, f"{job.video_id}: video", [np.concatenate(shown)])


def _draw(folder: Path, title: str, videos: list[np.ndarray]) -> None:
    last = len(videos[0]) - 1
    moments = [last * k // (MOMENTS - 1) for k in range(MOMENTS)]
    draw_sheet([SheetClip(title, videos)], folder / SHEET, moments=moments, width=SHEET_PX)
