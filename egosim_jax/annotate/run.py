"""Annotation of many videos: scan them, annotate their clips in parallel, write the report.

    OUT/journal.jsonl        the configuration; a different one is refused
    OUT/work/recordings/ID   the recording of each video
    OUT/work/scans/ID.json   its clips, or the reason why it has none
    OUT/ID/                  each clip (`clip`)
    OUT/metadata.csv         the accepted clips
    OUT/report.json          all clips and videos, with reasons
    OUT/index.html           a page of all clips

Files are written atomically and existing files are kept: the same command resumes after an
interruption at any time, and other videos are added. Unreadable videos are reported, and the other
videos are annotated.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from egosim_jax.annotate import clip
from egosim_jax.annotate.clip import ANNOTATION, WORK, Job
from egosim_jax.annotate.config import AnnotateConfig
from egosim_jax.annotate.frames import plan
from egosim_jax.annotate.gallery import write_page
from egosim_jax.annotate.prepare import scan, windows
from egosim_jax.annotate.sources import Source, open_source
from egosim_jax.data.clips import write_table
from egosim_jax.io.bounded import quote_path, read_json
from egosim_jax.io.journal import Journal
from egosim_jax.io.run import plain, write_json
from egosim_jax.runtime.command import CommandExit, ExitCode
from egosim_jax.runtime.processes import run_in_processes
from egosim_jax.runtime.terminal import check_utf8
from egosim_jax.types import InputError

T = TypeVar("T")
CALIBRATED = ("incremental", "global")
"""Rungs that estimate a focal length."""
REPORT, METADATA = "report.json", "metadata.csv"


@dataclass(frozen=True)
class Scanned:
    """Result of scanning one video."""

    source: str
    """Id of the video."""
    jobs: tuple[Job, ...] = ()
    """Clips of the video to annotate."""
    refused: tuple[tuple[Job, str, str], ...] = ()
    """Clips that were refused before any stage, with rule and reason."""
    problem: str | None = None
    """Reason why the video has no clips, if so."""
    note: str | None = None
    """Part of the video that is annotated, unless it is all."""


def require_config(out: Path, config: AnnotateConfig) -> None:
    """Record the configuration. Raises `InputError` if the folder has clips of another one."""
    journal = Journal(out, outputs=(REPORT, f"*/{ANNOTATION}"))
    journal.require("annotate", {name: str(value) for name, value in _flat(plain(config)).items()})


def _flat(value: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, item in value.items():
        if isinstance(item, Mapping):
            flat |= _flat(item, f"{prefix}{name}.")
        elif name != "type":
            flat[f"{prefix}{name}"] = item
    return flat


def scan_source(source: Source, out: Path, config: AnnotateConfig) -> Scanned:
    """Measure a video and choose its clips, or load the earlier result.

    An unreadable video becomes a `problem` in the result. A video with a problem is measured again.
    Raises `InputError` if the video file differs from the scanned one.
    """
    path = out / WORK / "scans" / f"{source.name}.json"
    size = source.path.stat().st_size if source.path.is_file() else 0
    written = read_json(path) if path.exists() else None
    if written is not None and "problem" not in written:
        if written["path"] != str(source.path) or written["bytes"] != size:
            raise InputError(
                f"{source.path} is not the file that {out} was made from: {written['path']} of "
                f"{written['bytes']:,} bytes. Choose another folder. (--out)"
            )
        return _scanned(source.name, out, written)
    about: dict[str, Any] = {"path": quote_path(source.path), "bytes": size, "windows": []}
    try:
        check_utf8(source.path)
        about["path"] = str(source.path)
        recording = open_source(source, config.depth_files, config.depth_unit_m)
        fitted = plan(recording, config.sampling, cut=config.cutting.clips)
        recording.save(_recording_folder(out, source.name))
        length = config.sampling.num_frames
        if length is not None and length < fitted.count and not config.cutting.clips:
            about["note"] = (
                f"of {fitted.count} frames at {float(fitted.fps):.4g} fps, the first {length} are "
                "one clip, and the others are not used. Cut all into clips, or take more. "
                "(--clips, --num-frames)"
            )
        about["windows"] = [
            asdict(window)
            for window in windows(recording, scan(recording, fitted), length, config.cutting)
        ]
        if not about["windows"]:
            about["problem"] = "no shot is long enough for a clip. (--num-frames)"
    except InputError as error:
        about["problem"] = str(error)
    write_json(path, about)
    return _scanned(source.name, out, about)


def _recording_folder(out: Path, name: str) -> Path:
    """Return the folder of a video's recording; it is not stored, because `out` may be moved."""
    return out / WORK / "recordings" / name


def _scanned(name: str, out: Path, about: Mapping[str, Any]) -> Scanned:
    jobs, refused = [], []
    for window in about["windows"]:
        job = Job(
            recording=str(_recording_folder(out, name)),
            **{key: window[key] for key in ("video_id", "start", "stop", "figures")},
        )
        if window["refused"]:
            rule, reason = window["refused"]
            refused.append((job, rule, reason))
        else:
            jobs.append(job)
    return Scanned(name, tuple(jobs), tuple(refused), about.get("problem"), about.get("note"))


