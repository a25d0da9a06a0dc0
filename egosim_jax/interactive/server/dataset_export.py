"""Export of recorded sessions: LeRobot datasets, training shards, and Rerun recordings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from egosim_jax.data.clip_files import prior_column
from egosim_jax.data.lerobot_writer import (
    ClipRecord,
    EpisodeRecord,
    camera_vectors,
    image_feature,
    write_lerobot,
)
from egosim_jax.data.pack import triplet_record
from egosim_jax.data.shards import ShardWriter
from egosim_jax.interactive.env.backends import GeneratedWorld
from egosim_jax.interactive.server.session import (
    CLOSED,
    DAMAGE,
    SETTINGS,
    Result,
    Session,
    settings_of,
)
from egosim_jax.io.bounded import only_inside, quote, quote_path
from egosim_jax.io.digest import fingerprint
from egosim_jax.io.journal import Journal
from egosim_jax.rendering import PriorKind, get
from egosim_jax.rendering.rerun_log import Recording
from egosim_jax.simulation import preview
from egosim_jax.state import snapshot
from egosim_jax.state.planes import vertical
from egosim_jax.types import Action, InputError, SceneState, Triplet, VideoGrid, VideoSpec, View

MAX_POINT_PX, MAX_COUNT = 64, 8192
"""Maximum side of a point in pixels, and number of frames, rows, columns and frames per second."""


@dataclass(frozen=True, kw_only=True)
class _Unavailable:
    """Generator of a recorded world, which can only be rendered."""

    renderer: Any
    """Renderer of the views."""
    point_px: int
    """Side of a point of the views in pixels."""
    prior: PriorKind
    """Objects in the views: at rest, or on their predicted paths."""

    def __call__(self, view: View, action: Action, first_frame: Any, seed: int) -> Any:
        raise InputError("A recorded session cannot continue here: use egosim serve.")


def open_sessions(folder: Path, names: Sequence[str] = ()) -> tuple[list[Session], dict[str, str]]:
    """Return the sessions of a server's folder, and the error of each damaged one.

    Sessions that were closed and kept are included; sessions without a step are not. Raises
    `InputError` if no session is readable, and if a session of `names` is missing or damaged.
    """
    paths = sorted({p.parent for name in (SETTINGS, CLOSED) for p in folder.glob(f"[!.]*/{name}")})
    by_name = {path.name: path for path in paths}
    if missing := sorted(set(names) - set(by_name)):
        raise InputError(
            f"{quote_path(folder)} has no session {missing[0][:40]!r}; it has {len(by_name)}: "
            f"{', '.join(list(by_name)[:10]) or 'none'}. (--session)"
        )
    readable, damaged = [], {}
    for path in [by_name[name] for name in dict.fromkeys(names)] or paths:
        try:
            with only_inside([path]):
                session = Session(path, _recorded(path))
                _check(session)
        except DAMAGE as error:
            if names:
                raise InputError(
                    f"Session {path.name} cannot be exported: {error} Omit it. (--session)"
                ) from error
            damaged[path.name] = str(error)
        else:
            readable += [session] if session.committed else []
    if not readable:
        raise InputError(
            f"{quote_path(folder)} has no readable session with a committed step"
            f"{f', and {len(damaged)} damaged ones' if damaged else ''}: give the folder of egosim "
            "serve. (SESSIONS)"
        )
    return readable, damaged


def _recorded(path: Path) -> GeneratedWorld:
    """Return a world that renders a recorded session, and does not generate."""
    settings = settings_of(path)
    fields = settings["video"]
    video = VideoSpec(
        frames=_bounded_int(fields, "frames"),
        height=_bounded_int(fields, "height"),
        width=_bounded_int(fields, "width"),
        fps=_bounded_int(fields, "fps"),
    )
    point_px = _bounded_int(settings, "point_px", limit=MAX_POINT_PX)
    prior = settings.get("prior", "static")  # sessions without it are older than other priors
    if prior not in get_args(PriorKind):
        raise InputError(
            f"prior in its settings is {quote(prior)}: it must be one of "
            f"{', '.join(get_args(PriorKind))}. Restore the settings."
        )
    generator = _Unavailable(renderer=get("jax"), point_px=point_px, prior=prior)
    return GeneratedWorld(generator=generator, video=video, perception=None)


def _bounded_int(fields: Mapping[str, Any], name: str, *, limit: int = MAX_COUNT) -> int:
    """Return a size of a session's settings. Raises `InputError` if it is out of bounds."""
    value = fields.get(name)
    if type(value) is not int or not 1 <= value <= limit:
        raise InputError(
            f"{name} in its settings is {quote(value)}: it must be a whole number from 1 to "
            f"{limit}. Restore the settings."
        )
    return value


def _check(session: Session) -> None:
    """Read all files that an export needs, and compare them. Raises an error of `DAMAGE`."""
    for start, steps in session.runs():
        state, image = start.state, start.first_frame
        for seed, number in enumerate(steps, start.seed + start.steps):
            made_of = {
                "state": snapshot.fingerprint(state),
                "first_frame": fingerprint(image),
                "seed": str(seed),
            }
            state, image = _check_step(session, number, made_of).state, None


