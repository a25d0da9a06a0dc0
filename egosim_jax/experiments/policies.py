"""`egosim experiment policies`: ranks policies in the generated world and in the true one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count, islice
from pathlib import Path

import matplotlib
import numpy as np
from jaxtyping import UInt8
from matplotlib.figure import Figure

from egosim_jax.data.sheet import SheetClip, draw_sheet
from egosim_jax.experiments.config import Policies
from egosim_jax.experiments.model import open_experiment
from egosim_jax.generator import Generator, batches
from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.npz import read_arrays
from egosim_jax.io.run import write_json
from egosim_jax.io.untrusted import read_json
from egosim_jax.metrics import ranking
from egosim_jax.metrics.report import print_table, summarize
from egosim_jax.perception import Perception, registry
from egosim_jax.progress import track
from egosim_jax.state.fuse import fuse
from egosim_jax.types import Action, Clip, SceneState, Triplet, VideoSpec, check_counts
from egosim_jax.worlds.tabletop import Script, World, make_scripts
from egosim_jax.worlds.tabletop.clips import POINT_PX
from egosim_jax.worlds.tabletop.policies import POLICIES, error_m, succeeded

SHEET_SCENES = 2
"""Scenes on the contact sheet."""
MEASURES = {
    "true": ("true success %", "{:.0f}"),
    "generated": ("success in generated clips %", "{:.0f}"),
    "agree": ("same outcome %", "{:.0f}"),
}
DEFINITIONS = {
    "true": "share of scenes in which the executed action leaves the object within 3 cm of the "
    "goal horizontally and 2 cm vertically",
    "generated": "the same by the pose of the object in the state after the generated clip",
    "agree": "share of scenes with the same outcome in both",
    **ranking.DEFINITIONS,
}


@dataclass(frozen=True, kw_only=True)
class Task:
    """A scene in which an object is to be carried to a goal, and what each policy does."""

    seed: int
    """Seed of the scene."""
    script: Script
    """Script of the first clip, which carries the object."""
    actions: tuple[Action, ...]
    """Action of each policy."""

    @classmethod
    def make(cls, seed: int, script: Script) -> Task:
        """Return the task of a scene; a policy's errors depend on the scene's seed alone."""
        planned = [policy.plan(script, np.random.default_rng([seed, 2])) for policy in POLICIES]
        cameras, kind, prompt = script.cameras, script.kind, script.caption
        actions = [
            Action(cameras=cameras, joints_m=joints, kind=kind, prompt=prompt) for joints in planned
        ]
        return cls(seed=seed, script=script, actions=tuple(actions))

    def outcome(self, world_from_body: np.ndarray) -> dict[str, float]:
        """Return success and distance to the goal in meters of the object at a pose."""
        body, goal = self.script.scene.body(self.script.intent.name), self.script.intent.goal_m
        moved = self.script.scene.with_pose(body.name, world_from_body).body(body.name)
        error = error_m(moved, np.asarray(goal))
        return {"success": float(succeeded(error)), "error_m": error[0]}


def run(settings: Policies) -> None:
    """Execute and generate every policy in every scene; rank, compare, draw."""
    check_counts({"--scenes": settings.scenes, "--batch-size": settings.batch_size})
    perceive = registry.parse(settings.perception).build()
    generator = open_experiment(settings)
    spec, found = generator.config.video, []
    tasks = islice(_tasks(settings, spec), settings.scenes)
    for number, task in enumerate(track(tasks, "scenes", total=settings.scenes)):
        path = settings.out / "scenes" / f"{task.seed}.json"
        if not path.exists():
            videos = _generate(task, generator, settings.batch_size)
            if number < SHEET_SCENES:
                with atomic_write(path.with_suffix(".npz")) as temporary:
                    np.savez(temporary, frames=np.stack(videos))
            write_json(path, _outcomes(task, videos, perceive, spec))
        found.append(read_json(path))
    _report(settings.out, found)
    _draw(settings, spec)


def _tasks(settings: Policies, spec: VideoSpec) -> Iterator[Task]:
    """Yield the scenes in which an object is carried to a place on the table."""
    for seed in count(settings.first_scene):
        script = next(make_scripts(seed, spec=spec))
        if script.intent.verb == "carry":
            yield Task.make(seed, script)


def _generate(task: Task, generator: Generator, size: int) -> list[UInt8[np.ndarray, "f h w 3"]]:
    """Generate the clip of every policy, from equal noise."""
    first, state = World(scene=task.script.scene).observe(task.script.cameras)
    view = generator.renderer.render(state, task.script.cameras, point_px=POINT_PX)
    triplets = [
        Triplet(
            video_id=f"{task.seed} {policy.name}",
            prompt=action.prompt,
            prior=view.frames,
            mask=view.mask,
            hands=generator.renderer.draw_hands(action.joints_m, action.cameras, kind=action.kind)[
                0
            ],
            first_frame=first.colors,
        )
        for policy, action in zip(POLICIES, task.actions, strict=True)
    ]
    return [
        clip.frames
        for batch in batches(triplets, size)
        for clip in generator.generate(batch, [task.seed] * len(batch))
    ]


def _outcomes(
    task: Task, videos: Sequence[np.ndarray], perceive: Perception, spec: VideoSpec
) -> dict[str, dict[str, dict[str, float]]]:
    """Return the outcome of every policy in the true world and in its generated clip."""
    start = World(scene=task.script.scene, seed=task.seed)
    _, state = start.observe(task.script.cameras)
    name, outcomes = task.script.intent.name, {}
    for policy, action, frames in zip(POLICIES, task.actions, videos, strict=True):
        _, after = start.move(action)
        perceived = perceive(Clip(frames=frames, fps=spec.fps), action, state)
        outcomes[policy.name] = {
            "true": task.outcome(after.scene.body(name).world_from_body),
            "generated": task.outcome(_pose_in(fuse(state, perceived), task.script)),
        }
    return outcomes


def _pose_in(state: SceneState, script: Script) -> np.ndarray:
    """Return the pose of the carried object in a state: its first one, moved as perceived."""
    name = script.intent.name
    moved = state.world_from_object.get(script.scene.number(name), np.eye(4))
    return moved @ script.scene.body(name).world_from_body


def _report(out: Path, found: Sequence[Mapping]) -> None:
    rows, shares = {}, {"true": [], "generated": []}
    for policy in POLICIES:
        scores = []
        for scene in found:
            true, generated = (scene[policy.name][key]["success"] for key in shares)
            scores.append(
                {
                    "true": 100 * true,
                    "generated": 100 * generated,
                    "agree": 100 * (true == generated),
                }
            )
        for key in shares:
            shares[key].append([score[key] / 100 for score in scores])
        summary = summarize(scores, MEASURES)
        rows[policy.name] = {key: {"mean": value["mean"]} for key, value in summary.items()}
    agreement = ranking.agreement(np.array(shares["generated"]), np.array(shares["true"]))
    report = {"definitions": DEFINITIONS, "scenes": len(found), "table": rows}
    write_json(out / "report.json", {**report, "agreement": agreement})
    print_table("policy", rows, MEASURES, title=f"success in {len(found)} scenes")
    print_table("", {"agreement": agreement}, ranking.MEASURES, title="generated with true success")
    _plot(rows, out / "ranking.png")


def _plot(rows: Mapping[str, Mapping[str, Mapping[str, float]]], path: Path) -> None:
    """Plot success in generated clips against true success, a point for each policy."""
    matplotlib.use("agg")
    figure = Figure(figsize=(6.4, 5.6), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 100], [0, 100], color="gray", linewidth=0.8)
    for name, row in rows.items():
        axes.plot(row["true"]["mean"], row["generated"]["mean"], "o", label=name)
    axes.set_xlabel(MEASURES["true"][0])
    axes.set_ylabel(MEASURES["generated"][0])
    axes.grid(visible=True, alpha=0.3)
    axes.legend(fontsize=8)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=100)


def _draw(settings: Policies, spec: VideoSpec) -> None:
    """Draw clips of every policy: generated, and true."""
    clips = []
    for task in islice(_tasks(settings, spec), min(SHEET_SCENES, settings.scenes)):
        path = settings.out / "scenes" / f"{task.seed}.npz"
        videos = read_arrays(path, {"frames": "uint8"})["frames"]
        start = World(scene=task.script.scene, seed=task.seed)
        for policy, action, frames in zip(POLICIES, task.actions, videos, strict=True):
            true, _ = start.execute(action)
            title = f"scene {task.seed}, {policy.name}: generated, true. {action.prompt}"
            clips.append(SheetClip(title, [frames, true.frames]))
    moments = [0, spec.frames // 4, spec.frames // 2, 3 * spec.frames // 4, spec.frames - 1]
    draw_sheet(clips, settings.out / "contact_sheet.png", moments=moments)
    print(settings.out / "ranking.png", settings.out / "contact_sheet.png", sep="\n")
