"""One session: journaled steps in a folder.

    session.json              settings; closed.json once it is closed and kept
    starts/N/                 start after committed step N, where a reset or load chose one
    starts/first/             first start, if a reset before the first step has replaced it in 0
    steps/N/request.json      row of each frame, prompt and hash of a step's request
    steps/N/action.npz        cameras and joints; the step is accepted when both are there
    steps/N/rollout/          journal, clip and state (rollout.py)
    steps/N/info.json         what is known of the step; it is committed when this is there
    saved/NAME/               starts that the client saved

A request is on disk before its step runs, so a killed server finishes the step that was under way,
from its last finished phase. A step that fails is removed: the session is where it was.
"""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Float, UInt8

from egosim_jax.interactive.env.action_spec import ActionSpec, numbers
from egosim_jax.interactive.env.backends import Backend
from egosim_jax.interactive.env.batching import announced
from egosim_jax.interactive.env.chunks import Chunk, last_camera, make_chunk, validity, view_of
from egosim_jax.interactive.env.specs import spec_of, vars_of
from egosim_jax.interactive.env.start import Start
from egosim_jax.interactive.server.errors import RequestError
from egosim_jax.io.bounded import quote, quote_path, read_json
from egosim_jax.io.fingerprint import fingerprint
from egosim_jax.io.run import write_json
from egosim_jax.simulation.actions import check_action, load_action, save_action
from egosim_jax.simulation.rollout import Rollout, load_clip
from egosim_jax.state import snapshot
from egosim_jax.types import Action, Cameras, InputError, SceneState

