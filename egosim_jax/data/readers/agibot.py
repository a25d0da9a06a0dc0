"""AgiBot-World: head videos of a two-armed robot, with its cameras, flanges and grippers.

    observations/<task>/<episode>/videos/head_color.mp4, depth/head_depth_*.png (millimeters)
    parameters/<task>/<episode>/parameters/camera/head_intrinsic_params.json,
                                                  head_extrinsic_params_aligned.json
    proprio_stats/<task>/<episode>/proprio_stats.h5
        state/end/position `n 2 3`, meters, and orientation `n 2 4`, x y z w: the flanges, left and
        right; state/effector/position `n 2`, opening in millimeters
    task_info/task_<task>.json: parts of each episode, with start, end and a sentence

or, as in the challenges, the video, the two JSON files and the h5 file in one folder. A recording
is a part of an episode, as in EgoSim's ids, or the complete episode if it has no parts. The world
is the robot's base.

Two readings of the extrinsics are in use: camera to base, and base to camera. Both project the
points between the fingers. The reading that puts more points into the image is taken and recorded.
If both readings are equal, the recording is refused unless the user decides. Without intrinsics,
extrinsics or openings, this part stays unknown, and what depends on it: grippers need poses.

A gripper has three joints: the flange, and the tips of thumb and index finger. The tips are
`TOOL_M` along the flange's z axis, and half of the opening to either side along its y axis. The
dataset documents that the value grows when the gripper opens; other users found the reverse. If the
measured value grows with the command (0 open, 1 closed), it is inverted. Values from 0 to 1 may be
shares or grippers that stay closed: the user decides. Intel's cameras have pixel
centers at integers. A lens that is not a pinhole is remapped, which writes a video. Followed: the
dataset's card of 2025 and the loaders of its challenges.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import tyro
from jaxtyping import Float, Int

from egosim_jax.data.pairing import by_frame, pair_rows
from egosim_jax.data.readers import Entry, find_files, make_id, numbered, require
from egosim_jax.data.readers.hands import clean_joints
from egosim_jax.data.readers.lenses import Lens, Remap
from egosim_jax.data.readers.rotations import from_quaternions
from egosim_jax.data.recorded_files import DepthFiles
from egosim_jax.data.recording import Recording
from egosim_jax.geometry import invert, project, transform
from egosim_jax.io.bounded import quote, quote_path, read_json
from egosim_jax.io.untrusted.hdf5 import read_hdf5
from egosim_jax.io.video import VideoInfo, probe_video, read_video
from egosim_jax.io.writing import write_frames
from egosim_jax.types import Cameras, InputError

logger = logging.getLogger(__name__)

TOOL_M = 0.23
"""Distance from the flange to the fingertips along its z axis, in meters, as EnerVerse-AC draws."""
MAX_OPENING_MM = 120.0
"""Maximum opening of a gripper in millimeters."""
MAX_SHARE, MAX_VALUE_MM = 1.5, 150.0
"""Bounds of the largest value of the grippers: below, it may be a share; above, no opening."""
MIN_AGREEMENT = 0.3
"""Minimum correlation of the grippers' values and commands that decides their sign."""
CHUNK = 64
"""Number of frames to remap at a time."""
Reading = Literal["camera_to_base", "base_to_camera"]
Opening = Literal["open_mm", "closed_mm", "open_share", "closed_share"]


@dataclass(frozen=True, kw_only=True)
class _Part:
    number: int
    start: int
    stop: int | None
    caption: str | None


@dataclass(frozen=True, kw_only=True)
class _Files:
    task: str
    episode: str
    states: Path
    camera: Path
    video: Path
    depth: Path
    info: Path | None

    @classmethod
    def of(cls, states: Path) -> _Files:
        """Return the files that belong to a proprio_stats.h5, in either layout."""
        folder = states.parent
        if (folder / "head_color.mp4").exists():
            return cls(task=folder.parent.name, episode=folder.name, states=states, camera=folder,
                       video=folder / "head_color.mp4", depth=folder, info=None)  # fmt: skip
        root, task, episode = folder.parent.parent.parent, folder.parent.name, folder.name
        observed = root / "observations" / task / episode
        return cls(
            task=task,
            episode=episode,
            states=states,
            camera=root / "parameters" / task / episode / "parameters" / "camera",
            video=observed / "videos" / "head_color.mp4",
            depth=observed / "depth",
            info=root / "task_info" / f"task_{task}.json",
        )


