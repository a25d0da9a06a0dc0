"""Session: journaled steps of one world in a folder.

    session.json              settings; renamed closed.json if the session is closed and kept
    starts/N/                 start after committed step N, if a reset or load replaced it there
    starts/first/             first start, if a reset before step 1 replaced starts/0
    steps/N/request.json      row of each frame, prompt, and hash of the request; with this file,
                              the step is accepted
    steps/N/rollout/          journal, clip and state (rollout.py)
    steps/N/info.json         metadata of the step; with this file, the step is committed
    saved/NAME/               starts that the client saved

A request is on disk before its step runs, unless it is given in parts (`parts.py`). A restarted
server therefore finishes an interrupted step from its last finished phase. A failed step is
removed, and the session stays at the step before.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Float, UInt8

from egosim_jax.interactive.env.action_spec import ActionSpec, to_numbers
from egosim_jax.interactive.env.backends import Backend, preview_info
from egosim_jax.interactive.env.batching import announced
from egosim_jax.interactive.env.chunks import Chunk, last_camera, make_chunk, state_info, view_of
from egosim_jax.interactive.env.observing import Observer, unobserved_info
from egosim_jax.interactive.env.validity import validity
from egosim_jax.interactive.server import wire
from egosim_jax.interactive.server.errors import RequestError
from egosim_jax.interactive.server.requests import request_hash
from egosim_jax.io.atomic import atomic_folder
from egosim_jax.io.bounded import check_inside, only_inside, quote, quote_path, read_json
from egosim_jax.io.digest import fingerprint
from egosim_jax.io.run import plain, write_json
from egosim_jax.simulation.rig import MountedCamera
from egosim_jax.simulation.rollout import Rollout, load_clips
from egosim_jax.simulation.start import Start, check_size
from egosim_jax.simulation.streams import Latency, Show
from egosim_jax.state import snapshot
from egosim_jax.types import Action, Cameras, InputError, SceneState

SETTINGS, CLOSED = "session.json", "closed.json"
INFO, REQUEST = "info.json", "request.json"
FIRST, SEAL = "first", "sha256"
DAMAGE = (InputError, OSError, ValueError, KeyError, TypeError, IndexError, OverflowError)
"""Errors that reading a damaged session can raise."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Result:
    """Result of a session's last step or reset, or of a part of its next step."""

    step_id: int
    """Number of the last committed step; of a part, its step."""
    frames: UInt8[np.ndarray, "f h w 3"]
    """Frames of the clip, or of the part; after a reset only the first frame."""
    state: SceneState
    """State after the step."""
    row: np.ndarray
    """Last row of hands and camera."""
    camera: Cameras
    """Camera of the last frame."""
    others: Mapping[str, UInt8[np.ndarray, "f h w 3"]] = field(default_factory=dict)
    """The frames as the further cameras see them, by name; none of a part."""
    info: Mapping[str, Any]
    """Metadata of the step: hash of the state, padded frames, validity and more."""
    part: int | None = None
    """Number of the part before the last one, from 1; it changes no state and has no `info`."""
    latency: Latency | None = None
    """Seconds from the rows of a part to its frames."""