def scan_sources(
    sources: Sequence[Source], out: Path, config: AnnotateConfig, *, workers: int
) -> Iterator[Scanned]:
    """Scan videos in parallel; yield each result."""
    yield from _each(scan_source, [(source, out, config) for source in sources], workers)


def annotate_jobs(
    jobs: Sequence[Job], out: Path, config: AnnotateConfig, *, workers: int
) -> Iterator[str]:
    """Annotate clips in parallel; yield the status of each finished clip."""
    yield from _each(_annotate_one, [(job, out, config) for job in jobs], workers)


def _each(run: Callable[..., T], calls: Sequence[tuple[Any, ...]], workers: int) -> Iterator[T]:
    if workers == 1 or len(calls) < 2:
        yield from (run(*call) for call in calls)
        return
    try:
        yield from (result for _, result in run_in_processes(run, calls, workers=workers))
    except BrokenProcessPool as error:
        raise CommandExit(
            "error: a worker process was killed, maybe because memory ran out. Run the same "
            "command again with fewer --workers; finished stages are kept.",
            ExitCode.FAILED,
        ) from error


_built: dict[AnnotateConfig, Any] = {}
"""Estimators of this process; networks are loaded once per process, not per clip."""


def _annotate_one(job: Job, out: Path, config: AnnotateConfig) -> str:
    if config not in _built:
        _built[config] = config.build()
    return clip.annotate(job, out, config, _built[config])


def choose_jobs(scanned: Iterable[Scanned], out: Path, config: AnnotateConfig) -> list[Job]:
    """Return the clips to annotate; write the annotations of clips refused by the scan.

    Raises `InputError` if two recordings have clips with the same id.
    """
    jobs: list[Job] = []
    seen: dict[str, str] = {}
    for video in scanned:
        for job, rule, reason in video.refused:
            if not clip.read_annotation(job.video_id, out):
                notes = {"rule": rule, "reason": reason, "figures": dict(job.figures)}
                clip.finish(job, out, config, "refused", notes)
        for job in video.jobs:
            if (other := seen.setdefault(job.video_id, job.recording)) != job.recording:
                raise InputError(
                    f"Two recordings have the id {job.video_id}: {other} and {job.recording}. "
                    "Annotate them to different folders. (--out)"
                )
            jobs.append(job)
    return jobs


def choose_retries(scanned: Iterable[Scanned], out: Path) -> list[Job]:
    """Return refused clips without cameras, with a focal length from other clips of their video.

    It is the median over the clips whose focal length was estimated.
    """
    retries = []
    for video in scanned:
        abouts = [clip.read_annotation(job.video_id, out) for job in video.jobs]
        focals = [
            about["cameras"]["focal_px"]
            for about in abouts
            if about.get("status") == "done" and about["cameras"]["rung"] in CALIBRATED
        ]
        if focals:
            focal = float(np.median(focals))
            retries += [
                replace(job, focal_px=focal)
                for job, about in zip(video.jobs, abouts, strict=True)
                if clip.can_retry(about)
            ]
    return retries


def write_report(scanned: Sequence[Scanned], out: Path) -> dict[str, Any]:
    """Write metadata.csv, report.json and index.html; return the report.

    Videos that an earlier command annotated to the same folder are in them, too.
    """
    scanned = [*scanned, *_earlier({video.source for video in scanned}, out)]
    clips: list[dict[str, Any]] = []
    rows: list[dict[str, str]] = []
    for video in scanned:
        for job in (*video.jobs, *(job for job, _, _ in video.refused)):
            about = read_json(out / job.video_id / ANNOTATION)
            if about["status"] == "done":
                rows.append(about["row"])
            clips.append({"source": video.source, **about})
    clips.sort(key=lambda about: (about["source"], about["start"]))
    videos = {video.source: _summary(video, clips) for video in scanned}
    counts = {
        status: sum(about["status"] == status for about in clips)
        for status in ("done", "refused", "failed")
    }
    report = {"clips": counts, "videos": videos, "annotations": clips}
    if rows:
        write_table(out / METADATA, sorted(rows, key=lambda row: row["video_id"]))
    else:
        (out / METADATA).unlink(missing_ok=True)
    write_json(out / REPORT, report)
    write_page(out, report)
    return report


def _earlier(names: Collection[str], out: Path) -> Iterator[Scanned]:
    """Yield other videos that were scanned to a folder, with their finished clips."""
    for path in sorted((out / WORK / "scans").glob("*.json")):
        if path.stem not in names:
            video = _scanned(path.stem, out, read_json(path))
            done = [job for job in video.jobs if clip.read_annotation(job.video_id, out)]
            yield replace(video, jobs=tuple(done))


def _summary(video: Scanned, clips: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    annotated = [about for about in clips if about["source"] == video.source]
    done = sum(about["status"] == "done" for about in annotated)
    summary: dict[str, Any] = {"clips": len(annotated), "done": done}
    texts = {"problem": video.problem, "note": video.note}
    return summary | {name: text for name, text in texts.items() if text is not None}
