"""Episodes: a scene and the actions in it, as a folder or as bytes.

    episode.json            description: see below
    state/                  scene before the first clip (state/snapshot.py)
    clip_1/action.npz       world_from_camera `f 4 4`, intrinsics_px `3 3`, joints_m `f n j 3`
    clip_1/ground_truth.npz frames, and depth_m, object_ids, motion_ids and motions if known
    clip_2/...              one folder per clip
    first_frame.png         first frame of the first clip, if known

    {"format": "egosim_jax.episode", "version": 1, "kind": "human", "fps": 16,
     "height": 480, "width": 832, "prompts": ["The left hand ..."], "target_ids": [14],
     "sha256": {"clip_1/action.npz": "9a...", ...}}

The byte format is an uncompressed zip archive of these files. Cameras follow OpenCV (x right, y
down, z forward); everything is in meters and in one world frame. A human hand has 21 joints: the
wrist, then thumb, index, middle, ring and little finger from knuckle to tip; a gripper has three:
the wrist and the tips of thumb and index. A missing hand has joints of NaN. Nothing is unpickled.
"""

from __future__ import annotations

import io
import json
import re
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, no_type_check

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from egosim_jax.io.atomic import atomic_folder, atomic_write, check_replaceable
from egosim_jax.io.bounded import (
    check_version,
    quote,
    quote_path,
    quote_text,
    read_bytes,
    read_json,
)
from egosim_jax.io.digest import sha256
from egosim_jax.io.images import read_image
from egosim_jax.io.untrusted.npz import read_arrays
from egosim_jax.io.untrusted.zipped import Archive, from_file
from egosim_jax.perception.pipeline import Observation
from egosim_jax.simulation.actions import check_action, load_action, save_action
from egosim_jax.state import snapshot
from egosim_jax.types import (
    Action,
    GroundTruth,
    InputError,
    SceneState,
    Shown,
    VideoSpec,
    check_counts,
)

FORMAT, VERSION = "egosim_jax.episode", 1
DESCRIPTION, FIRST_FRAME = "episode.json", "first_frame.png"
MAX_CLIPS, MAX_BYTES = 1000, 1 << 32
"""Maximum number of clips of an episode, and maximum size of the byte format in bytes."""
OTHERS = {
    "annotation.json": "an annotated clip: egosim episode from-annotation {0} --out EPISODE",
    "metadata.csv": "a folder of clips. Make an episode of one that `egosim data annotate` wrote: "
    "egosim episode from-annotation {0}/CLIP --out EPISODE",
    "meta/info.json": "a LeRobot dataset: egosim episode from-lerobot {0} --out EPISODE",
    "session.json": "a session: `save` on the page of egosim play writes its episode.zip",
    "contact_sheet.png": "a simulation, which reads an episode and writes none",
}
"""Folders that are taken for an episode, by a file in them, and what makes an episode of them."""
_NAMES = re.compile(r"episode\.json|first_frame\.png|state/(?:points\.npz|state\.json)"
                    r"|clip_[1-9]\d{0,3}/(?:action|ground_truth)\.npz")  # fmt: skip