@dataclass(frozen=True, kw_only=True)
class AgiBot:
    """AgiBot-World: head camera, grippers and captions of each part of an episode."""

    dataset: ClassVar[str] = "agibot"
    source: Annotated[Path, tyro.conf.Positional]
    """Folder with observations, parameters, proprio_stats and task_info."""
    extrinsics: Reading | None = None
    """Reading of the camera's extrinsics; by default decided by projecting the grippers."""
    opening: Opening | None = None
    """Meaning of the grippers' values: millimeters, or a share from 0 to 1 that is open or closed.
    By default millimeters, if there are values above 1."""

    def find(self) -> Iterator[Entry]:
        """List the parts of all episodes."""
        require("h5py")
        infos: dict[str, Any] = {}
        for path in find_files(self.source, "proprio_stats.h5", kind="episode of AgiBot-World"):
            files = _Files.of(path.resolve())
            if files.task not in infos:
                infos[files.task] = _read_info(files.info)
            for part in _parts(infos[files.task].get(files.episode)):
                yield Entry(
                    recording_id=make_id([files.task, files.episode, f"{part.number:03d}"]),
                    read=partial(self._read, files, part),
                    source=files.states,
                    options={
                        "--extrinsics": self.extrinsics or "decided",
                        "--opening": self.opening or "decided",
                    },
                )

    def _read(self, files: _Files, part: _Part, folder: Path) -> Recording:
        info = probe_video(files.video)
        info.check_square(quote_path(files.video))
        lens = _read_lens(files.camera / "head_intrinsic_params.json", info)
        matrices = _read_extrinsics(files.camera / "head_extrinsic_params_aligned.json")
        joints, tools, notes = _read_grippers(files.states, self.opening)
        tables = [(len(joints), "states")]
        tables += [] if matrices is None else [(len(matrices), "camera poses")]
        rows, *_ = (pair_rows(files.video, info, n, what=what) for n, what in sorted(tables))
        span = _span(part, rows, files.video)
        rows = rows[span]
        poses, decision = self._decide(
            None if matrices is None else matrices[rows], tools[rows], lens
        )
        if "unknown" in decision["extrinsics"]:
            where = quote_path(files.camera)
            logger.warning("%s: poses and grippers are %s", where, decision["extrinsics"])
        remap = None if lens is None or lens.is_pinhole() else Remap.of(lens)
        intrinsics = None if lens is None else (remap or lens).intrinsics_px
        cameras = None if poses is None or intrinsics is None else Cameras(
            world_from_camera=poses,
            intrinsics_px=intrinsics,
            height=info.height,
            width=info.width,
        )  # fmt: skip
        joints, counts = clean_joints(None if poses is None else joints[rows], cameras)
        video, start = files.video, span.start
        if remap is not None:
            video, start = _remap_video(files.video, span, info, remap, folder), 0
        return Recording(
            recording_id=make_id([files.task, files.episode, f"{part.number:03d}"]),
            video=video,
            start=start,
            frames=span.stop - span.start,
            fps=info.fps,
            height=info.height,
            width=info.width,
            world_from_camera=poses,
            intrinsics_px=intrinsics,
            metric=poses is not None,
            joints_m=None if joints is None or np.isnan(joints).all() else joints,
            kind="robot",
            depth=_find_depth(files.depth, rows, files.video, info) if remap is None else None,
            caption=part.caption,
            provenance={
                **decision,
                **notes,
                **counts,
                "lens": "pinhole" if remap is None else "remapped",
            },
        )

    def _decide(
        self,
        matrices: Float[np.ndarray, "f 4 4"] | None,
        tools: Float[np.ndarray, "f 2 3"],
        lens: Lens | None,
    ) -> tuple[Float[np.ndarray, "f 4 4"] | None, dict[str, str]]:
        """Return camera poses in the base by the chosen reading, or None, and the evidence for it.

        Without intrinsics only the user can choose.
        """
        if matrices is None:
            return None, {"extrinsics": "unknown: none"}
        readings: dict[Reading, np.ndarray] = {
            "camera_to_base": matrices, "base_to_camera": invert(matrices),
        }  # fmt: skip
        chosen = self.extrinsics
        if lens is None:
            if chosen is None:
                why = "unknown: no intrinsics to decide their reading by; choose it (--extrinsics)"
                return None, {"extrinsics": why}
            return readings[chosen], {"extrinsics": chosen, "extrinsics_by": "user"}
        shares = {name: share_in_view(poses, tools, lens) for name, poses in readings.items()}
        best, other = sorted(readings, key=lambda name: -shares[name])
        written = ", ".join(f"{name} {share:.2f}" for name, share in shares.items())
        if chosen is None and not shares[best] > shares[other]:
            raise InputError(
                f"The reading of the extrinsics cannot be decided: the share of gripper points in "
                f"the image is {written}, and one must be larger. Choose one. (--extrinsics)"
            )
        by = "projected grippers" if chosen is None else "user"
        chosen = chosen or best
        return readings[chosen], {
            "extrinsics": chosen, "extrinsics_by": by, "grippers_in_view": written
        }  # fmt: skip


