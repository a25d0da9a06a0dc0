"""`egosim experiment policies`: rank policies in the generated world and in the true world."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count, islice
from pathlib import Path

import matplotlib
import numpy as np
from jaxtyping import UInt8
from matplotlib.figure import Figure

from egosim_jax.data.sheet import SheetClip, draw_sheet
from egosim_jax.evaluation.metrics import rank_correlation, region
from egosim_jax.evaluation.metrics.report import Summary, print_table
from egosim_jax.experiments.config import Policies
from egosim_jax.generation.encoding import batches
from egosim_jax.generation.generator import Generator
from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.bounded import read_json
from egosim_jax.io.run import write_json
from egosim_jax.io.untrusted.npz import read_arrays
from egosim_jax.perception import Perception, registry
from egosim_jax.runtime.progress import track
from egosim_jax.state.fuse import fuse
from egosim_jax.types import Action, Cameras, Clip, SceneState, Triplet, VideoSpec, check_counts
from egosim_jax.worlds.tabletop import Scene, Script, World, make_scripts
from egosim_jax.worlds.tabletop.clips import Arm, paints_of, place, render_scenes
from egosim_jax.worlds.tabletop.policies import MAX_ERROR_M, POLICIES, goal_error_m, succeeded
from egosim_jax.worlds.tabletop.world import arms_of

SHEET_SCENES = 2
"""Number of scenes on the contact sheet."""
LAST_FRAMES = 3
"""Number of frames at the end of a clip that are searched for the object."""
MEASURES = {
    "true": ("true success %", "{:.0f}"),
    "seen": ("in ground-truth frames %", "{:.0f}"),
    "frames": ("in generated frames %", "{:.0f}"),
    "state": ("in the state after %", "{:.0f}"),
}

Videos = Sequence[UInt8[np.ndarray, "f h w 3"]]
"""Generated clips of all policies in one scene."""
Outcomes = Mapping[str, Mapping[str, float]]
"""Success and error in meters of every policy in one scene, by name."""
Judge = Callable[["Task", Videos], Outcomes]
"""Function that measures the outcomes in one scene."""
DEFINITIONS = {
    "true": "share of scenes in which the executed action leaves the object within 3 cm of the "
    "goal horizontally and 2 cm vertically",
    "seen, frames": "the same by the ground-truth and by the generated frames: the centroid of the "
    "object, segmented by color among the colors of all bodies, is within 3 cm, at the goal's "
    "depth, of the centroid of the object at the goal; median over the last 3 frames in which the "
    "hand does not hide it; else no success",
    "state": "as true, by the pose of the object in the state after the generated clip",
    **rank_correlation.DEFINITIONS,
}


@dataclass(frozen=True, kw_only=True)
class Task:
    """A scene with an object to carry to a goal, and the action of each policy."""

    seed: int
    """Seed of the scene."""
    script: Script
    """Script of the first clip, which carries the object."""
    actions: tuple[Action, ...]
    """Action of each policy."""

    @classmethod
    def make(cls, seed: int, script: Script) -> Task:
        """Return the task of a scene; a policy's errors depend only on the seed."""
        planned = [policy.plan(script, np.random.default_rng([seed, 2])) for policy in POLICIES]
        cameras, kind, prompt = script.cameras, script.kind, script.caption
        actions = [
            Action(cameras=cameras, joints_m=joints, kind=kind, prompt=prompt) for joints in planned
        ]
        return cls(seed=seed, script=script, actions=tuple(actions))

    def outcome(self, world_from_body: np.ndarray) -> dict[str, float]:
        """Return success, and the distance in meters to the goal, of the object at a pose."""
        moved = self._with(world_from_body).body(self.script.intent.name)
        error = goal_error_m(moved, np.asarray(self.script.intent.goal_m))
        return {"success": float(succeeded(error)), "error_m": error[0]}

    def outcome_seen(
        self, frames: UInt8[np.ndarray, "f h w 3"], action: Action
    ) -> dict[str, float]:
        """Return success, and the distance in meters to the goal, of the object in last frames.

        The distance is missing if the hand hides the object's goal position in all frames.
        """
        script, name, pose = self.script, self.script.intent.name, np.eye(4)
        number, last = script.scene.instance_id(name), self.last_cameras
        pose[:3, :3] = script.scene.body(name).world_from_body[:3, :3]
        pose[:3, 3] = np.asarray(script.intent.goal_m)
        arms = self.last_arms(action)
        there = render_scenes([self._with(pose)] * LAST_FRAMES, last, arms=arms)
        goal = np.stack([frame.ids == number for frame in there])
        bare = render_scenes([script.scene] * LAST_FRAMES, last, without=name)
        background = np.stack([frame.colors for frame in bare])
        paints = paints_of(place(script.scene, arms[-1]))
        errors = region.centroid_errors(region.find(number, frames, background, paints), goal)
        if not len(errors):
            return {"success": 0.0}
        depth = np.median(np.stack([frame.depth_m for frame in there])[goal])
        error = float(np.median(errors) * depth / last.intrinsics_px[0, 0])
        return {"success": float(error <= MAX_ERROR_M[0]), "error_m": error}

    def last_frames(self, action: Action) -> UInt8[np.ndarray, "f h w 3"]:
        """Return the last ground-truth frames of an action."""
        scenes, _ = World(scene=self.script.scene).move(action)
        rendered = render_scenes(
            scenes[-LAST_FRAMES:], self.last_cameras, arms=self.last_arms(action)
        )
        return np.stack([frame.colors for frame in rendered])

    @property
    def last_cameras(self) -> Cameras:
        """Cameras of the last frames."""
        cameras = self.script.cameras
        return replace(cameras, world_from_camera=cameras.world_from_camera[-LAST_FRAMES:])

    def last_arms(self, action: Action) -> list[list[Arm | None]]:
        """Return joints and meshes of the hands in the last frames."""
        joints = action.joints_m[-LAST_FRAMES:]
        return arms_of(joints, action.kind)

    def _with(self, world_from_body: np.ndarray) -> Scene:
        return self.script.scene.with_pose(self.script.intent.name, world_from_body)