SETTINGS, CLOSED = "session.json", "closed.json"
INFO, REQUEST, ACTION = "info.json", "request.json", "action.npz"
FIRST = "first"
Show = Callable[[UInt8[np.ndarray, "g h w 3"]], None]
"""Function that gets the frames of a step in groups, as soon as they are known."""
DAMAGE = (InputError, OSError, ValueError, KeyError, TypeError, IndexError)
"""Errors of reading a session whose files are damaged."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Result:
    """Position of a session: its last step with clip and state."""

    step_id: int
    """Committed steps of the session."""
    frames: UInt8[np.ndarray, "f h w 3"]
    """Frames of the clip; after a reset its first frame alone."""
    state: SceneState
    """State after the step."""
    row: np.ndarray
    """Last row of hands and camera."""
    camera: Cameras
    """Camera of the last frame."""
    info: Mapping[str, Any]
    """Hash of the state, padded frames, validity and more of the step."""


class Session:
    """Session of a backend in a folder; one request at a time changes it."""

    def __init__(self, folder: Path, backend: Backend):
        """Open what `create` wrote, open or closed. Raises `InputError` if it is damaged."""
        self.folder, self.backend = folder, backend
        self.id = folder.name
        self.actions = spec_of(settings_of(folder)["actions"])
        self.busy = threading.Lock()
        self.flight: tuple[tuple[int, str], Future[Result]] | None = None
        """Number and hash of the step that is under way, and its future result."""
        steps = [int(p.name) for p in (folder / "steps").glob("[0-9]*")]
        self.committed = max((n for n in steps if self._is_committed(n)), default=0)
        self._made: Result | None = None
        self.now, self.result = self._where()

    @classmethod
    def create(cls, folder: Path, backend: Backend, actions: ActionSpec, start: Start) -> Session:
        """Write the folder of a new session and open it; after an error there is no folder."""
        settings = {
            "actions": vars_of(actions),
            "video": backend.video,
            "seed": start.seed,
            "world": backend.identity(),
        }
        try:
            start.save(folder / "starts" / "0")
            write_json(folder / SETTINGS, settings)
            return cls(folder, backend)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise

    @property
    def pending(self) -> bool:
        """Return True if the request of the next step is on disk."""
        folder = self._step(self.committed + 1)
        return all((folder / name).exists() for name in (REQUEST, ACTION))

    def _step(self, number: int) -> Path:
        return self.folder / "steps" / str(number)

    def _is_committed(self, number: int) -> bool:
        return (self._step(number) / INFO).exists()

    def _drop(self, number: int) -> None:
        """Remove a step, in an order in which a crash leaves no half of it to be resumed."""
        for name in (INFO, ACTION):
            (self._step(number) / name).unlink(missing_ok=True)
        shutil.rmtree(self._step(number), ignore_errors=True)

    def _where(self) -> tuple[Start, Result]:
        """Return start and result of a session that is read from its folder."""
        chosen = self.folder / "starts" / str(self.committed)
        if chosen.exists():
            now = Start.load(chosen)
            return now, self._opening(now)
        base = max(int(p.name) for p in (self.folder / "starts").iterdir() if p.name.isdigit())
        past: tuple[Action, ...] = ()
        if self.backend.needs_past:
            past = tuple(self.action(n) for n in range(base + 1, self.committed + 1))
        result, start = self.repeat(self.committed), Start.load(self.folder / "starts" / str(base))
        now = replace(
            start,
            state=result.state,
            row=result.row,
            steps=start.steps + self.committed - base,
            first_frame=None,
            past=(*start.past, *past),
        )
        return now, result

    def _opening(self, start: Start) -> Result:
        """Return the result of a reset: the first frame alone.

        Raises `InputError` for a start that the world cannot continue from.
        """
        simulator, image = self.backend.simulator(start), start.first_frame
        if image is None:
            image = view_of(simulator, start.state, start.camera).frames[0]
        return Result(
            step_id=self.committed,
            frames=image[None],
            state=start.state,
            row=self.actions.rest if start.row is None else start.row,
            camera=start.camera,
            info=self._facts(start.state, self.committed),
        )

    def _facts(self, state: SceneState, number: int) -> dict[str, Any]:
        names = {str(key): name for key, name in state.names.items()}
        return {"chunk": number, "state_sha256": snapshot.fingerprint(state), "objects": names}

    def action(self, number: int) -> Action:
        """Return the action of a step that is on disk."""
        request = self._request(number)
        return load_action(
            self._step(number) / ACTION,
            kind=self.actions.kind,
            size=(self.backend.video.height, self.backend.video.width),
            prompt=request["prompt"],
        )

    def request(self, number: int) -> str:
        """Return the hash of the request of a step that is on disk."""
        return self._request(number)["request"]

    def _request(self, number: int) -> dict[str, Any]:
        """Return the request of a step. Raises `InputError` if it is damaged."""
        path = self._step(number) / REQUEST
        found = read_json(path)
        if not isinstance(found, dict) or not found.keys() >= {"prompt", "request", "rows"}:
            raise InputError(f"{quote_path(path)} does not describe a step's request. Restore it.")
        return found

    def repeat(self, number: int) -> Result:
        """Return the result of a committed step from its files."""
        folder, action = self._step(number), self.action(number)
        request, clip = self._request(number), folder / "rollout" / "clip_1"
        info = read_json(folder / INFO)
        state = clip / "state"
        return Result(
            step_id=number,
            frames=load_clip(clip / "frames.npz", self.backend.video.fps).frames,
            state=snapshot.load(state if state.exists() else self._base(number) / "state"),
            row=np.array(request["rows"][-1], float),
            camera=last_camera(action),
            info=info,
        )

    def _base(self, number: int) -> Path:
        """Return the start of the run of steps that a step belongs to."""
        starts = [int(p.name) for p in (self.folder / "starts").iterdir() if p.name.isdigit()]
        return self.folder / "starts" / str(max(n for n in starts if n < number))

    def step(
        self, step_id: int, rows: object, prompt: str | None, show: Show | None = None
    ) -> Result:
        """Make a step, or return the result of the same one that was made before.

        The frames of a step that is made are shown, those of a repeated one are not. Raises
        `RequestError` for a step out of order, or for another action under a used number.
        """
        request = request_hash(rows, prompt)
        if step_id <= self.committed:
            return self._again(step_id, request)
        if step_id != self.committed + 1:
            raise RequestError(
                409,
                "step_out_of_order",
                f"Step {step_id} cannot follow step {self.committed}: step_id must be one more "
                f"than the last committed step. Send step {self.committed + 1}.",
            )
        video, now = self.backend.video, self.now
        chunk = make_chunk(self.actions, rows, start=now, frames=video.frames, prompt=prompt)
        check_action(chunk.action, state=now.state, fps=video.fps, continued=True)
        self._accept(step_id, chunk, request)
        return self.finish(show)

    def _again(self, step_id: int, request: str) -> Result:
        if self.request(step_id) != request:
            raise RequestError(
                409,
                "step_used",
                f"Step {step_id} was made with another action: a used step_id repeats its result "
                f"only for the same action. Committed is step {self.committed}; send step "
                f"{self.committed + 1}.",
            )
        made = self._made
        return made if made is not None and made.step_id == step_id else self.repeat(step_id)

    def _accept(self, number: int, chunk: Chunk, request: str) -> None:
        folder = self._step(number)
        self._drop(number)
        about = {
            "prompt": chunk.action.prompt,
            "rows": chunk.rows.tolist(),
            "request": request,
            **chunk.info(self.actions),
        }
        write_json(folder / REQUEST, about)
        save_action(folder / ACTION, chunk.action)

    def finish(self, show: Show | None = None) -> Result:
        """Make the step whose request is on disk, from its last finished phase; commit it.

        After an error the request is removed.
        """
        try:
            self.result = self._made = self._finished(self.committed + 1, show)
        except Exception:
            self._drop(self.committed + 1)
            raise
        self.committed += 1
        return self.result

    def _finished(self, number: int, show: Show | None) -> Result:
        folder, action, now = self._step(number), self.action(number), self.now
        simulator = replace(self.backend.simulator(now), show=show)
        with announced(simulator.generator):
            (step,) = Rollout(simulator, folder / "rollout").run(
                now.state, [action], seed=now.seed + now.steps, first_frame=now.first_frame
            )
        request = self._request(number)
        info = {
            **self._facts(step.state, number),
            "padded_frames": request["padded_frames"],
            "hidden_hands": request["hidden_hands"],
            "validity": validity(step, action, simulator.renderer),
        }
        row = np.array(request["rows"][-1], float)
        write_json(folder / INFO, info)
        self.now = now.after(step.state, row, action if self.backend.needs_past else None)
        return Result(
            step_id=number,
            frames=step.clip.frames,
            state=step.state,
            row=row,
            camera=last_camera(action),
            info=info,
        )

    def restart(self, start: Start) -> Result:
        """Continue from another start; step numbers continue. A refused one changes nothing."""
        result = self._opening(start)
        self._drop(self.committed + 1)
        first = self.folder / "starts" / FIRST
        if not self.committed and not first.exists():
            self.first().save(first)
        start.save(self.folder / "starts" / str(self.committed))
        self.now, self.result = start, result
        return result

    def first(self) -> Start:
        """Return the start with which the session was created."""
        first = self.folder / "starts" / FIRST
        return Start.load(first if first.exists() else self.folder / "starts" / "0")

    @property
    def saved(self) -> list[str]:
        """Return the names of what is saved."""
        return sorted(path.name for path in (self.folder / "saved").glob("[!.]*"))

    def save(self, name: str) -> None:
        """Save where the session is under a name."""
        self.now.save(self.folder / "saved" / name)

    def load(self, name: str) -> Result:
        """Continue from a saved start. Raises `RequestError` if there is none of that name."""
        folder = self.folder / "saved" / name
        if not folder.exists():
            raise RequestError(
                404,
                "unknown_name",
                f"The session has saved nothing as {quote(name)}; it has {self.saved[:20]}. Save "
                "it first.",
            )
        return self.restart(Start.load(folder))

    def runs(self) -> Iterator[tuple[Start, list[int]]]:
        """Yield the start and the committed steps of each stretch between resets and loads."""
        starts = sorted(int(p.name) for p in (self.folder / "starts").iterdir() if p.name.isdigit())
        for base, end in zip(starts, [*starts[1:], self.committed], strict=True):
            if base < end:
                steps = list(range(base + 1, end + 1))
                yield Start.load(self.folder / "starts" / str(base)), steps

    def check(self) -> None:
        """Read all that an export takes of the session. Raises an error of `DAMAGE`."""
        for start, steps in self.runs():
            self.backend.simulator(start)
            for number in steps:
                self.repeat(number)
                self.rows(number)

    def rows(self, number: int) -> Float[np.ndarray, "f d"]:
        """Return the row of each frame of a committed step."""
        return np.array(self._request(number)["rows"], float)


def settings_of(folder: Path) -> dict[str, Any]:
    """Return the settings of a session's folder. Raises `InputError` if they are damaged."""
    path = folder / (SETTINGS if (folder / SETTINGS).exists() else CLOSED)
    settings = read_json(path)
    if not isinstance(settings, dict) or not isinstance(settings.get("actions"), dict):
        raise InputError(f"{quote_path(path)} does not describe a session. Restore it.")
    return settings


def check_world(folder: Path, backend: Backend) -> None:
    """Raise `InputError` if a session was recorded in another world, which cannot continue it."""
    recorded = settings_of(folder).get("world")
    if not isinstance(recorded, dict):  # of a version that did not record it
        return
    for name, value in backend.identity().items():
        if recorded.get(name) != value:
            raise InputError(
                f"The {name} of the session is {quote(recorded.get(name))}, of this server "
                f"{quote(value)}: they must be equal. Start egosim serve with the options that it "
                "was made with, or create a new session."
            )


def request_hash(rows: object, prompt: str | None) -> str:
    """Return the hash by which a repeated request is recognized.

    Raises `InputError` for rows that are no numbers.
    """
    return fingerprint((numbers(rows), prompt))
