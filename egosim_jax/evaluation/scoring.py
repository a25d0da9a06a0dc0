"""Score methods on clips: choose the compared frames and size, and cache the scores.

The cache key is the content: hashes of the method's files and of the ground truth, the compared
frames and size, and the measure. After you add clips, methods or measures, only new scores are
computed.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from egosim_jax.data.clip_files import ClipFiles
from egosim_jax.data.windows import Window, read_results
from egosim_jax.evaluation.cache import ScoreCache, Scores
from egosim_jax.evaluation.fvd import is_feature
from egosim_jax.evaluation.measures import VERSION, GroundTruth, Measure, Scorer
from egosim_jax.evaluation.methods import FIT, WHOLE, Edges, Folder, Method, Shape, read_at
from egosim_jax.evaluation.registration import find_crops
from egosim_jax.io.bounded import listing
from egosim_jax.io.digest import fingerprint, sha256
from egosim_jax.io.video import VideoInfo, probe_video
from egosim_jax.runtime.progress import track
from egosim_jax.runtime.terminal import counted, printable
from egosim_jax.types import InputError

MAX_RATE_ERROR = 0.01
"""Maximum relative difference of two frame rates that count as one, such as 29.97 and 30."""
MIN_COMPARED_PX = 16
"""Minimum height and width of the compared part of an image."""
OWN = "_own"
"""End of a row's name whose scores are in the method's own crop."""


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """Frames and size at which clips are compared."""

    size: Literal["output", "target"] = "output"
    """Image size of the comparison: the first method's output, or the ground truth."""
    lengths: Literal["usual", "common"] = "usual"
    """Compared frames: all, for clips of the most frequent length; or all that every method has."""
    frame_0: bool = False
    """True to compare also frame 0, which is given to the model."""
    registered: Literal["all", "sizes"] = "sizes"
    """Folders whose crop of the recorded image is searched: all, or folders of another image size.

    All are also scored in their own crops."""

    @property
    def first(self) -> int:
        """First frame that is compared."""
        return 0 if self.frame_0 else 1

    def describe(self) -> str:
        """Return the protocol in words."""
        frames = {
            "usual": "all frames; a clip of another length than most is skipped",
            "common": "the frames that all methods and the ground truth have",
        }[self.lengths]
        excluded = "frame 0 included" if self.frame_0 else "frame 0 excluded"
        searched = {
            "all": "every folder",
            "sizes": "a folder whose images have another size than the ground truth's",
        }[self.registered]
        return (
            f"frame by frame, {frames}, {excluded}; at the scale of the {self.size}, inside the "
            f"crop that all folders show, which is found by correlation for {searched}; {FIT}"
        )


@dataclass(frozen=True, kw_only=True)
class Row:
    """Scores of one method on one clip."""

    window: Window
    """Compared clip and window."""
    method: str
    """Name of the method."""
    shape: Shape
    """Number of frames, including frame 0, and image size of the comparison."""
    source: str
    """Size and length of the method's own video as text."""
    scores: Scores
    own: bool = False
    """True for the scores in the method's own crop instead of the common one."""