def run(settings: Policies) -> None:
    """Execute and generate every policy in every scene; rank, compare and draw.

    A first report has success by frames; the final report adds success by states, which needs slow
    perception of every clip.
    """
    check_counts({"--scenes": settings.scenes, "--batch-size": settings.batch_size})
    perceive = registry.parse(settings.perception).build()
    generator = settings.open()
    folder, found = settings.out / "scenes", {key: [] for key in MEASURES}
    tasks = list(islice(_tasks(settings, generator.config.video), settings.scenes))
    for task in track(tasks, "generating", total=len(tasks)):
        videos = _videos(task, generator, settings.batch_size, folder)
        for name, judge in (("true", _executed), ("seen", _seen_true), ("frames", _seen)):
            found[name].append(_cached(folder / f"{task.seed}_{name}.json", judge, task, videos))
    _report(settings.out, found, judges=("seen", "frames"))
    _draw(settings.out, tasks[:SHEET_SCENES], generator)
    for task in track(tasks, "perceiving", total=len(tasks)):
        videos = _videos(task, generator, settings.batch_size, folder)
        judge = partial(_perceived, perceive=perceive, fps=generator.config.video.fps)
        found["state"].append(_cached(folder / f"{task.seed}_state.json", judge, task, videos))
    _report(settings.out, found, judges=("seen", "frames", "state"))


def _cached(path: Path, judge: Judge, task: Task, videos: Videos) -> Outcomes:
    """Return the outcome of every policy in one scene, from its file or by a judge."""
    if not path.exists():
        write_json(path, judge(task, videos))
    return read_json(path)


def _tasks(settings: Policies, spec: VideoSpec) -> Iterator[Task]:
    """Yield the scenes with an object to carry to a place on the table."""
    for seed in count(settings.first_scene):
        script = next(make_scripts(seed, spec=spec))
        if script.intent.verb == "carry":
            yield Task.make(seed, script)


def _videos(task: Task, generator: Generator, size: int, folder: Path) -> Videos:
    """Return the generated clip of every policy in one scene, from their file or newly made."""
    path = folder / f"{task.seed}.npz"
    if not path.exists():
        videos = _generate(task, generator, size)
        with atomic_write(path) as temporary:
            np.savez(temporary, frames=np.stack(videos))
    return list(read_arrays(path, {"frames": "uint8"})["frames"])


def _generate(task: Task, generator: Generator, size: int) -> Videos:
    """Generate the clip of every policy from the same noise."""
    first, state = World(scene=task.script.scene).observe(task.script.cameras)
    view = generator.renderer.render(state, task.script.cameras, point_px=generator.point_px)
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


