"""Episodes from LeRobot v3.0 datasets with hands and cameras.

Each frame's row has the features that `data/lerobot_writer.py` names: hand joints in the world,
camera pose and intrinsics. Annotate a dataset that has only videos first (docs/video.md).
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from egosim_jax.annotate.to_episode import crop_to, kind_of, pick_clips
from egosim_jax.data.lerobot_writer import HANDS, INTRINSICS, POSES, SCENE
from egosim_jax.data.readers.lerobot import rate_of, read_info, read_rows, read_tasks
from egosim_jax.io.bounded import quote, quote_path
from egosim_jax.io.timing import Timeline, row_times
from egosim_jax.simulation.episode import Episode
from egosim_jax.simulation.start import Start
from egosim_jax.types import JOINTS, Action, Cameras, InputError, SceneState, VideoSpec

logger = logging.getLogger(__name__)

MAX_HANDS = 2
"""Maximum number of hands in a dataset."""


def episode_from_lerobot(
    root: Path,
    number: int,
    video: VideoSpec,
    *,
    state: SceneState | None = None,
    clips: int | None = None,
) -> Episode:
    """Return an episode of a dataset, at the length, size and rate of a model's clips.

    Each clip starts in the last frame of the clip before. Frames are the nearest in time, by the
    column timestamp if there is one. The scene is `state`, by default the one that `egosim data
    export` wrote. Raises `InputError` for a dataset without hands, cameras or scene, and for an
    episode that is too short.
    """
    info = read_info(root, ["v3.0"])
    if missing := [name for name in (HANDS, POSES, INTRINSICS) if name not in info["features"]]:
        raise InputError(
            f"{quote_path(root)} has no feature {', '.join(missing)}: an episode needs hands and "
            "cameras in the world. Import its video by `egosim data import lerobot` and annotate "
            "it, then use `egosim episode from-annotation`."
        )
    columns = [HANDS, POSES, INTRINSICS, "task_index"]
    rows = read_rows(root, info, number, columns, optional=["timestamp"])
    state, image = _scene(root / SCENE.format(number), state)
    joints, poses = _joints(rows[HANDS]), _numbers(rows[POSES], (4, 4), POSES)
    lens = _numbers(rows[INTRINSICS], (3, 3), INTRINSICS)
    if kind_of(joints) == "human" and len(poses) > 1 and (poses == poses[0]).all():
        logger.warning(
            "Episode %d of %s has the same camera pose in all frames: the camera is at rest, or "
            "its poses are placeholders", number, quote_path(root),
        )  # fmt: skip
    if not (lens == lens[0]).all():
        raise InputError(
            f"Episode {number} of {quote_path(root)} changes its {INTRINSICS}: an episode has one "
            "lens. Choose another episode. (--episode)"
        )
    name = quote_path(root)
    crop = crop_to(video, _size(info["features"], video), name=name)
    if image is not None:
        image = crop_to(video, image.shape, name=name).resample(image)
    fps = rate_of(info)
    moments = Timeline.even(len(poses), fps).at_rate(video.fps)
    if stamps := rows.get("timestamp"):
        order, _, timeline = row_times(stamps, [fps], f"Episode {number} of {name}")
        moments = order[timeline.at_rate(video.fps)]
    picked = pick_clips(moments, video, clips, name=f"Episode {number} of {name}")
    texts = read_tasks(root)
    return Episode(
        state=state,
        actions=tuple(
            Action(
                cameras=Cameras(
                    world_from_camera=poses[k],
                    intrinsics_px=crop.intrinsics(lens[0]),
                    height=video.height,
                    width=video.width,
                ),
                joints_m=joints[k],
                kind=kind_of(joints),
                prompt=texts.get(rows["task_index"][k[0]], ""),
            )
            for k in picked
        ),
        fps=video.fps,
        first_frame=image,
    )


def _scene(folder: Path, state: SceneState | None) -> tuple[SceneState, np.ndarray | None]:
    if state is not None:
        return state, None
    if not folder.is_dir():
        raise InputError(
            f"{quote_path(folder)} is missing: the dataset has no scene of this episode. Give the "
            "folder of a state, or a .ply of colored points. (--state)"
        )
    start = Start.load(folder)
    return start.state, start.first_frame


def _size(features: dict[str, Any], video: VideoSpec) -> tuple[int, int]:
    """Return the height and width of the dataset's images, which its intrinsics refer to."""
    shapes = [
        tuple(feature["shape"])
        for feature in features.values()
        if isinstance(feature, dict) and feature.get("dtype") in ("image", "video")
    ]
    sizes = {shape[:2] if shape[-1] in (1, 3) else shape[-2:] for shape in shapes}
    if len(sizes) > 1:
        raise InputError(
            f"The dataset has images of the sizes {sorted(sizes)}: {INTRINSICS} must belong to one "
            "size. Remove the other cameras."
        )
    return next(iter(sizes), (video.height, video.width))


def _joints(rows: Sequence[Any]) -> Float[np.ndarray, "f n j 3"]:
    """Return the joints of one or two hands; the row length determines their kind."""
    length = len(rows[0]) if isinstance(rows[0], list) else 0
    for count in JOINTS.values():
        hands = length // (3 * count)
        if length == 3 * count * hands and 1 <= hands <= MAX_HANDS:
            return _numbers(rows, (hands, count, 3), HANDS)
    raise InputError(
        f"{HANDS} has {length} numbers: it must have 63 per human hand or 9 per gripper, for at "
        f"most {MAX_HANDS} of them."
    )


def _numbers(rows: Sequence[Any], shape: tuple[int, ...], name: str) -> Float[np.ndarray, "f ..."]:
    try:
        return np.array(rows, float).reshape(len(rows), *shape)
    except (TypeError, ValueError):
        raise InputError(
            f"{name} is {quote(rows[0])} in the first frame: it must have {np.prod(shape)} numbers "
            "in every frame."
        ) from None