@no_type_check
@dataclass(frozen=True, kw_only=True, repr=False)
class Episode(Shown):
    """A scene, the actions in it, and optional ground truth: the input of a simulation."""

    state: SceneState
    """Scene before the first clip."""
    actions: tuple[Action, ...]
    """Cameras, hand joints and prompt of each clip."""
    fps: int
    """Frame rate of cameras and hands, in frames per second."""
    first_frame: UInt8[np.ndarray, "h w 3"] | None = None
    """First frame of the first clip, without hands; None if unknown."""
    ground_truth: tuple[GroundTruth, ...] = ()
    """Ground truth of each clip; empty if unknown."""

    def __post_init__(self) -> None:
        """Raise `InputError` for anything that would make a simulation meaningless."""
        if not self.actions:
            raise InputError("An episode must have at least one action.")
        if len(self.actions) > MAX_CLIPS:
            raise InputError(f"An episode has at most {MAX_CLIPS} clips, not {len(self.actions)}.")
        if type(self.fps) is not int:  # `isinstance` would accept True
            raise InputError(f"fps is {self.fps!r:.40}: it must be a whole number (int).")
        check_counts({"fps": self.fps})
        if len(self.ground_truth) not in (0, len(self.actions)):
            raise InputError(
                f"{len(self.ground_truth)} clips of ground truth for {len(self.actions)} actions: "
                "give one per action, or none."
            )
        for number, action in enumerate(self.actions, start=1):
            with _named(f"clip {number}"):
                _check_equal(action, self.actions[0])
                check_action(action, state=self.state, fps=self.fps)
        shape = self.shape
        image = self.first_frame
        if image is not None and (image.shape != (*shape[1:], 3) or image.dtype != np.uint8):
            raise InputError(
                f"The first frame is {image.dtype} {image.shape}: it must be uint8 "
                f"{(*shape[1:], 3)}, as large as the cameras' images."
            )
        for number, ground_truth in enumerate(self.ground_truth, start=1):
            if ground_truth.frames.shape[:3] != shape:
                raise InputError(
                    f"The ground truth of clip {number} is {ground_truth.frames.shape[:3]}: it "
                    f"must be {shape}, like the action."
                )

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, height and width of each clip."""
        cameras = self.actions[0].cameras
        return len(cameras.world_from_camera), cameras.height, cameras.width

    @property
    def video(self) -> VideoSpec:
        """Length, size and rate of the clips."""
        frames, height, width = self.shape
        return VideoSpec(frames=frames, height=height, width=width, fps=self.fps)

    def observations(self) -> dict[int, Observation] | None:
        """Return the ground truth for perception by step; None if any of it is missing."""
        steps = range(self.state.step, self.state.step + len(self.actions))
        observed = {
            step: Observation(
                cameras=action.cameras,
                depth_m=known.depth_m,
                object_ids=known.object_ids,
                motions=known.motions,
                names=self.state.names,
            )
            for step, action, known in zip(steps, self.actions, self.ground_truth, strict=False)
        }
        needed = (
            getattr(o, n) for o in observed.values() for n in ("depth_m", "object_ids", "motions")
        )
        return observed if observed and all(value is not None for value in needed) else None

    def save(self, path: Path | str) -> None:
        """Write a folder, or the byte format if the path ends in .zip.

        Replaces a file in the byte format, an empty folder or an earlier episode; raises
        `InputError` for any other folder.
        """
        path = Path(path)
        if path.suffix == ".zip" and not path.is_dir():
            with atomic_write(path) as temporary:
                temporary.write_bytes(self.to_bytes())
            return
        with atomic_folder(check_replaceable(path, _NAMES, description=DESCRIPTION)) as folder:
            _write(folder, self)

    @classmethod
    def load(cls, path: Path | str) -> Episode:
        """Read a folder or a .zip. Raises `InputError` if it is damaged or not valid."""
        path = Path(path)
        if path.suffix and path.suffix != ".zip" and not path.is_dir():
            from egosim_jax.io.video import VIDEO_SUFFIXES

            if path.suffix.lower() in VIDEO_SUFFIXES:
                raise InputError(
                    f"{quote_path(path)} is a video: annotate it (egosim data annotate {path} "
                    "--out CLIPS), and make an episode of a clip (egosim episode from-annotation)."
                )
        data = None if path.is_dir() else read_bytes(path, limit=MAX_BYTES)  # names the path
        if data is None and not (path / DESCRIPTION).exists():
            other = next((text for name, text in OTHERS.items() if (path / name).exists()), "")
            hint = f" It is {other.format(quote_path(path))}." if other else ""
            raise InputError(f"{quote_path(path)} is no episode: it has no {DESCRIPTION}.{hint}")
        with _named(quote_path(path)):
            return _read(path) if data is None else cls.from_bytes(data)

    def to_bytes(self) -> bytes:
        """Return the byte format; equal episodes have equal bytes.

        Raises `InputError` if the archive is larger than `MAX_BYTES`.
        """
        data = io.BytesIO()
        with tempfile.TemporaryDirectory() as name, zipfile.ZipFile(data, "w") as archive:
            folder = Path(name)
            _write(folder, self)
            for file in sorted(path for path in folder.rglob("*") if path.is_file()):
                # A `ZipInfo` has a constant date: equal episodes have equal bytes.
                entry = zipfile.ZipInfo(str(file.relative_to(folder)))
                archive.writestr(entry, file.read_bytes())
        if data.tell() > MAX_BYTES:
            raise InputError(
                f"The episode has {data.tell():,} bytes: a .zip has at most {MAX_BYTES:,}. Save it "
                "to a folder."
            )
        return data.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> Episode:
        """Read the byte format. Raises `InputError` if it is damaged or not valid."""
        with tempfile.TemporaryDirectory() as name, _without(f"{name}/"):
            folder = Path(name)
            try:
                _extract(from_file(io.BytesIO(data), max_entries=2 * MAX_CLIPS + 4), folder)
            except InputError:
                raise
            except ValueError as error:
                raise InputError(
                    f"not a readable zip archive: {quote_text(str(error))}."
                ) from error
            return _read(folder)


def _check_equal(action: Action, first: Action) -> None:
    """Raise `InputError` unless a clip has the first one's kind, length and size."""
    have, want = (
        (a.kind, len(a.cameras.world_from_camera), a.cameras.height, a.cameras.width)
        for a in (action, first)
    )
    if have != want:
        raise InputError(
            f"it has {have[0]} hands, {have[1]} frames of {have[3]}x{have[2]}, and clip 1 has "
            f"{want[0]}, {want[1]} of {want[3]}x{want[2]}: all clips must agree."
        )