def share_in_view(
    poses: Float[np.ndarray, "f 4 4"], tools: Float[np.ndarray, "f 2 3"], lens: Lens
) -> float:
    """Return the fraction of points between the fingers that are inside the image."""
    local = transform(invert(poses), tools)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = project(lens.intrinsics_px, local)
        inside = (local[..., 2] > 0.05) & (u > -0.5) & (u < lens.width - 0.5)
        inside &= (v > -0.5) & (v < lens.height - 0.5)
    given = np.isfinite(tools).all(axis=2)
    return float(inside[given].mean()) if given.any() else 0.0


def _read_info(path: Path | None) -> dict[str, Any]:
    """Return the entry of each episode of a task, by episode."""
    if path is None or not path.exists():
        return {}
    entries = read_json(path, limit=1 << 28)
    if not isinstance(entries, list):
        raise InputError(f"{quote_path(path)} is not a list of episodes.")
    return {str(e.get("episode_id")): e for e in entries if isinstance(e, dict)}


def _parts(info: Mapping[str, Any] | None) -> list[_Part]:
    label = (info or {}).get("label_info")
    actions = label.get("action_config") if isinstance(label, dict) else None
    if isinstance(actions, list) and actions:
        spans = ("start_frame", "end_frame")
        return [
            _Part(number=n, start=a[spans[0]], stop=a[spans[1]], caption=_text(a, "action_text"))
            for n, a in enumerate(actions)
            if isinstance(a, dict) and all(type(a.get(name)) is int for name in spans)
        ]
    return [_Part(number=0, start=0, stop=None, caption=_text(info or {}, "task_name"))]


def _text(entry: Mapping[str, Any], name: str) -> str | None:
    text = entry.get(name)
    return text if isinstance(text, str) and text.strip() else None


def _span(part: _Part, rows: Int[np.ndarray, " f"], video: Path) -> slice:
    """Return the frames of a part, given the row of each. Raises `InputError` without any."""
    stop = len(rows) if part.stop is None else int(np.searchsorted(rows, part.stop))
    start = int(np.searchsorted(rows, part.start))
    if part.start < 0 or start >= stop:
        raise InputError(
            f"Part {part.number} is from frame {part.start} to {part.stop}: the episode has "
            f"{len(rows)} frames with poses and states, and a part must have at least one of them."
        )
    if part.stop is not None and part.stop > rows[-1] + 1:
        logger.warning(
            "%s: part %d ends at frame %d, and the episode at %d: what fits is used",
            quote_path(video), part.number, part.stop, int(rows[-1]) + 1,
        )  # fmt: skip
    return slice(start, stop)


def _read_lens(path: Path, info: VideoInfo) -> Lens | None:
    """Return the camera's lens, or None if the dataset does not have it."""
    written = read_json(path) if path.exists() else {}
    values = written.get("intrinsic", {}) if isinstance(written, dict) else None
    if not isinstance(values, dict):
        raise InputError(f"{quote_path(path)} has no intrinsic.")
    if not values:
        logger.warning("%s: missing or empty; intrinsics stay unknown", quote_path(path))
        return None
    fx, fy, cx, cy = (_number(values, name, path) for name in ("fx", "fy", "ppx", "ppy"))
    names = ("k1", "k2", "p1", "p2", "k3")
    return Lens(
        model="brown",
        coefficients=tuple(_number({n: 0.0} | values, n, path) for n in names),
        intrinsics_px=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]),
        height=info.height,
        width=info.width,
    )


def _number(values: Mapping[str, Any], name: str, path: Path) -> float:
    value = values.get(name)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e6:
        raise InputError(f"{quote_path(path)}: {name} is {quote(value)}, not a number.")
    return float(value)


def _read_extrinsics(path: Path) -> Float[np.ndarray, "f 4 4"] | None:
    """Return the matrices of the frames, or None if the dataset does not have them."""
    written = read_json(path, limit=1 << 27) if path.exists() else []
    if not isinstance(written, list):
        raise InputError(f"{quote_path(path)} is not a list of one entry per frame.")
    if not written:
        return None
    matrices = np.tile(np.eye(4), (len(written), 1, 1))
    for number, entry in enumerate(written):
        values: Any = entry.get("extrinsic") if isinstance(entry, dict) else None
        try:
            matrices[number, :3, :3] = values["rotation_matrix"]
            matrices[number, :3, 3] = values["translation_vector"]
        except (TypeError, KeyError, ValueError) as error:
            raise InputError(
                f"{quote_path(path)}, entry {number}: extrinsic must have a rotation_matrix of "
                "3 x 3 and a translation_vector of 3 numbers."
            ) from error
    return matrices


