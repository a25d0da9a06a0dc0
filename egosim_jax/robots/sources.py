"""Clips with hands that a robot can follow, recognized by the files of their folder.

    episode.json, or a .zip      episode with ground truth (`simulation/episode.py`)
    annotation.json              clip of `egosim data annotate`
    config.json, journal.jsonl   run of `egosim simulate`
    session.json or closed.json  session of `egosim serve` or `egosim play`

An episode has the ground truth of each pixel. The others have what perception found: a run keeps
it, and a clip that does not have it is perceived here, with the hands' masks of its annotation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, no_type_check

import numpy as np
from jaxtyping import UInt8

from egosim_jax.annotate.clip import ANNOTATION, MASKS, read_masks
from egosim_jax.annotate.to_episode import episode_from
from egosim_jax.geometry import invert
from egosim_jax.interactive.server.session import CLOSED, SETTINGS
from egosim_jax.io.bounded import quote_path, quote_text, read_json
from egosim_jax.io.digest import fingerprint
from egosim_jax.io.journal import NAME, Journal
from egosim_jax.io.run import CONFIG
from egosim_jax.io.video import probe_video
from egosim_jax.perception import archive
from egosim_jax.perception.classical import ClassicalConfig, take_action
from egosim_jax.perception.pipeline import Observation, Perception, Pipeline
from egosim_jax.robots.background import moved
from egosim_jax.simulation.episode import DESCRIPTION, Episode
from egosim_jax.simulation.rollout import load_clip
from egosim_jax.state import snapshot
from egosim_jax.state.new_objects import with_objects
from egosim_jax.types import Action, Clip, GroundTruth, InputError, Perceived, SceneState, VideoSpec

KINDS = (
    "an episode with ground truth (egosim episode make), an annotated clip (egosim data annotate), "
    "a run of egosim simulate, or a session of egosim serve or egosim play"
)
"""Sources, in words for messages."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Source:
    """Clips with hands, with depth and ids of each pixel."""

    kind: str
    """Kind of the source, for reports."""
    episode: Episode
    """Actions and frames; the depth, ids and motions are ground truth or estimates."""
    states: tuple[SceneState, ...]
    """Scene before each clip."""
    rate: Fraction
    """Frames per second of the frames; `episode.fps` is the nearest whole number."""
    estimated: bool = False
    """True if depth, ids and motions are estimates."""


def open_source(path: Path) -> Source:
    """Return the clips of a folder or a .zip. Raises `InputError` if it is of no known kind."""
    if path.suffix == ".zip" or (path / DESCRIPTION).is_file():
        return of_episode(Episode.load(path))
    if (path / ANNOTATION).is_file():
        return _annotated(path)
    if (path / CONFIG).is_file() and (path / NAME).is_file():
        return _simulated(path)
    if (path / SETTINGS).is_file() or (path / CLOSED).is_file():
        return _session(path)
    if not path.exists():
        raise InputError(f"{quote_path(path)} does not exist: give {KINDS}. (SOURCE)")
    inside = [
        child.name
        for name in (ANNOTATION, SETTINGS, CLOSED)
        for child in (sorted(p.parent for p in path.glob(f"[!.]*/{name}")) if path.is_dir() else ())
    ]
    if inside:
        raise InputError(
            f"{quote_path(path)} has {len(inside)} clips or sessions: give the folder of one, such "
            f"as {quote_path(path / inside[0])}. (SOURCE)"
        )
    raise InputError(
        f"{quote_path(path)} is not a clip with known hands and cameras: give {KINDS}. Annotate a "
        "video first. (SOURCE)"
    )


def of_episode(episode: Episode) -> Source:
    """Return an episode as a source. Raises `InputError` if it has no ground truth."""
    if not episode.ground_truth:
        raise InputError(
            "The episode has no ground truth, in whose frames a robot is drawn: make one with it, "
            "such as egosim episode make --seed 0. (SOURCE)"
        )
    states = [episode.state]
    for truth in episode.ground_truth[:-1]:
        states.append(moved(states[-1], truth.motions or {}))
    return Source(kind="episode", episode=episode, states=tuple(states), rate=Fraction(episode.fps))


def _annotated(path: Path) -> Source:
    """Return an annotated clip in its own size, length and frame rate."""
    about = read_json(path / ANNOTATION)
    if isinstance(about, dict) and about.get("status") in ("refused", "failed"):
        raise InputError(
            f"{quote_path(path)} has no cameras and hands: its annotation was {about['status']}: "
            f"{quote_text(str(about.get('reason')))} Choose another clip. (SOURCE)"
        )
    info = probe_video(path / "video.mp4")
    video = VideoSpec(
        frames=info.frames, height=info.height, width=info.width, fps=max(1, round(info.fps))
    )
    episode = episode_from(path, video, clips=1, every_frame=True)
    frames = episode.ground_truth[0].frames
    masks = read_masks(path / MASKS, frames.shape[:3])
    config = ClassicalConfig()

    def mark_hands(
        clip: Clip, action: Action, state: SceneState, so_far: Observation
    ) -> Observation:
        return replace(so_far, object_ids=np.where(masks, -1, 0).astype(np.int32))

    stages = (take_action, mark_hands, config.motion, config.moved, config.new)
    return _perceived(
        "annotated clip", episode, [episode.state], [frames], [Pipeline(stages=stages)], info.fps
    )