def _write(folder: Path, episode: Episode) -> None:
    snapshot.save(folder / "state", episode.state)
    for number, action in enumerate(episode.actions, start=1):
        save_action(folder / f"clip_{number}" / "action.npz", action)
    for number, truth in enumerate(episode.ground_truth, start=1):
        arrays: dict[str, Any] = {
            name: np.ascontiguousarray(value)
            for name in ("frames", "depth_m", "object_ids")
            if (value := getattr(truth, name)) is not None
        }
        if truth.motions is not None:
            numbers = sorted(truth.motions)
            arrays["motion_ids"] = np.array(numbers, np.int32)
            paths = [np.asarray(truth.motions[n], float) for n in numbers]
            arrays["motions"] = np.array(paths).reshape(len(paths), len(truth.frames), 4, 4)
        np.savez(folder / f"clip_{number}" / "ground_truth.npz", **arrays)
    if episode.first_frame is not None:
        Image.fromarray(episode.first_frame).save(folder / FIRST_FRAME)
    _, height, width = episode.shape
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    description = {
        "format": FORMAT,
        "version": VERSION,
        "kind": episode.actions[0].kind,
        "fps": episode.fps,
        "height": int(height),
        "width": int(width),
        "prompts": [action.prompt for action in episode.actions],
        "target_ids": [
            None if truth.target_id is None else int(truth.target_id)
            for truth in episode.ground_truth
        ],
        "sha256": {str(file.relative_to(folder)): sha256(file) for file in files},
    }
    text = json.dumps(description, indent=2) + "\n"
    (folder / DESCRIPTION).write_text(text, encoding="utf-8")


def _extract(archive: Archive, folder: Path) -> None:
    """Write the entries of the byte format to a folder; raise `InputError` for any other."""
    for entry in archive.entries.values():
        # Stored entries cannot expand, so the size of the archive bounds the files too.
        if not _NAMES.fullmatch(entry.name) or not entry.is_stored:
            raise InputError(
                f"entry {quote(entry.name)} is compressed or not part of an episode: an "
                "episode is an archive of stored files, as Episode.save writes it."
            )
    for name in archive.entries:
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(archive.read(name, limit=MAX_BYTES))