class Session:
    """Session of a backend in a folder; only one request at a time may change it."""

    def __init__(self, folder: Path, backend: Backend):
        """Open a folder of `create`, also a closed one. Raises `InputError` if it is damaged."""
        self.folder, self.backend = folder, backend
        self.id = folder.name
        settings = settings_of(folder)
        self.actions = ActionSpec.from_json(settings["actions"])
        cameras = tuple(map(MountedCamera.from_json, settings.get("cameras", ())))
        self.observer = Observer(backend=backend, actions=self.actions, cameras=cameras)
        for name in ("starts", "steps", "saved"):
            check_inside(folder / name)  # before its files are listed
        self.running: tuple[tuple[int, str] | None, Future[Any]] | None = None
        """Last request that changes the session: number and hash of its step, and its result."""
        steps = [int(p.name) for p in (folder / "steps").glob("[0-9]*")]
        self.committed = max((n for n in steps if self._is_committed(n)), default=0)
        self._last: Result | None = None
        self.now, self.result = self._restore()

    @classmethod
    def create(
        cls,
        folder: Path,
        backend: Backend,
        actions: ActionSpec,
        start: Start,
        cameras: Sequence[MountedCamera] = (),
    ) -> Session:
        """Write and open a new session, complete or absent."""
        settings = {
            "actions": actions.to_json(),
            "video": backend.video,
            "point_px": backend.simulator(start).point_px,
            "prior": backend.simulator(start).prior,
            "seed": start.seed,
            "world": backend.identity(),
            **({"cameras": [camera.to_json() for camera in cameras]} if cameras else {}),
        }
        with atomic_folder(folder) as temporary:
            start.save(temporary / "starts" / "0")
            _write_sealed(temporary / SETTINGS, settings)
        try:
            return cls(folder, backend)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise

    @property
    def busy(self) -> bool:
        """Return True while a request changes the session."""
        return self.running is not None and not self.running[1].done()

    @property
    def pending(self) -> bool:
        """Return True if the request of the next step is on disk."""
        return (self._step(self.committed + 1) / REQUEST).exists()

    def _step(self, number: int) -> Path:
        return self.folder / "steps" / str(number)

    def _is_committed(self, number: int) -> bool:
        return (self._step(number) / INFO).exists()

    def _drop(self, number: int) -> None:
        """Remove a step."""
        # these files first: after a crash here, no half of the step can be resumed
        for name in (INFO, REQUEST):
            (self._step(number) / name).unlink(missing_ok=True)
        shutil.rmtree(self._step(number), ignore_errors=True)

    def _start(self, number: int | str) -> Path:
        return self.folder / "starts" / str(number)

    def _load_start(self, folder: Path) -> Start:
        """Read a start. Raises `InputError` if it is damaged, or of another frame size."""
        with only_inside([self.folder]):
            start = Start.load(folder)
        check_size(start, self.backend.video)
        return start

    def _starts(self) -> list[int]:
        """Return the committed steps after which the session began from a new start."""
        return sorted(int(p.name) for p in (self.folder / "starts").iterdir() if p.name.isdigit())

    def _restore(self) -> tuple[Start, Result]:
        """Read the current start and the last result from the folder."""
        if (chosen := self._start(self.committed)).exists():
            now = self._load_start(chosen)
            return now, self._reset_result(now)
        base = self._starts()[-1]
        self.now = start = self._load_start(self._start(base))  # it has the camera of the actions
        past: tuple[Action, ...] = ()
        if self.backend.needs_past:
            past = tuple(self.action(n) for n in range(base + 1, self.committed + 1))
        result = self.load_result(self.committed)
        now = replace(
            start,
            state=result.state,
            row=result.row,
            steps=start.steps + self.committed - base,
            first_frame=None,
            past=(*start.past, *past),
        )
        return now, result

    def _reset_result(self, start: Start) -> Result:
        """Return the result of a reset, which has only the first frame.

        Raises `InputError` if the world cannot continue from the start.
        """
        simulator, image = self.backend.simulator(start), start.first_frame
        if image is None:
            image = view_of(simulator, start.state, start.camera).frames[0]
        info = self._state_info(start.state, self.committed)
        if note := self.backend.note(start):
            info["scene_warning"] = note
        firsts = self.observer.first_frames(start)
        return Result(
            step_id=self.committed,
            frames=image[None],
            others={name: first[None] for name, first in firsts.items()},
            state=start.state,
            row=self.actions.rest if start.row is None else start.row,
            camera=start.camera,
            info=info,
        )

    def _state_info(self, state: SceneState, number: int) -> dict[str, Any]:
        """Return the metadata of a state in the form in which JSON keeps it."""
        return {"chunk": number, **wire.to_json(state_info(state))}

    def action(self, number: int) -> Action:
        """Return the action of an accepted step, which follows from its rows."""
        latest = number > self._starts()[-1]
        camera = self.now.camera if latest else self._load_start(self._base(number)).camera
        prompt = self._request(number)["prompt"]
        return self.actions.to_action(self.rows(number), camera=camera, prompt=prompt)[0]

    def hash_of(self, number: int) -> str:
        """Return the request hash of an accepted step."""
        return self._request(number)["request"]

    def _request(self, number: int) -> dict[str, Any]:
        """Return the request of a step. Raises `InputError` if it is damaged."""
        path = self._step(number) / REQUEST
        request = _read_sealed(path)
        prompted = isinstance(request.get("prompt"), str)
        if not prompted or not request.keys() >= {"request", "rows"}:
            raise InputError(f"{quote_path(path)} does not describe a step's request. Restore it.")
        return request

    def load_result(self, number: int) -> Result:
        """Read the result of a committed step."""
        with only_inside([self.folder]):
            return self._load_result(number, self.action(number))

    def _load_result(self, number: int, action: Action) -> Result:
        folder = self._step(number)
        clip = folder / "rollout" / "clip_1"
        info = read_json(folder / INFO)
        if not isinstance(info, dict):
            raise InputError(f"{quote_path(folder / INFO)} does not describe a step. Restore it.")
        state = clip / "state"
        names = [camera.name for camera in self.observer.cameras]
        made, others = load_clips(clip / "frames.npz", self.backend.video.fps, names)
        return Result(
            step_id=number,
            frames=made.frames,
            others={name: seen.clip.frames for name, seen in others.items()},
            # without perception, no step writes a state: the start's one stays
            state=snapshot.load(state if state.exists() else self._base(number) / "state"),
            row=self.rows(number)[-1],
            camera=last_camera(action),
            info=info,
        )

    def _base(self, number: int) -> Path:
        """Return the folder of the start from which a step was reached."""
        return self._start(max(n for n in self._starts() if n < number))

    def step(
        self, step_id: int, rows: object, prompt: str | None, show: Show | None = None
    ) -> Result:
        """Make a step, or return its result if the same step is already committed.

        `show` gets the frames of a new step only. Raises `RequestError` for a step out of order,
        and for another action under a used number.
        """
        request = request_hash(rows, prompt)
        if (result := self.committed_result(step_id, request)) is not None:
            return result
        video = self.backend.video
        chunk = make_chunk(self.actions, rows, start=self.now, video=video, prompt=prompt)
        return self.commit(step_id, chunk, request, show)

    def committed_result(self, step_id: int, request: str) -> Result | None:
        """Return the result of a step that is committed; None for the next step.

        Raises `RequestError` for a step out of order, and for another action under a used number.
        """
        if step_id <= self.committed:
            return self._repeated(step_id, request)
        if step_id != self.committed + 1:
            raise RequestError(
                409,
                "step_out_of_order",
                f"Step {step_id} cannot follow step {self.committed}: step_id must be one more "
                f"than the last committed step. Send step {self.committed + 1}.",
            )
        return None

    def commit(
        self,
        step_id: int,
        chunk: Chunk,
        request: str,
        show: Show | None = None,
        frames: UInt8[np.ndarray, "f h w 3"] | None = None,
    ) -> Result:
        """Accept, make and commit a step; its frames are given if they are made already."""
        try:
            self._accept(step_id, chunk, request)
        except OSError:
            self._drop(step_id)
            raise
        return self.finish(show, frames)

    def _repeated(self, step_id: int, request: str) -> Result:
        if self.hash_of(step_id) != request:
            raise RequestError(
                409,
                "step_used",
                f"Step {step_id} was made with another action: a used step_id repeats its result "
                f"only for the same action. The last committed step is {self.committed}; send step "
                f"{self.committed + 1}.",
            )
        last = self._last
        return last if last is not None and last.step_id == step_id else self.load_result(step_id)

    def _accept(self, number: int, chunk: Chunk, request: str) -> None:
        self._drop(number)
        fields = {
            "prompt": chunk.action.prompt,
            "rows": chunk.rows.tolist(),
            "request": request,
            **chunk.info(self.actions),
        }
        _write_sealed(self._step(number) / REQUEST, fields)

    def finish(
        self, show: Show | None = None, frames: UInt8[np.ndarray, "f h w 3"] | None = None
    ) -> Result:
        """Make and commit the accepted step, from its last finished phase or from its frames.

        After an error the step is removed.
        """
        try:
            self.result = self._last = self._run(self.committed + 1, show, frames)
        except Exception:
            self._drop(self.committed + 1)
            raise
        self.committed += 1
        return self.result

    def _run(
        self, number: int, show: Show | None, frames: UInt8[np.ndarray, "f h w 3"] | None
    ) -> Result:
        folder, action, now = self._step(number), self.action(number), self.now
        simulator = replace(self.backend.simulator(now), show=show)
        simulator = self.observer.on(simulator, self.rows(number))
        generator = simulator.generator
        with announced(generator) if frames is None else nullcontext():
            name = f"session {self.id}, step {number}"
            (step,) = Rollout(simulator, folder / "rollout", name=name).run(
                now.state,
                [action],
                seed=now.seed + now.steps,
                first_frame=now.first_frame,
                frames=frames,
            )
        request = self._request(number)
        info = {
            **self._state_info(step.state, number),
            "padded_frames": request["padded_frames"],
            "hidden_hands": request["hidden_hands"],
            "notes": list(step.notes),
            **preview_info(generator),
            **wire.to_json(validity(now.state, step, action, simulator.renderer)),
            **unobserved_info(step),
        }
        row = np.array(request["rows"][-1], float)
        write_json(folder / INFO, info)
        self.now = now.after(step.state, row, action if self.backend.needs_past else None)
        return Result(
            step_id=number,
            frames=step.clip.frames,
            others={name: seen.clip.frames for name, seen in step.others.items()},
            state=step.state,
            row=row,
            camera=last_camera(action),
            info=info,
        )

    def restart(self, start: Start) -> Result:
        """Continue from another start, with continued step numbers; an error changes nothing."""
        result = self._reset_result(start)
        self._drop(self.committed + 1)
        first = self._start(FIRST)
        if not self.committed and not first.exists():  # the next line replaces starts/0
            self.first_start().save(first)
        start.save(self._start(self.committed))
        self.now, self.result = start, result
        return result

    def first_start(self) -> Start:
        """Return the start with which the session was created."""
        first = self._start(FIRST)
        return self._load_start(first if first.exists() else self._start(0))

    def first_result(self) -> Result:
        """Return the result with which the session was created; it has only the first frame."""
        return self._reset_result(self.first_start())

    @property
    def saved(self) -> list[str]:
        """Names of the saved starts."""
        return sorted(path.name for path in (self.folder / "saved").glob("[!.]*"))

    def save(self, name: str) -> None:
        """Save the current start under a name."""
        self.now.save(self.folder / "saved" / name)

    def load(self, name: str) -> Result:
        """Continue from a saved start. Raises `RequestError` for an unknown name."""
        folder = self.folder / "saved" / name
        if not folder.exists():
            raise RequestError(
                404,
                "unknown_name",
                f"The session has saved nothing as {quote(name)}; it has {self.saved[:20]}. Save "
                "it first.",
            )
        return self.restart(self._load_start(folder))

    def runs(self) -> Iterator[tuple[Start, list[int]]]:
        """Yield each run of steps between resets and loads: its start and committed steps."""
        starts = self._starts()
        for base, end in zip(starts, [*starts[1:], self.committed], strict=True):
            if base < end:
                yield self._load_start(self._start(base)), list(range(base + 1, end + 1))

    def rows(self, number: int) -> Float[np.ndarray, "f d"]:
        """Return the row of each frame of a committed step."""
        rows = to_numbers(self._request(number)["rows"])
        if rows.ndim != 2:
            raise InputError(
                f"the rows of step {number} are {rows.shape}: each must be a list of numbers. "
                "Restore the step's request."
            )
        return rows