@dataclass(frozen=True, kw_only=True)
class Scoring:
    """Comparison of methods with the ground truth of each clip."""

    methods: Sequence[Method]
    """Rows of the table."""
    measures: Sequence[Measure]
    """Groups of columns."""
    protocol: Protocol
    cache: ScoreCache
    absent: list[str] = field(default_factory=list)
    """Clips of the metadata that were not generated, in a line for each folder."""
    skipped: list[str] = field(default_factory=list)
    """Clips that were not compared, with reasons."""
    crops: list[str] = field(default_factory=list)
    """Crops of the recorded images that the folders show, in words."""

    @property
    def folders(self) -> list[Folder]:
        """Folders whose clips must exist."""
        return [m for m in self.methods if isinstance(m, Folder) and not m.optional]

    def run(self, clips: Sequence[ClipFiles]) -> list[Row]:
        """Compare all clips. Raises `InputError` if none can be compared."""
        windows = self._windows(clips)
        lengths = {folder.name: self._lengths(folder, windows) for folder in self.folders}
        for folder in self.folders:
            crops = find_crops(
                folder,
                lengths[folder.name],
                cache=self.cache,
                every=self.protocol.registered == "all",
            )
            self.crops.extend(crops)
        rows: list[Row] = []
        for window in track(windows, "comparing", total=len(windows)):
            infos = {name: of[window] for name, of in lengths.items() if window in of}
            if not infos:
                continue
            try:
                rows += self._compare(window, infos)
            except InputError as error:
                self.skipped.append(f"{window.output_id}: {error}")
        for line in self.skipped:
            print(printable(f"skipped: {line}"), file=sys.stderr)
        if not rows:
            shown = ", ".join(str(folder.path) for folder in self.folders)
            raise InputError(f"No clip in {shown} could be compared. (--generated)")
        return _average(rows)

    def _windows(self, clips: Sequence[ClipFiles]) -> list[Window]:
        """Return the generated windows of the clips; note the reasons of missing ones."""
        rows = {files.video_id: files for files in clips}
        windows: dict[str, Window] = {}
        for folder in self.folders:
            if not folder.path.is_dir():
                raise InputError(f"There is no folder {folder.path}. (--generated)")
            results = read_results(folder.path)
            if results is None:
                if (folder.path / "state_0.ply").exists():
                    raise InputError(
                        f"{folder.path} is a simulation: its report.json has the scores of its "
                        "clips, if the episode has ground truth. Give a folder of egosim generate, "
                        "whose clips have the ids of the metadata. (--generated)"
                    )
                done = {"start": 0, "status": "done"}
                results = {name: {"source_id": name, **done} for name in rows}
            generated = {line["source_id"] for line in results.values()}
            if absent := [name for name in rows if name not in generated]:
                count = f"{len(absent)} of {counted(len(rows), 'clip')}"
                self.absent.append(
                    f"{count} of the metadata not in {folder.path}: {listing(absent)}"
                )
            for output_id, line in results.items():
                files, start = rows.get(line["source_id"]), line["start"]
                if files is None:
                    continue
                if line["status"] == "failed":
                    self.skipped.append(f"{output_id}: its generation failed")
                    continue
                window = windows.setdefault(output_id, Window(files, start, output_id))
                if (window.files, window.start) != (files, start):
                    raise InputError(
                        f"{output_id} is another window in {folder.path} than in the folders "
                        "before: an id must name the same frames in all. (--generated)"
                    )
        return list(windows.values())

    def _lengths(self, folder: Folder, windows: Sequence[Window]) -> dict[Window, VideoInfo]:
        """Return length and size of a folder's clips; note those that are not compared."""
        lengths: dict[Window, VideoInfo] = {}
        for window in windows:
            try:
                lengths[window] = probe_video(folder.file(window))
            except InputError as error:
                self.skipped.append(f"{window.output_id}: {error}")
        if self.protocol.lengths == "common":
            return lengths
        counts = Counter(shape.frames for shape in lengths.values())
        usual = max(counts, key=lambda length: (counts[length], length), default=0)
        if usual <= self.protocol.first and counts:
            raise InputError("Clips of one frame cannot be compared: frame 0 is excluded.")
        self.skipped.extend(
            f"{window.output_id}: it has {shape.frames} frames, most clips {usual}."
            for window, shape in lengths.items()
            if shape.frames != usual
        )
        return {window: shape for window, shape in lengths.items() if shape.frames == usual}

    def _compare(self, window: Window, infos: Mapping[str, VideoInfo]) -> list[Row]:
        """Return the scores of every method on one window."""
        path = window.files.target
        if path is None:
            raise InputError(f"{window.files.row} has no ground truth. (column video)")
        truth = probe_video(path)
        count = min(shape.frames for shape in infos.values())
        if self.protocol.lengths == "common":
            count = min(count, truth.frames - window.start)
        if count <= self.protocol.first:
            raise InputError("There are no frames to compare.")
        methods = []
        for method in self.methods:
            absent = isinstance(method, Folder) and not method.file(window).exists()
            if absent or (method in self.folders and method.name not in infos):
                continue
            for source in method.sources(window):
                _check_rate(method.name, source, probe_video(source), path, truth)
            methods.append(method)
        crops = {m.name: m.crops.get(window.output_id, WHOLE) for m in self.folders}
        common = WHOLE
        for name in infos:
            common = common.common(crops[name])
        like = truth if self.protocol.size == "target" else next(iter(infos.values()))
        shown = WHOLE if self.protocol.size == "target" else crops[next(iter(infos))]
        all_rows = [(self._shape(count, common, like, shown, truth), methods, False)]
        if self.protocol.registered == "all":
            for method in methods:
                own = crops.get(method.name, WHOLE).common(WHOLE)
                if isinstance(method, Folder) and own != common:
                    shape = self._shape(count, own, like, shown, truth)
                    all_rows.append((shape, [method], True))
        rows = []
        for shape, scored, own in all_rows:
            compared = _Truth(path, window, shape, self.protocol.first)
            for method in scored:
                video = infos.get(method.name)
                rows.append(
                    Row(
                        window=window,
                        method=row_of(method) + OWN * own,
                        shape=shape,
                        source=f"{video.frames} x {video.width}x{video.height}"
                        if video
                        else "made here",
                        scores=self._scores(method, compared),
                        own=own,
                    )
                )
        return rows

    @staticmethod
    def _shape(count: int, crop: Edges, like: VideoInfo, shown: Edges, truth: VideoInfo) -> Shape:
        """Return the shape at which a crop is compared, at the scale of `like`.

        The images of `like` show the part `shown` of the recorded image.
        """
        if crop == shown:
            return Shape(count, like.height, like.width, crop)
        crop = crop.whole_pixels(truth.height, truth.width)
        left, top, right, bottom = crop.within(shown)
        height, width = round((bottom - top) * like.height), round((right - left) * like.width)
        if min(height, width) < MIN_COMPARED_PX:
            raise InputError(
                "The folders show parts of the recorded image that have too little in common: "
                f"{max(width, 0)}x{max(height, 0)} pixels, fewer than {MIN_COMPARED_PX}. Score "
                "them in separate commands. (--generated)"
            )
        return Shape(count, height, width, crop)

    def _scores(self, method: Method, truth: _Truth) -> Scores:
        """Return the scores of a method on one window, cached or computed."""
        content = {
            "version": VERSION,
            "target": truth.digest,
            "start": truth.window.start,
            "shape": list(truth.shape),
            "first": truth.first,
            "method": type(method).__name__ if isinstance(method, Folder) else method,
            "sources": [sha256(path) for path in method.sources(truth.window)],
            "shown": method.crops.get(truth.window.output_id) if isinstance(method, Folder) else (),
        }
        video: np.ndarray | None = None
        scores: dict[str, float] = {}
        for measure in self.measures:
            key = fingerprint([content, measure.name, measure.settings(truth.window)])
            values = self.cache.get(key)
            if values is None:
                if video is None:
                    video = method.video(truth.window, truth.shape, truth.known.frames)
                values = truth.scorer(measure)(video)
                self.cache.put(key, values)
            scores |= values
        return scores