def _simulated(path: Path) -> Source:
    """Return a run of `egosim simulate`: its episode, with the generated clips as frames."""
    written = read_json(path / CONFIG)
    settings = written.get("simulate") if isinstance(written, dict) else None
    if not isinstance(settings, dict):
        raise InputError(
            f"{quote_path(path)} is not a run of egosim simulate: give {KINDS}. (SOURCE)"
        )
    done = Journal(path).done
    episode = _episode_of(settings, done)
    clips = [path / f"clip_{n}" for n in range(1, len(episode.actions) + 1)]
    return _generated("simulation", episode, episode.state, clips)


def _episode_of(settings: dict[str, Any], done: dict[str, dict[str, Any]]) -> Episode:
    """Return the episode of a run. Raises `InputError` if it is another one than the recorded."""
    from egosim_jax import configs
    from egosim_jax.worlds.tabletop import make_sequence, to_episode

    count = sum(name.endswith(" generate") for name in done)
    if not count:
        raise InputError("The run has no finished clip: run its command again first. (SOURCE)")
    if settings.get("episode") is None:
        video = configs.get(str(settings["config"])).video
        kind = "robot" if settings.get("robot") else "human"
        clips = make_sequence(int(settings["seed"]), spec=video, clips=count, kind=kind)
        episode = to_episode(list(clips), fps=video.fps)
    else:
        episode = Episode.load(Path(settings["episode"]))
    actions = episode.actions[:count]
    same = [
        done.get(f"{n} action", {}).get("made_of") == {"action": fingerprint(action)}
        for n, action in enumerate(actions, start=1)
    ]
    recorded = done.get("run", {}).get("made_of", {}).get("state")
    if recorded != snapshot.fingerprint(episode.state) or not all(same) or len(same) < count:
        raise InputError(
            f"The episode of the run, {quote_text(str(settings.get('episode') or 'tabletop'))}, is "
            "not the one that the run was made from: restore it. (SOURCE)"
        )
    return replace(episode, actions=actions, ground_truth=())


def _session(path: Path) -> Source:
    """Return the first steps of a session, up to a reset."""
    from egosim_jax.interactive.server.dataset_export import open_sessions

    (session,), _ = open_sessions(path.resolve().parent, [path.resolve().name])
    start, steps = next(session.runs())
    episode = Episode(
        state=start.state,
        actions=tuple(session.action(n) for n in steps),
        fps=session.backend.video.fps,
        first_frame=start.first_frame,
    )
    clips = [path / "steps" / str(n) / "rollout" / "clip_1" for n in steps]
    return _generated("session", episode, start.state, clips)


def _generated(kind: str, episode: Episode, state: SceneState, clips: Sequence[Path]) -> Source:
    """Return clips of a journaled rollout, with what its perception found."""
    states, frames, found = [state], [], []
    for clip in clips:
        frames.append(load_clip(clip / "frames.npz", episode.fps).frames)
        kept = clip / "perceived.npz"
        recorded = archive.load(kept) if kept.exists() else None
        found.append(_recorded(recorded) if recorded else ClassicalConfig().build())
        states.append(snapshot.load(clip / "state") if (clip / "state").exists() else states[-1])
    return _perceived(kind, episode, states[: len(clips)], frames, found)


def _perceived(
    kind: str,
    episode: Episode,
    states: Sequence[SceneState],
    frames: Sequence[UInt8[np.ndarray, "f h w 3"]],
    perceptions: Sequence[Perception],
    rate: Fraction | None = None,
) -> Source:
    """Return clips whose depth, ids and motions are those that perception finds."""
    before, truths = [], []
    for state, action, seen, perception in zip(
        states, episode.actions, frames, perceptions, strict=True
    ):
        found = perception(Clip(frames=seen, fps=episode.fps), action, state)
        state = with_objects(state, found.new_objects)
        known = np.where(found.depth_m > 0, found.depth_m, np.float32(np.inf))
        motions = {
            number: poses @ invert(state.world_from_object.get(number, np.eye(4)))
            for number, poses in found.world_from_object.items()
        }
        before.append(state)
        truths.append(
            GroundTruth(frames=seen, depth_m=known, object_ids=found.object_ids, motions=motions)
        )
    return Source(
        kind=kind,
        episode=replace(episode, ground_truth=tuple(truths)),
        states=tuple(before),
        rate=Fraction(episode.fps) if rate is None else rate,
        estimated=True,
    )


def _recorded(perceived: Perceived) -> Perception:
    """Return the perception of a clip that a run kept."""
    return lambda clip, action, state: perceived