def settings_of(folder: Path) -> dict[str, Any]:
    """Return the settings of a session's folder. Raises `InputError` if they are damaged."""
    path = folder / (SETTINGS if (folder / SETTINGS).exists() else CLOSED)
    settings = _read_sealed(path)
    if not all(isinstance(settings.get(name), dict) for name in ("actions", "video", "world")):
        raise InputError(f"{quote_path(path)} does not describe a session. Restore it.")
    return settings


def _write_sealed(path: Path, fields: Mapping[str, Any]) -> None:
    """Write a JSON file with the hash of its fields."""
    fields = plain(fields)
    write_json(path, {**fields, SEAL: fingerprint(fields)})


def _read_sealed(path: Path) -> dict[str, Any]:
    """Return the fields of a sealed JSON file. Raises `InputError` if they were changed."""
    fields = read_json(path)
    if not isinstance(fields, dict) or fields.pop(SEAL, None) != fingerprint(fields):
        raise InputError(
            f"{quote_path(path)} was changed after it was written, or is of another version. "
            "Restore it."
        )
    return fields


def check_world(folder: Path, backend: Backend) -> None:
    """Raise `InputError` if a session was recorded in another world."""
    recorded = settings_of(folder)["world"]
    for name, value in backend.identity().items():
        if recorded.get(name) != value:
            raise InputError(
                f"The {name} of the session is {quote(recorded.get(name))}, of this server "
                f"{quote(value)}: they must be equal. Start egosim serve with the options of the "
                "session, or create a new session."
            )
