"""Episodes of real scenes: an annotated clip gives the state, and its hands and cameras actions."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.annotate.captions import RULE, caption_by_rule
from egosim_jax.annotate.clip import ANNOTATION
from egosim_jax.data.crop import Crop, plan_crop
from egosim_jax.io.bounded import listing, quote_path, read_json
from egosim_jax.io.images import read_image
from egosim_jax.io.timing import Timeline
from egosim_jax.io.untrusted.npz import read_arrays
from egosim_jax.io.video import read_video
from egosim_jax.simulation.episode import Episode
from egosim_jax.state import snapshot
from egosim_jax.types import JOINTS, Action, Cameras, GroundTruth, InputError, Kind, VideoSpec


def episode_from(
    folder: Path, video: VideoSpec, *, clips: int | None = None, every_frame: bool = False
) -> Episode:
    """Return an episode made from an annotated clip, with the length, size and rate of `video`.

    Consecutive actions share a frame: the last frame of one is the first of the next. The
    ground-truth frames are the nearest in time, or every recorded one, cropped to the model's size,
    and so are the first frame and the intrinsics. Raises `InputError` if the clip was refused or
    is too short.
    """
    if not (folder / ANNOTATION).exists() and folder.parent.is_dir():
        places = folder.glob(f"*/{ANNOTATION}"), folder.parent.glob(f"*/{ANNOTATION}")
        folders = sorted(str(path.parent) for paths in places for path in paths)
        if folders:
            raise InputError(
                f"{quote_path(folder)} is no clip of `egosim data annotate`. There are "
                f"{listing(folders)}."
            )
    about = read_json(folder / ANNOTATION)
    row = about.get("row") if isinstance(about, dict) else None
    prompt = row.get("prompt") if isinstance(row, dict) else None
    if not isinstance(prompt, str) or about.get("status") != "done":
        raise InputError(
            f"{quote_path(folder)} is not an accepted clip of `egosim data annotate`. Choose "
            "another one of its metadata.csv."
        )
    arrays = read_arrays(
        folder / "action.npz",
        {"world_from_camera": "float64", "intrinsics_px": "float64", "joints_m": "float64"},
    )
    recorded = read_video(folder / "video.mp4")
    moments = Timeline.even(len(recorded.frames), recorded.fps).at_rate(video.fps)
    if every_frame:
        moments = np.arange(len(recorded.frames))
    picked = pick_clips(moments, video, clips, name=quote_path(folder))
    image = read_image(folder / "first_frame.png")
    crop = crop_to(video, recorded.frames.shape[1:3], name=quote_path(folder))
    frames = [np.stack([crop.resample(frame) for frame in recorded.frames[k]]) for k in picked]
    cameras = crop.intrinsics(arrays["intrinsics_px"])
    kind = kind_of(arrays["joints_m"])
    return Episode(
        state=snapshot.load(folder / "state"),
        actions=tuple(
            Action(
                cameras=Cameras(
                    world_from_camera=arrays["world_from_camera"][k],
                    intrinsics_px=cameras,
                    height=video.height,
                    width=video.width,
                ),
                joints_m=_reachable(arrays["joints_m"][k]),
                kind=kind,
                prompt=_caption(about, prompt, arrays["joints_m"][k], kind),
            )
            for k in picked
        ),
        fps=video.fps,
        first_frame=crop.resample(image),
        ground_truth=tuple(GroundTruth(frames=target) for target in frames),
    )


def pick_clips(
    moments: np.ndarray, video: VideoSpec, clips: int | None, *, name: str
) -> list[np.ndarray]:
    """Return the frames of each clip, by default of all; each begins with the last one's end."""
    step = video.frames - 1
    possible = (len(moments) - 1) // step
    count = possible if clips is None else clips
    if not 0 < count <= possible:
        raise InputError(
            f"{name} has {len(moments)} frames at {video.fps} fps, enough for {possible} clips of "
            f"{video.frames} frames, not {count}. (--clips, --config)"
        )
    return [moments[number * step : number * step + video.frames] for number in range(count)]


def kind_of(joints_m: np.ndarray) -> Kind:
    """Return the kind of hands by their number of joints."""
    return next(kind for kind, count in JOINTS.items() if count == joints_m.shape[2])


def crop_to(video: VideoSpec, size: tuple[int, ...], *, name: str) -> Crop:
    """Return how images of a height and width are fitted to a model's size."""
    fix = "Choose a model whose clips have a similar shape. (--config)"
    return plan_crop((size[0], size[1]), (video.height, video.width), name=name, fix=fix)


def _caption(about: Mapping[str, Any], prompt: str, joints_m: np.ndarray, kind: Kind) -> str:
    """Return the caption of a part of a recording: a rule says which hands this part shows."""
    made = about.get("caption")
    if not isinstance(made, dict) or made.get("source") != RULE:
        return prompt
    names = made.get("names")
    texts = [name for name in names if isinstance(name, str)] if isinstance(names, list) else []
    seen = np.asarray(np.isfinite(joints_m).all(axis=(2, 3)).any(axis=0)).tolist()
    return caption_by_rule(seen, texts, kind)


def _reachable(joints_m: np.ndarray) -> np.ndarray:
    """Return the hands; if no frame shows one, only the first, which is missing throughout."""
    present = np.isfinite(joints_m).all(axis=(2, 3)).any(axis=0)
    return joints_m if present.any() else joints_m[:, :1]