class _Truth:
    """Ground truth of a window, decoded only if a score is not cached."""

    def __init__(self, path: Path, window: Window, shape: Shape, first: int):
        self.path, self.window, self.shape, self.first = path, window, shape, first
        self.digest = sha256(path)
        self._scorers: dict[int, Scorer] = {}

    @cached_property
    def known(self) -> GroundTruth:
        """Decoded frames."""
        frames = read_at(self.path, self.shape, self.window.start)
        crop = self.shape.crop
        return GroundTruth(frames=frames, first=self.first, window=self.window, crop=crop)

    def scorer(self, measure: Measure) -> Scorer:
        """Return the scorer of a measure, made once."""
        if id(measure) not in self._scorers:
            self._scorers[id(measure)] = measure.against(self.known)
        return self._scorers[id(measure)]


def row_of(method: Method) -> str:
    """Return the name of a method's row."""
    return method.row if isinstance(method, Folder) else method.name


def _check_rate(name: str, path: Path, video: VideoInfo, target: Path, truth: VideoInfo) -> None:
    """Raise `InputError` if two videos differ in their frame rate."""
    if abs(video.fps / truth.fps - 1) > MAX_RATE_ERROR:
        slower, rate = (target, video.fps) if video.fps < truth.fps else (path, truth.fps)
        raise InputError(
            f"{name} has {float(video.fps):g} frames a second, the ground truth "
            f"{float(truth.fps):g}: frames are compared one by one, so both need one rate. Convert "
            f"the faster one with `ffmpeg -i {slower.name} -vf fps={rate} -crf 0 slower.mp4`. "
            "(--generated, column video)"
        )


def _average(rows: Sequence[Row]) -> list[Row]:
    """Return the rows with the mean scores over the seeds of a method.

    Features for a Fréchet distance are the first seed's: their mean is no clip's.
    """
    by_row: dict[tuple[Window, str], list[Row]] = {}
    for row in rows:
        by_row.setdefault((row.window, row.method), []).append(row)
    return [
        replace(
            same[0],
            scores={
                key: value if is_feature(key) else float(np.mean([row.scores[key] for row in same]))
                for key, value in same[0].scores.items()
            },
        )
        if len(same) > 1
        else same[0]
        for same in by_row.values()
    ]
