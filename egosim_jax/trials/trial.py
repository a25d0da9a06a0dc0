"""One trial: a policy with a task, from a start, as a journaled session of its world.

    trials/ID/trial.json   result; with this file, the trial is finished
    trials/ID/video.mp4    all clips
    trials/ID/...          the session (`interactive/server/session.py`)

An interrupted trial begins again with its first clip: the policy is asked again, and clips whose
rows are equal are read from the session. If a policy decides otherwise, the session begins again.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
from jaxtyping import Float

from egosim_jax.interactive.env.backends import Backend
from egosim_jax.interactive.env.chunks import make_chunk, state_info, view_of
from egosim_jax.interactive.env.rewards import Outcome, Reward
from egosim_jax.interactive.env.tasks import Goal
from egosim_jax.interactive.server.errors import RequestError
from egosim_jax.interactive.server.requests import request_hash
from egosim_jax.interactive.server.session import DAMAGE, SETTINGS, Result, Session
from egosim_jax.io.bounded import quote_path, read_json
from egosim_jax.io.run import write_json
from egosim_jax.io.writing import write_frames
from egosim_jax.simulation.rig import MountedCamera
from egosim_jax.simulation.simulator import Step
from egosim_jax.simulation.start import Start
from egosim_jax.trials.agreement import agreement
from egosim_jax.trials.policies import Infer, Policy, rows_of
from egosim_jax.types import Clip, InputError
from egosim_jax.worlds.tabletop import Script

RESULT, VIDEO = "trial.json", "video.mp4"


class Stopped(Exception):  # noqa: N818 - not an error of the trial
    """Raised in the thread of a trial when the run ends early."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """A policy with a task, from a start."""

    policy: Policy
    """Policy that acts."""
    task: str
    """Text of the task, with the name of its object."""
    group: str
    """Text of the task as it was given, for tables."""
    goal: Goal
    """Goal of the task in the scene."""
    place: str
    """Name of the start."""
    start: Start
    """Start of the trial."""
    script: Script | None
    """Script of the scene, for scripted policies."""
    scene_seed: int | None
    """Seed of the scene if it is of the tabletop world and a model makes the clips."""
    cameras: tuple[MountedCamera, ...] = ()
    """Further cameras that the policy sees."""

    @property
    def id(self) -> str:
        """Name of the folder."""
        words = (self.policy.name, self.task, self.place)
        digest = sha256("\n".join((*words, self.policy.text)).encode()).hexdigest()[:8]
        return f"{'_'.join(slug(word)[:16] for word in words)}_{digest}"

    def run(self, backend: Backend, folder: Path, *, clips: int, stop: Event) -> dict[str, Any]:
        """Return the result of the trial, made now or read from its folder."""
        folder = folder / self.id
        if (folder / RESULT).exists():
            return read_result(folder)
        try:
            return self._run(self._session(folder, backend), clips, stop)
        except RequestError as error:  # the policy decides otherwise than before
            if error.code != "step_used":
                raise
            shutil.rmtree(folder)
            return self._run(self._session(folder, backend), clips, stop)

    def _session(self, folder: Path, backend: Backend) -> Session:
        """Return the session of the trial, a new one if the one on disk is damaged."""
        if (folder / SETTINGS).exists():
            try:
                return Session(folder, backend)
            except DAMAGE:
                shutil.rmtree(folder)
        return Session.create(folder, backend, self.policy.actions, self.start, self.cameras)

    def _run(self, session: Session, clips: int, stop: Event) -> dict[str, Any]:
        rewards: list[Reward] = []
        results = [session.first_result()]
        ended = "clips"
        with self.policy.agent(self.script, self.start.seed) as infer:
            for number in range(1, clips + 1):
                if stop.is_set():
                    raise Stopped
                step = self._step(session, number, infer, results[-1])
                if not isinstance(step, Result):
                    ended = step
                    break
                rewards.append(self._judged(session, number, results[-1], step))
                results.append(step)
                if rewards[-1].terminated:
                    ended = "success" if rewards[-1].success else "broken"
                    break
        return self._finish(session, results, rewards, ended)

    def _step(self, session: Session, number: int, infer: Infer, last: Result) -> Result | str:
        """Return the result of the next clip, or the reason for which the trial ends."""
        video = session.backend.video
        reply = infer(self._observation(session, number, last))
        rows = rows_of(reply, session.actions, last.row, video.frames)
        if rows is None:
            return "policy"
        request = request_hash(rows, None)
        if (result := session.committed_result(number, request)) is not None:
            return result
        try:
            chunk = make_chunk(session.actions, rows, start=session.now, video=video)
        except InputError as error:
            return f"refused: {error}"
        return session.commit(number, chunk, request)

    def _judged(self, session: Session, number: int, before: Result, step: Result) -> Reward:
        """Return the reward of a clip."""
        if self.goal.judge_of is None:
            return self.goal.judge(self.start.state, step.state)
        simulator = session.backend.simulator(session.now)
        made = Step(
            view=view_of(simulator, before.state, session.action(number).cameras),
            clip=Clip(frames=step.frames, fps=session.backend.video.fps),
            state=step.state,
            notes=tuple(step.info["notes"]),
        )
        return self.goal(Outcome(first=self.start.state, step=made))

    def _observation(self, session: Session, number: int, last: Result) -> dict[str, Any]:
        seen, count = {"": last.frames}, session.backend.video.frames
        seen |= {f"{name}.": frames for name, frames in last.others.items()}
        images: dict[str, Any] = {}
        for name, frames in seen.items():
            if len(frames) < count:  # after a reset there is one
                frames = np.repeat(frames[:1], count, axis=0)
            images |= {f"{name}frames": frames.copy(), f"{name}image": frames[-1].copy()}
        return {
            **images,
            "row": last.row.copy(),
            "keypoints": session.actions.joints(last.row[None])[0].copy(),
            "prompt": self.goal.instruction,
            "chunk": number - 1,
            "seed": self.start.seed,
            "info": state_info(last.state),
        }

    def _finish(
        self, session: Session, results: list[Result], rewards: list[Reward], ended: str
    ) -> dict[str, Any]:
        """Write the video and the result."""
        write_frames(session.folder / VIDEO, _frames(results), session.backend.video.fps)
        result = {
            "policy": self.policy.name,
            "task": self.task,
            "group": self.group,
            "start": self.place,
            "instruction": self.goal.instruction,
            "success": bool(rewards and rewards[-1].success),
            "ended": ended,
            "clips": len(rewards),
            "rewards": [reward.reward for reward in rewards],
            "successes": [reward.success for reward in rewards],
            "held_frames": sum(result.info["padded_frames"] for result in results[1:]),
            "notes": [note for result in results[1:] for note in result.info["notes"]],
            **agreement(session, self.goal, self.scene_seed),
        }
        write_json(session.folder / RESULT, result)
        return read_result(session.folder)


def _frames(results: list[Result]) -> Iterator[Float[np.ndarray, "h w 3"]]:
    """Yield the frames of all clips; each clip begins with the last frame of the one before."""
    yield results[0].frames[0] if len(results) == 1 else results[1].frames[0]
    for result in results[1:]:
        yield from result.frames[1:]


def slug(text: str) -> str:
    """Return a text as a name of a file."""
    return re.sub(r"[^A-Za-z0-9]+", "-", text).strip("-").lower() or "x"


def read_result(folder: Path) -> dict[str, Any]:
    """Return the result of a finished trial. Raises `InputError` if it is damaged."""
    result = read_json(folder / RESULT)
    if not isinstance(result, dict) or not isinstance(result.get("success"), bool):
        raise InputError(
            f"{quote_path(folder / RESULT)} is no result of a trial. Remove {quote_path(folder)}, "
            "and the same command makes the trial again."
        )
    return {**result, "id": folder.name}