def _read_grippers(
    path: Path, given: Opening | None
) -> tuple[Float[np.ndarray, "f 2 3 3"], Float[np.ndarray, "f 2 3"], dict[str, str]]:
    """Return joints and points between the fingers in the base, and the reading of the opening."""
    end, effector = "state/end", "effector/position"
    shapes = {f"{end}/position": (None, 2, 3), f"{end}/orientation": (None, 2, 4)}
    openings = {f"{kind}/{effector}": (None, None) for kind in ("state", "action")}
    arrays = read_hdf5(path, shapes, optional=openings).arrays
    positions, orientations = (arrays[name] for name in shapes)
    opening = arrays.get(f"state/{effector}", np.zeros((len(positions), 0)))
    if not len(positions) == len(orientations) == len(opening):
        raise InputError(
            f"{quote_path(path)} has {len(positions)} positions, {len(orientations)} orientations "
            f"and {len(opening)} openings: it is damaged in the set itself."
        )
    rotations = from_quaternions(orientations)
    tools = positions + TOOL_M * rotations[..., 2]
    if opening.shape[1] != 2:
        hands = "not grippers" if opening.shape[1] else "unknown: no openings"
        return np.full((len(positions), 2, 3, 3), np.nan), tools, {"hands": hands}
    meaning = given or _meaning(arrays.get(f"action/{effector}"), opening, path)
    if meaning.endswith("share"):
        opening = MAX_OPENING_MM * opening
    if meaning.startswith("closed"):
        opening = MAX_OPENING_MM - opening
    grows = "closes, as the command" if meaning.startswith("closed") else "opens"
    notes = {"opening": f"grows when it {grows}", "opening_in": meaning}
    half = np.clip(opening, 0, MAX_OPENING_MM) / 2000
    zero = np.zeros_like(half)
    local = np.stack(
        [np.stack([zero, side * half, zero + along], axis=-1)
         for side, along in ((0, 0.0), (1, TOOL_M), (-1, TOOL_M))], axis=2,
    )  # fmt: skip
    joints = np.einsum("fnij,fnkj->fnki", rotations, local) + positions[:, :, None]
    return joints, tools, notes


def _meaning(command: np.ndarray | None, opening: Float[np.ndarray, "f 2"], path: Path) -> Opening:
    """Return what the grippers' values mean. Raises `InputError` if they do not decide it.

    Values that grow with the command, which is 1 when closed, grow when the gripper closes.
    """
    low, high = float(np.nanmin(opening)), float(np.nanmax(opening))
    if not (MAX_SHARE < high <= MAX_VALUE_MM and low > -MAX_SHARE):
        raise InputError(
            f"{quote_path(path)}: the grippers' values are from {low:g} to {high:g}: openings in "
            f"millimeters must reach more than {MAX_SHARE:g} and at most {MAX_VALUE_MM:g}. If they "
            "are shares of the opening, choose open_share (1 is open) or closed_share. (--opening)"
        )
    agreement = 0.0
    if command is not None and command.shape == opening.shape:
        moves = [
            np.nan_to_num(values - np.nanmean(values, axis=0)) for values in (command, opening)
        ]
        size = float(np.sqrt((moves[0] ** 2).sum() * (moves[1] ** 2).sum()))
        agreement = float((moves[0] * moves[1]).sum()) / size if size > 0 else 0.0
    if abs(agreement) < MIN_AGREEMENT:
        raise InputError(
            f"{quote_path(path)}: the grippers' values and their commands do not move together "
            f"(correlation {agreement:.2f}): whether values grow when a gripper opens is unknown. "
            "Choose open_mm, as the dataset documents, or closed_mm. (--opening)"
        )
    return "closed_mm" if agreement > 0 else "open_mm"


def _find_depth(folder: Path, rows: np.ndarray, video: Path, info: VideoInfo) -> DepthFiles | None:
    maps = numbered(folder.glob("head_depth_*.png"))
    maps = by_frame(maps, video, info, what="depth maps")
    paths = tuple(maps.get(frame) for frame in rows.tolist())
    return DepthFiles(paths=paths, unit_m=0.001) if any(paths) else None


def _remap_video(path: Path, span: slice, info: VideoInfo, remap: Remap, folder: Path) -> Path:
    def frames() -> Iterator[np.ndarray]:
        for start in range(span.start, span.stop, CHUNK):
            stop = min(start + CHUNK, span.stop)
            yield from remap.apply(read_video(path, start=start, stop=stop, whole=True).frames)

    write_frames(folder / "video.mp4", frames(), info.fps)
    return folder / "video.mp4"
