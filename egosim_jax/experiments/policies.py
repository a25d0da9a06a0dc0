"""`egosim experiment policies`: rank policies in the generated world and in the true world."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from egosim_jax.data.sheet import SheetClip, draw_sheet
from egosim_jax.evaluation.metrics import rank_correlation, region
from egosim_jax.evaluation.metrics.rates import rate
from egosim_jax.evaluation.metrics.report import print_table
from egosim_jax.experiments.config import Policies
from egosim_jax.experiments.report import Table, cached, plot, write_report
from egosim_jax.experiments.scenes import carrying
from egosim_jax.generation.encoding import batches
from egosim_jax.generation.generator import Generator
from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.untrusted.npz import read_arrays
from egosim_jax.perception import Perception, registry
from egosim_jax.runtime.progress import track
from egosim_jax.runtime.terminal import print_line
from egosim_jax.state.fuse import fuse
from egosim_jax.types import Action, Cameras, Clip, Triplet
from egosim_jax.worlds.tabletop import Scene, Script, World
from egosim_jax.worlds.tabletop.clips import Arm, paints_of, place, render_scenes
from egosim_jax.worlds.tabletop.policies import MAX_ERROR_M, POLICIES, goal_error_m, succeeded
from egosim_jax.worlds.tabletop.raycast import Frame
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
Outcome = dict[str, float]
"""Success, and error in meters, of a policy in one scene."""
Judge = Callable[["Task", Action, np.ndarray], Outcome]
"""Function that measures the outcome of an action, with its generated frames."""
DEFINITIONS = {
    "low, high of success": "95 % interval of Clopper and Pearson",
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

    def outcome(self, world_from_body: np.ndarray) -> Outcome:
        """Return success, and the distance in meters to the goal, of the object at a pose."""
        moved = self._with(world_from_body).body(self.script.intent.name)
        error = goal_error_m(moved, np.asarray(self.script.intent.goal_m))
        return {"success": float(succeeded(error)), "error_m": error[0]}

    def executed(self, action: Action, _frames: np.ndarray) -> Outcome:
        """Return the outcome of an action in the true world."""
        _, after = World(scene=self.script.scene).move(action)
        return self.outcome(after.scene.body(self.script.intent.name).world_from_body)

    def seen(self, action: Action, frames: UInt8[np.ndarray, "f h w 3"]) -> Outcome:
        """Return the outcome by the object in the last frames.

        The distance is missing if the hand hides the object's goal position in all frames.
        """
        script, name, pose = self.script, self.script.intent.name, np.eye(4)
        number = script.scene.instance_id(name)
        pose[:3, :3] = script.scene.body(name).world_from_body[:3, :3]
        pose[:3, 3] = np.asarray(script.intent.goal_m)
        there = self._render([self._with(pose)] * LAST_FRAMES, action)
        goal = np.stack([frame.ids == number for frame in there])
        bare = render_scenes([script.scene] * LAST_FRAMES, self._cameras, without=name)
        background = np.stack([frame.colors for frame in bare])
        paints = paints_of(place(script.scene, self._arms(action)[-1]))
        silhouettes = region.find(number, frames[-LAST_FRAMES:], background, paints)
        errors = region.centroid_errors(silhouettes, goal)
        if not len(errors):
            return {"success": 0.0}
        depth = np.median(np.stack([frame.depth_m for frame in there])[goal])
        error = float(np.median(errors) * depth / self._cameras.intrinsics_px[0, 0])
        return {"success": float(error <= MAX_ERROR_M[0]), "error_m": error}

    def seen_true(self, action: Action, _frames: np.ndarray) -> Outcome:
        """Return the outcome by the last ground-truth frames, which tests the judge."""
        scenes, _ = World(scene=self.script.scene).move(action)
        rendered = self._render(scenes[-LAST_FRAMES:], action)
        return self.seen(action, np.stack([frame.colors for frame in rendered]))

    def perceived(
        self, action: Action, frames: np.ndarray, *, perceive: Perception, fps: int
    ) -> Outcome:
        """Return the outcome by the state after the clip: the initial pose, moved as perceived."""
        _, state = World(scene=self.script.scene, seed=self.seed).observe(self.script.cameras)
        after = fuse(state, perceive(Clip(frames=frames, fps=fps), action, state))
        name, scene = self.script.intent.name, self.script.scene
        moved = after.world_from_object.get(scene.instance_id(name), np.eye(4))
        return self.outcome(moved @ scene.body(name).world_from_body)

    @property
    def _cameras(self) -> Cameras:
        """Cameras of the last frames."""
        cameras = self.script.cameras
        return replace(cameras, world_from_camera=cameras.world_from_camera[-LAST_FRAMES:])

    def _arms(self, action: Action) -> list[list[Arm | None]]:
        """Return joints and meshes of the hands in the last frames."""
        return arms_of(action.joints_m[-LAST_FRAMES:], action.kind)

    def _render(self, scenes: Sequence[Scene], action: Action) -> list[Frame]:
        return render_scenes(scenes, self._cameras, arms=self._arms(action))

    def _with(self, world_from_body: np.ndarray) -> Scene:
        return self.script.scene.with_pose(self.script.intent.name, world_from_body)


def run(settings: Policies) -> None:
    """Execute and generate every policy in every scene; rank, compare and draw.

    A first report has success by frames; the final report adds success by states, which needs slow
    perception of every clip.
    """
    settings.check()
    perceive = registry.parse(settings.perception).build()
    generator = settings.open()
    folder, video = settings.out / "scenes", generator.config.video
    scenes = islice(carrying(settings.first_scene, video), settings.scenes)
    tasks = [Task.make(seed, script) for seed, script in scenes]
    in_state = partial(Task.perceived, perceive=perceive, fps=video.fps)
    by_frames = {"true": Task.executed, "seen": Task.seen_true, "frames": Task.seen}
    outcomes: dict[str, list[dict[str, Outcome]]] = {}
    for verb, judges in (("generating", by_frames), ("perceiving", {"state": in_state})):
        for task in track(tasks, verb, total=len(tasks)):
            videos = _videos(task, generator, settings.batch_size, folder)
            for name, judge in judges.items():
                path = folder / f"{task.seed}_{name}.json"
                outcome = cached(path, partial(_judge, task, judge, videos))
                outcomes.setdefault(name, []).append(outcome)
        _report(settings.out, outcomes)
        if verb == "generating":
            _draw(settings.out, tasks[:SHEET_SCENES], generator)


def _judge(task: Task, judge: Judge, videos: Videos) -> dict[str, Outcome]:
    """Return the outcome of every policy in one scene, by name."""
    return {
        policy.name: judge(task, action, frames)
        for policy, action, frames in zip(POLICIES, task.actions, videos, strict=True)
    }


def _videos(task: Task, generator: Generator, size: int, folder: Path) -> Videos:
    """Return the generated clip of every policy in one scene, from their file or newly made."""
    path = folder / f"{task.seed}.npz"
    if not path.exists():
        frames = np.stack(list(_generate(task, generator, size)))
        with atomic_write(path) as temporary:
            np.savez(temporary, frames=frames)
    return list(read_arrays(path, {"frames": "uint8"})["frames"])


def _generate(task: Task, generator: Generator, size: int) -> Iterator[np.ndarray]:
    """Generate the clip of every policy from the same noise."""
    renderer, cameras = generator.renderer, task.script.cameras
    first, state = World(scene=task.script.scene).observe(cameras)
    view = renderer.render(state, cameras, point_px=generator.point_px)
    triplets = [
        Triplet(
            video_id=f"{task.seed} {policy.name}",
            prompt=action.prompt,
            prior=view.frames,
            mask=view.mask,
            hands=renderer.draw_hands(action.joints_m, action.cameras, kind=action.kind)[0],
            first_frame=first.colors,
        )
        for policy, action in zip(POLICIES, task.actions, strict=True)
    ]
    for batch in batches(triplets, size):
        yield from (clip.frames for clip in generator.generate(batch, [task.seed] * len(batch)))


def _report(out: Path, outcomes: Mapping[str, Sequence[Mapping[str, Outcome]]]) -> None:
    success = {
        key: np.array([[scene[p.name]["success"] for scene in scenes] for p in POLICIES])
        for key, scenes in outcomes.items()
    }
    true, judges = success["true"], [key for key in success if key != "true"]
    rows: Table = {
        policy.name: {
            key: rate(int(shares[row].sum()), shares.shape[1]) for key, shares in success.items()
        }
        for row, policy in enumerate(POLICIES)
    }
    agreement = {judge: rank_correlation.agreement(success[judge], true) for judge in judges}
    scenes = true.shape[1]
    write_report(out, definitions=DEFINITIONS, scenes=scenes, table=rows, agreement=agreement)
    print_table("policy", rows, MEASURES, title=f"success in {scenes} scenes")
    title = "agreement with true success, with 95 % intervals"
    print_table("success read from", agreement, rank_correlation.MEASURES, title=title)
    with plot(out / "ranking.png", 5.5 * len(judges), 5) as figure:
        panels = figure.subplots(1, len(judges), sharey=True, squeeze=False)[0]
        for axes, judge in zip(panels, judges, strict=True):
            axes.plot([0, 100], [0, 100], color="gray", linewidth=0.8)
            for name, row in rows.items():
                axes.plot(row["true"]["mean"], row[judge]["mean"], "o", label=name)
            axes.set_xlabel(MEASURES["true"][0])
            axes.set_title(f"success {MEASURES[judge][0]}")
            axes.grid(visible=True, alpha=0.3)
        figure.axes[0].legend(fontsize=8)


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
    print_line(out / "ranking.png")
    print_line(out / "contact_sheet.png")