def _read(folder: Path) -> Episode:
    written = read_json(folder / DESCRIPTION)
    if not isinstance(written, dict) or written.get("format") != FORMAT:
        raise InputError(f"{DESCRIPTION} does not describe an episode ({FORMAT}).")
    check_version(written.get("version"), VERSION, source=DESCRIPTION)
    for name, kind in {"kind": str, "fps": int, "height": int, "width": int, "prompts": list,
                       "target_ids": list, "sha256": dict}.items():  # fmt: skip
        if type(written.get(name)) is not kind:
            raise InputError(
                f"{DESCRIPTION}: {name} is {quote(written.get(name))}, not {kind.__name__}."
            )
    prompts, targets = written["prompts"], written["target_ids"]
    if not 0 < len(prompts) <= MAX_CLIPS:
        raise InputError(f"{DESCRIPTION}: {len(prompts)} prompts; an episode has 1 to {MAX_CLIPS}.")
    if not all(isinstance(prompt, str) for prompt in prompts):
        raise InputError(f"{DESCRIPTION}: every prompt must be text.")
    if not all(target is None or type(target) is int for target in targets):
        raise InputError(f"{DESCRIPTION}: target_ids must be object ids or null.")
    truths = [f"clip_{number}/ground_truth.npz" for number, _ in enumerate(targets, start=1)]
    has_image = FIRST_FRAME in written["sha256"]
    _check_files(
        folder,
        written["sha256"],
        expected={
            "state/points.npz",
            "state/state.json",
            *(f"clip_{number}/action.npz" for number, _ in enumerate(prompts, start=1)),
            *truths,
            *([FIRST_FRAME] if has_image else []),
        },
    )
    size, actions = (written["height"], written["width"]), []
    for number, prompt in enumerate(prompts, start=1):
        with _named(name := f"clip_{number}"):
            path = folder / name / "action.npz"
            actions.append(load_action(path, kind=written["kind"], size=size, prompt=prompt))
    return Episode(
        state=snapshot.load(folder / "state"),
        actions=tuple(actions),
        fps=written["fps"],
        first_frame=read_image(folder / FIRST_FRAME) if has_image else None,
        ground_truth=tuple(
            _read_ground_truth(folder / name, target)
            for name, target in zip(truths, targets, strict=True)
        ),
    )


def _check_files(folder: Path, recorded: Mapping[str, Any], *, expected: set[str]) -> None:
    missing, unknown = sorted(expected - recorded.keys()), sorted(recorded.keys() - expected)
    if missing or unknown:
        raise InputError(
            f"{DESCRIPTION}: sha256 must name exactly the files of the episode; missing: "
            f"{', '.join(missing) or 'none'}; unknown: {', '.join(map(quote, unknown)) or 'none'}."
        )
    for name in sorted(expected):
        if sha256(folder / name) != recorded[name]:
            raise InputError(
                f"{name} is damaged or was changed after the episode was written (SHA-256). "
                "Restore it, or write the episode again."
            )


def _read_ground_truth(path: Path, target_id: int | None) -> GroundTruth:
    optional = {
        "depth_m": "float32",
        "object_ids": "int32",
        "motion_ids": "int32",
        "motions": "float64",
    }
    arrays = read_arrays(path, {"frames": "uint8"}, optional=optional)
    motions = None
    if "motions" in arrays:
        numbers = arrays.pop("motion_ids", np.zeros(0, np.int32))
        motions = arrays.pop("motions")
        if not numbers.shape == (len(np.unique(numbers)),) == motions.shape[:1]:
            raise InputError(f"{quote_path(path)}: motion_ids must name each of the motions once.")
        motions = dict(zip(numbers.tolist(), motions, strict=True))
    arrays.pop("motion_ids", None)
    with _named(path.parent.name):
        return GroundTruth(motions=motions, target_id=target_id, **arrays)


@contextmanager
def _named(name: str) -> Iterator[None]:
    """Prefix the message of an `InputError` with a name."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{name}: {error}") from error


@contextmanager
def _without(folder: str) -> Iterator[None]:
    """Leave the path of a temporary folder out of the message of an `InputError`."""
    try:
        yield
    except InputError as error:
        raise InputError(str(error).replace(folder, "")) from error
