"""Trials as LeRobot datasets, with reward, success and end: one dataset for each policy.

A clip has one reward, at its last row. `next.done` is true from the last row of the trial on, and
`next.success` with it. The last frame of an episode has no action that follows: it repeats its row.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.data.lerobot_writer import ClipRecord, EpisodeRecord, write_lerobot
from egosim_jax.interactive.env.backends import Backend
from egosim_jax.interactive.server.dataset_export import clip_record
from egosim_jax.interactive.server.session import Session
from egosim_jax.io.digest import fingerprint
from egosim_jax.trials.evaluation import by_policy
from egosim_jax.trials.trial import slug

REWARD, SUCCESS, DONE = "next.reward", "next.success", "next.done"
MADE_OF = "egosim_trials"
"""Hash of the trials in the description of a dataset."""


def write_datasets(
    out: Path, finished: Sequence[Mapping[str, Any]], backend: Backend
) -> Iterator[Path]:
    """Write a dataset for each policy, unless it is there, and yield its folder.

    An older dataset, of other trials, is replaced. Trials without a clip are not in it.
    """
    for policy, trials in by_policy(finished).items():
        acted = [trial for trial in trials if trial["clips"]]
        folder, made_of = out / "lerobot" / slug(policy), fingerprint(acted)
        if not acted:
            continue
        if _made_of(folder) != made_of:
            shutil.rmtree(folder, ignore_errors=True)
            sessions = (Session(out / "trials" / trial["id"], backend) for trial in acted)
            first = Session(out / "trials" / acted[0]["id"], backend)
            write_lerobot(
                folder,
                (
                    EpisodeRecord(
                        clips=_clips(session, trial), save_scene=partial(_save_scene, session)
                    )
                    for session, trial in zip(sessions, acted, strict=True)
                ),
                names=first.actions.names,
                fps=backend.video.fps,
                robot_type="gripper" if first.actions.kind == "robot" else "human_hands",
                about={MADE_OF: made_of, "policy": policy},
            )
        yield folder


def _made_of(folder: Path) -> str | None:
    """Return the hash of the trials in a dataset; None if there is no dataset of this program."""
    try:
        info = json.loads((folder / "meta" / "info.json").read_text("utf-8"))
        return info[MADE_OF]
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _save_scene(session: Session, folder: Path) -> None:
    session.first_start().save(folder)


def _clips(session: Session, trial: Mapping[str, Any]) -> Iterator[ClipRecord]:
    """Yield the clips of a trial; the caption is the instruction, as LeRobot's task."""
    count = trial["clips"]
    for number in range(1, count + 1):
        record = clip_record(session, number)
        count_rows = len(record.rows)
        reward, ended = np.zeros(count_rows, np.float32), np.zeros(count_rows, bool)
        reward[-2] = trial["rewards"][number - 1]  # of the action that leads to the last frame
        if number == count:
            ended[-2:] = True
        judged = {REWARD: reward, SUCCESS: ended & trial["success"], DONE: ended}
        yield replace(
            record,
            action=replace(record.action, prompt=trial["instruction"]),
            others={**record.others, **judged},
        )
