"""Evaluation of policies: all trials of policies, tasks and starts, in batches.

Trials run in threads, each as a session of one backend, which generates their clips together. A
finished trial has a file with its result, so the same command, or one with more policies, tasks or
starts, makes the others alone.
"""

from __future__ import annotations

import traceback
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Event
from typing import Any

from egosim_jax.interactive.env.backends import Backend
from egosim_jax.interactive.env.observing import Observer
from egosim_jax.interactive.env.tasks import Goal, Task, describe
from egosim_jax.interactive.env.true_world import TrueWorld
from egosim_jax.io.bounded import quote, quote_text
from egosim_jax.runtime.phases import hide_phases, phase
from egosim_jax.runtime.progress import track
from egosim_jax.simulation.rig import MountedCamera
from egosim_jax.simulation.start import Start, check_size
from egosim_jax.trials.policies import Policy, RowsError, ScriptedPolicy
from egosim_jax.trials.starts import TrialStart, carried
from egosim_jax.trials.trial import RESULT, Trial
from egosim_jax.types import InputError

NOISE = 1000
"""Distance of the noise of two seeds of a run, as a number of seeds of scenes."""


@dataclass(frozen=True, kw_only=True)
class Results:
    """Results of the trials of a run."""

    finished: list[dict[str, Any]] = field(default_factory=list)
    """Result of each finished trial, in the order of the trials."""
    failed: dict[str, str] = field(default_factory=dict)
    """Error of each trial that could not be made, by what it is."""


def plan(
    backend: Backend,
    policies: Sequence[Policy],
    tasks: Sequence[Task],
    starts: Sequence[TrialStart],
    *,
    seed: int,
    cameras: tuple[MountedCamera, ...] = (),
) -> list[Trial]:
    """Return all trials: each policy with each task, from each start that has its objects.

    Policies also see the clips of further `cameras`.

    Raises `InputError` if the world cannot begin from a start, and for a task that no start has.
    """
    trials: list[Trial] = []
    with phase(f"makes {len(starts)} scenes", only_if_long=True):
        for place in starts:
            begun: dict[str, Start] = {}
            for policy in policies:
                key = repr(policy.actions)
                if key not in begun:
                    begun[key] = _begin(backend, place, policy, seed)
                    _check_cameras(backend, policy, begun[key], cameras)
                made_of = _trials(backend, policy, tasks, place, begun[key])
                trials += [replace(trial, cameras=cameras) for trial in made_of]
    made = {trial.group for trial in trials}
    for task in tasks:
        if task.text not in made:
            objects = describe(_begin(backend, starts[0], policies[0], seed).state)
            raise InputError(
                f"No start has the task {quote(task.text)}: it needs the named objects, or for "
                f"carry a tabletop scene whose script carries one. {starts[0].name} has "
                f"{objects}. (--tasks)"
            )
    return trials


def _begin(backend: Backend, place: TrialStart, policy: Policy, seed: int) -> Start:
    """Return the start of a policy's trials. Raises `InputError` if the world has it not."""
    start = place.begin(backend, policy.actions)
    try:
        check_size(start, backend.video)
        backend.simulator(start)
    except InputError as error:
        raise InputError(f"{quote_text(place.name)}: {error} (--starts)") from error
    if isinstance(backend, TrueWorld):  # no noise; its seed is the scene's
        return start
    return replace(start, seed=start.seed + NOISE * seed)


def _check_cameras(
    backend: Backend, policy: Policy, start: Start, cameras: tuple[MountedCamera, ...]
) -> None:
    """Raise `InputError` if a camera is on a hand that a policy has not, or sees nothing."""
    observer = Observer(backend=backend, actions=policy.actions, cameras=cameras)
    observer.first_frames(start)


def _trials(
    backend: Backend, policy: Policy, tasks: Sequence[Task], place: TrialStart, start: Start
) -> list[Trial]:
    script = place.script(policy.actions, backend.video)
    loose = place.loose(start, policy.actions, backend.video)
    goals: dict[str, tuple[str, Goal]] = {}
    for task in tasks:
        for text, goal in task.goals(start, loose=loose, carried=carried(script)).items():
            goals.setdefault(text, (task.text, goal))
    trials = []
    for text, (group, goal) in goals.items():
        if isinstance(policy, ScriptedPolicy) and text != "carry":
            policy.refuse(text)
        row = policy.first_row(script, start.seed)
        scene_seed = None if isinstance(backend, TrueWorld) else place.seed
        trials.append(
            Trial(
                policy=policy,
                task=text,
                group=group,
                goal=goal,
                place=place.name,
                start=start if row is None else replace(start, row=row),
                script=script,
                scene_seed=scene_seed,
            )
        )
    return trials


def run_all(
    trials: Sequence[Trial], backend: Backend, out: Path, *, clips: int, batch: int
) -> Results:
    """Make all trials, at most `batch` at once, and return their results.

    A trial whose policy fails, such as a server that ends, is reported; the same command makes it
    again. Rows of the wrong length end the run by an `InputError`.
    """
    folder, stop = out / "trials", Event()
    made = sum((folder / trial.id / RESULT).exists() for trial in trials)
    if made:
        with phase(f"{out}: {made} of {len(trials)} trials made before"):
            pass  # one line: a resumed run must not look like a new one
    results: dict[str, dict[str, Any]] = {}
    failed: dict[str, str] = {}
    with hide_phases(), ThreadPoolExecutor(batch, thread_name_prefix="trial") as threads:
        futures: dict[Future[dict[str, Any]], Trial] = {
            threads.submit(trial.run, backend, folder, clips=clips, stop=stop): trial
            for trial in trials
        }
        try:
            for future in track(as_completed(futures), "trials", total=len(futures)):
                trial = futures[future]
                if (error := future.exception()) is None:
                    results[trial.id] = future.result()
                elif isinstance(error, Exception) and not isinstance(error, RowsError):
                    words = f"{trial.policy.name}, {trial.task}, {trial.place}"
                    failed[words] = _reason(error)
                else:
                    raise error
        except BaseException:
            stop.set()
            threads.shutdown(wait=True, cancel_futures=True)
            raise
    ordered = [results[trial.id] for trial in trials if trial.id in results]
    return Results(finished=ordered, failed=failed)


def _reason(error: Exception) -> str:
    """Return an error in one line, with the place where it was raised in the policy."""
    *_, last = traceback.extract_tb(error.__traceback__)
    place = f"{Path(last.filename).name}:{last.lineno}"
    return quote_text(f"{type(error).__name__}: {error} ({place})")


def by_policy(finished: Sequence[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Return the results of each policy."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for result in finished:
        groups.setdefault(result["policy"], []).append(result)
    return groups