def _executed(task: Task, videos: Videos) -> Outcomes:
    """Return the outcome of every policy in the true world."""
    start, name, outcomes = World(scene=task.script.scene), task.script.intent.name, {}
    for policy, action in zip(POLICIES, task.actions, strict=True):
        _, after = start.move(action)
        outcomes[policy.name] = task.outcome(after.scene.body(name).world_from_body)
    return outcomes


def _seen(task: Task, videos: Videos) -> Outcomes:
    """Return the outcome of every policy by its generated frames."""
    return {
        policy.name: task.outcome_seen(frames[-LAST_FRAMES:], action)
        for policy, action, frames in zip(POLICIES, task.actions, videos, strict=True)
    }


def _seen_true(task: Task, videos: Videos) -> Outcomes:
    """Return the outcome of every policy by its ground-truth frames, which tests the judge."""
    return {
        policy.name: task.outcome_seen(task.last_frames(action), action)
        for policy, action in zip(POLICIES, task.actions, strict=True)
    }


def _perceived(task: Task, videos: Videos, *, perceive: Perception, fps: int) -> Outcomes:
    """Return the outcome of every policy by the state after its generated clip."""
    _, state = World(scene=task.script.scene, seed=task.seed).observe(task.script.cameras)
    outcomes = {}
    for policy, action, frames in zip(POLICIES, task.actions, videos, strict=True):
        after = fuse(state, perceive(Clip(frames=frames, fps=fps), action, state))
        outcomes[policy.name] = task.outcome(_pose_in(after, task.script))
    return outcomes


def _pose_in(state: SceneState, script: Script) -> np.ndarray:
    """Return the pose of the carried object in a state: its initial pose, moved as perceived."""
    name = script.intent.name
    moved = state.world_from_object.get(script.scene.instance_id(name), np.eye(4))
    return moved @ script.scene.body(name).world_from_body


def _report(out: Path, found: Mapping[str, Sequence[Outcomes]], *, judges: Sequence[str]) -> None:
    success = {
        key: np.array([[scene[p.name]["success"] for scene in found[key]] for p in POLICIES])
        for key in ("true", *judges)
    }
    rows = {
        policy.name: {
            key: {"mean": 100 * float(shares[row].mean())} for key, shares in success.items()
        }
        for row, policy in enumerate(POLICIES)
    }
    agreement = {
        judge: rank_correlation.agreement(success[judge], success["true"]) for judge in judges
    }
    scenes = len(found["true"])
    report = {"definitions": DEFINITIONS, "scenes": scenes, "table": rows, "agreement": agreement}
    write_json(out / "report.json", report)
    print_table("policy", rows, MEASURES, title=f"success in {scenes} scenes")
    title = "agreement with true success, with 95 % intervals"
    print_table("success read from", agreement, rank_correlation.MEASURES, title=title)
    _plot(rows, out / "ranking.png", judges)


def _plot(rows: Mapping[str, Summary], path: Path, judges: Sequence[str]) -> None:
    """Plot success in the generated world over true success, with a point per policy."""
    matplotlib.use("agg")
    figure = Figure(figsize=(5.5 * len(judges), 5), layout="constrained")
    panels = figure.subplots(1, len(judges), sharey=True, squeeze=False)[0]
    for axes, judge in zip(panels, judges, strict=True):
        axes.plot([0, 100], [0, 100], color="gray", linewidth=0.8)
        for name, row in rows.items():
            axes.plot(row["true"]["mean"], row[judge]["mean"], "o", label=name)
        axes.set_xlabel(MEASURES["true"][0])
        axes.set_title(f"success {MEASURES[judge][0]}")
        axes.grid(visible=True, alpha=0.3)
    figure.axes[0].legend(fontsize=8)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=100)


def _draw(out: Path, tasks: Sequence[Task], generator: Generator) -> None:
    """Draw the generated and the ground-truth clip of every policy."""
    clips = []
    for task in tasks:
        start = World(scene=task.script.scene, seed=task.seed)
        videos = _videos(task, generator, 1, out / "scenes")
        for policy, action, frames in zip(POLICIES, task.actions, videos, strict=True):
            true, _ = start.execute(action)
            title = f"scene {task.seed}, {policy.name}: generated, true. {action.prompt}"
            clips.append(SheetClip(title, [frames, true.frames]))
    last = generator.config.video.frames - 1
    moments = [round(share * last) for share in (0, 0.25, 0.5, 0.75, 1)]
    draw_sheet(clips, out / "contact_sheet.png", moments=moments)
    print(out / "ranking.png", out / "contact_sheet.png", sep="\n")