def _check_step(session: Session, number: int, made_of: Mapping[str, str]) -> Result:
    """Load a step; raise an error of `DAMAGE` if its inputs differ from the journal's."""
    video, made = session.backend.video, session.folder / "steps" / str(number) / "rollout"
    session.actions.check(session.rows(number), max_rows=video.frames)
    journal = Journal(made)
    journal.verify("1 generate", made / "clip_1" / "frames.npz")
    journal.check_inputs("run", made_of)
    journal.check_inputs("1 action", {"action": fingerprint(session.action(number))})
    shape, result = (video.frames, video.height, video.width, 3), session.load_result(number)
    if result.frames.shape != shape:
        raise InputError(f"the frames of step {number} are {result.frames.shape}, not {shape}.")
    return result


def to_lerobot(sessions: Sequence[Session], folder: Path) -> None:
    """Write a LeRobot dataset with one episode per run of steps between resets."""
    names = {(session.actions.kind, session.actions.names) for session in sessions}
    videos = {session.backend.video for session in sessions}
    if len(names) > 1 or len(videos) > 1:
        raise InputError(
            f"The sessions have {len(names)} kinds of actions and clips of {len(videos)} sizes or "
            "rates: a dataset has one. Export them separately. (--session)"
        )
    cameras = {session.observer.cameras for session in sessions}
    if len(cameras) > 1:
        raise InputError(
            f"The sessions have {len(cameras)} sets of further cameras: a dataset has one. Export "
            "them separately. (--session)"
        )
    episodes = (
        EpisodeRecord(clips=_clips(session, steps), save_scene=start.save)
        for session in sessions
        for start, steps in session.runs()
    )
    kind = "gripper" if sessions[0].actions.kind == "robot" else "human_hands"
    write_lerobot(
        folder,
        episodes,
        names=sessions[0].actions.names,
        fps=videos.pop().fps,
        robot_type=kind,
        about={preview.NAME: True} if any(map(_has_previews, sessions)) else {},
    )


def _has_previews(session: Session) -> bool:
    """Return True if a clip of a session is a preview."""
    numbers = [number for _, steps in session.runs() for number in steps]
    return any(session.load_result(number).info.get(preview.NAME) for number in numbers)


def _clips(session: Session, steps: Sequence[int]) -> Iterator[ClipRecord]:
    return (clip_record(session, number) for number in steps)


def clip_record(session: Session, number: int) -> ClipRecord:
    """Return the record of a committed step, with the clips of all its cameras."""
    result, action = session.load_result(number), session.action(number)
    rows, observer = session.rows(number), session.observer
    paths = observer.paths(action.cameras, rows) if observer.cameras else {}
    vectors = [camera_vectors(name, path) for name, path in paths.items()]
    return ClipRecord(
        frames=result.frames,
        rows=rows,
        action=action,
        images={image_feature(name): frames for name, frames in result.others.items()},
        others={name: values for of_camera in vectors for name, values in of_camera.items()},
    )


def _steps(session: Session) -> Iterator[tuple[int, SceneState, View, Any]]:
    """Yield the number, prior state, view and first frame of each committed step."""
    for start, steps in session.runs():
        state, image = start.state, start.first_frame
        simulator = session.backend.simulator(start)
        for number in steps:
            action = session.action(number)
            view = simulator.render(state, action, simulator.predict(state, action))
            yield number, state, view, view.frames[0] if image is None else image
            state, image = session.load_result(number).state, None


def to_shards(sessions: Sequence[Session], folder: Path, *, grid: VideoGrid) -> None:
    """Write the steps as training clips: prior, mask, hands, and the clip as the target."""
    specs = {session.backend.video for session in sessions}
    if len(specs) > 1:
        raise InputError(
            f"The sessions have clips of {len(specs)} sizes or rates: shards have one. Export them "
            "separately. (--session)"
        )
    provenance = {"sessions": [session.id for session in sessions]}
    (spec,) = specs
    grid.check(spec)
    renderer = get("jax")
    with ShardWriter(folder, kind="frames", spec=spec, grid=grid, provenance=provenance) as writer:
        for session in sessions:
            for number, _, view, image in _steps(session):
                action = session.action(number)
                hands, _ = renderer.draw_hands(action.joints_m, action.cameras, kind=action.kind)
                triplet = Triplet(
                    video_id=f"{session.id}_{number}",
                    prompt=action.prompt,
                    prior=view.frames,
                    mask=view.mask,
                    hands=hands,
                    first_frame=image,
                    target=session.load_result(number).frames,
                    extra={
                        "kind": action.kind,
                        "session": session.id,
                        **prior_column(session.backend.simulator(session.now).prior),
                    },
                )
                record = triplet_record(triplet)
                writer.add(record.arrays, record.metadata)


def to_rerun(session: Session, path: Path) -> None:
    """Write a recording of a session for the Rerun viewer (`egosim view`)."""
    first = next(session.runs())[0]
    up = vertical(first.state, first.camera.world_from_camera[0])
    recording, state = Recording(path, session.id, up=up), first.state
    for number, before, view, _ in _steps(session):
        result = session.load_result(number)
        recording.add(
            before,
            session.action(number),
            view=view.frames,
            frames=result.frames,
            ground_truth=None,
        )
        state = result.state
    recording.close(state)
