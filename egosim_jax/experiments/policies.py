"""`egosim experiment policies`: ranks policies in the generated world and in the true one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
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
from egosim_jax.metrics import ranking, region
from egosim_jax.metrics.report import print_table
from egosim_jax.perception import Perception, registry
from egosim_jax.progress import track
from egosim_jax.state.fuse import fuse
from egosim_jax.types import Action, Clip, SceneState, Triplet, VideoSpec, check_counts
from egosim_jax.worlds.tabletop import Scene, Script, World, make_scripts
from egosim_jax.worlds.tabletop.clips import POINT_PX, film_scene
from egosim_jax.worlds.tabletop.hands import SKIN, SLEEVE
from egosim_jax.worlds.tabletop.policies import POLICIES, WITHIN_M, error_m, succeeded
from egosim_jax.worlds.tabletop.scene import FIRST_HAND

SHEET_SCENES = 2
"""Scenes on the contact sheet."""
LAST_FRAMES = 3
"""Frames at the end of a clip in which the object is looked for."""
MEASURES = {
    "true": ("true success %", "{:.0f}"),
    "frames": ("in generated frames %", "{:.0f}"),
    "state": ("in the state after %", "{:.0f}"),
}
JUDGES = ("frames", "state")
"""Readers of success in the generated world."""
DEFINITIONS = {
    "true": "share of scenes in which the executed action leaves the object within 3 cm of the "
    "goal horizontally and 2 cm vertically",
    "frames": "the same by the generated frames: the centroid of the object, segmented by color, "
    "is within 3 cm, at the goal's depth, of that of the object at the goal; median over the last "
    "3 frames",
    "state": "the same as true by the pose of the object in the state after the generated clip",
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
        moved = self._with(world_from_body).body(self.script.intent.name)
        error = error_m(moved, np.asarray(self.script.intent.goal_m))
        return {"success": float(succeeded(error)), "error_m": error[0]}

    def outcome_seen(self, frames: UInt8[np.ndarray, "f h w 3"]) -> dict[str, float]:
        """Return success and distance to the goal in meters of the object that frames show."""
        script, last = self.script, self.script.cameras
        last = replace(last, world_from_camera=last.world_from_camera[-LAST_FRAMES:])
        name, pose = script.intent.name, np.eye(4)
        pose[:3, :3] = script.scene.body(name).world_from_body[:3, :3]
        pose[:3, 3] = np.asarray(script.intent.goal_m)
        there, number = film_scene(self._with(pose), last), script.scene.number(name)
        goal = np.stack([picture.ids == number for picture in there])
        background = np.stack([p.colors for p in film_scene(script.scene, last, without=name)])
        paints = {number: script.scene.body(name).parts[0].paint.color, FIRST_HAND: SKIN,
                  FIRST_HAND + 1: SLEEVE}  # fmt: skip
        found = region.label(frames[-LAST_FRAMES:], background, paints) == number
        depth = np.median(np.stack([picture.depth_m for picture in there])[goal])
        errors = region.centroid_errors(region.open_mask(found), goal)
        error = float(np.median(errors) * depth / last.intrinsics_px[0, 0])
        return {"success": float(error <= WITHIN_M[0]), "error_m": error}

    def _with(self, world_from_body: np.ndarray) -> Scene:
        return self.script.scene.with_pose(self.script.intent.name, world_from_body)


def run(settings: Policies) -> None:
    """Execute and generate every policy in every scene; rank, compare, draw."""
    check_counts({"--scenes": settings.scenes, "--batch-size": settings.batch_size})
    perceive = registry.parse(settings.perception).build()
    generator = open_experiment(settings)
    spec, found = generator.config.video, []
    tasks = islice(_tasks(settings, spec), settings.scenes)
    for task in track(tasks, "scenes", total=settings.scenes):
        path = settings.out / "scenes" / f"{task.seed}.json"
        if not path.exists():
            videos = _generate(task, generator, settings.batch_size)
            with atomic_write(path.with_suffix(".npz")) as temporary:
                np.savez_compressed(temporary, frames=np.stack(videos))
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
            "frames": task.outcome_seen(frames),
            "state": task.outcome(_pose_in(fuse(state, perceived), task.script)),
        }
    return outcomes


def _pose_in(state: SceneState, script: Script) -> np.ndarray:
    """Return the pose of the carried object in a state: its first one, moved as perceived."""
    name = script.intent.name
    moved = state.world_from_object.get(script.scene.number(name), np.eye(4))
    return moved @ script.scene.body(name).world_from_body


def _report(out: Path, found: Sequence[Mapping]) -> None:
    success = {
        key: np.array([[scene[p.name][key]["success"] for scene in found] for p in POLICIES])
        for key in MEASURES
    }
    rows = {
        policy.name: {key: {"mean": 100 * float(success[key][row].mean())} for key in MEASURES}
        for row, policy in enumerate(POLICIES)
    }
    agreement = {judge: ranking.agreement(success[judge], success["true"]) for judge in JUDGES}
    report = {"definitions": DEFINITIONS, "scenes": len(found), "table": rows}
    write_json(out / "report.json", {**report, "agreement": agreement})
    print_table("policy", rows, MEASURES, title=f"success in {len(found)} scenes")
    title = "agreement with true success, with its 95 % interval"
    print_table("success read from", agreement, ranking.MEASURES, title=title)
    _plot(rows, out / "ranking.png")


def _plot(rows: Mapping[str, Mapping[str, Mapping[str, float]]], path: Path) -> None:
    """Plot success in the generated world against true success, a point for each policy."""
    matplotlib.use("agg")
    figure = Figure(figsize=(11, 5), layout="constrained")
    for axes, judge in zip(figure.subplots(1, 2, sharey=True), JUDGES, strict=True):
        axes.plot([0, 100], [0, 100], color="gray", linewidth=0.8)
        for name, row in rows.items():
            axes.plot(row["true"]["mean"], row[judge]["mean"], "o", label=name)
        axes.set_xlabel(MEASURES["true"][0])
        axes.set_title(f"success {MEASURES[judge][0]}")
        axes.grid(visible=True, alpha=0.3)
    figure.axes[0].legend(fontsize=8)
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
