"""`egosim experiment look_away`: is a change still there after looking elsewhere?

Each scene has three clips. Seen: a hand carries an object, the wearer turns away, and turns back.
Unseen: the wearer turns away, a hand carries the object out of view, the wearer turns back. The
model and perception get no hand that is out of view; only the true world executes its motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8

from egosim_jax.data.sheet import SheetClip, draw_sheet
from egosim_jax.evaluation.metrics import region
from egosim_jax.evaluation.metrics.rates import rate
from egosim_jax.evaluation.metrics.state_update import ON_SURFACE_M, distance_to_mesh
from egosim_jax.experiments.config import LookAway
from egosim_jax.experiments.continuous import METHODS, NOT_UPDATED, folder_name
from egosim_jax.experiments.report import differences, show, summaries, write_report
from egosim_jax.experiments.scenes import carrying
from egosim_jax.experiments.wrbench import Record, write_manifest
from egosim_jax.generation.generator import Generator
from egosim_jax.geometry import invert, transform
from egosim_jax.perception import registry
from egosim_jax.runtime.progress import track
from egosim_jax.runtime.terminal import print_line
from egosim_jax.simulation.rollout import Rollout, load_clip
from egosim_jax.simulation.simulator import Simulator
from egosim_jax.state.fuse import fuse
from egosim_jax.types import Action, Clip, SceneState, VideoSpec
from egosim_jax.worlds.tabletop import (
    Script,
    TabletopClip,
    World,
    make_scripts,
    to_action,
    to_episode,
)
from egosim_jax.worlds.tabletop.attempts import LOOK_AROUND_PROMPT, turn_camera
from egosim_jax.worlds.tabletop.clips import render_scenes

CASES = ("seen", "unseen")
"""The object moves in view, or while the wearer looks elsewhere."""
AWAY_DEGREES = 50.0
"""Angle in degrees of the wearer's turn away from the object."""
OUTSIDE_DEGREES = 35.0
"""Minimum horizontal angle between the optical axis and an object out of view."""
FRAMES_BACK = 4
"""Number of scored frames at the end of the last clip."""
NEAR_PERCENT = 5.0
"""Maximum image distance of a kept object from its true position, in percent of the width."""
TRUE = "ground truth, classical"
"""Row of the ground-truth frames, and of the state by classical perception of them."""
SHEET_SCENES = 3
"""Number of scenes of each case on the contact sheet."""
MEASURES = {
    "kept": ("object where it was left %", "{:.0f}"),
    "region_psnr": ("region PSNR dB", "{:.2f}"),
    "object_error": ("object error %", "{:.1f}"),
    "state_accuracy": ("state accuracy %", "{:.0f}"),
}
CASES_KEY = "seen, unseen"
DEFINITIONS = {
    "kept": f"100 if the object is within {NEAR_PERCENT:g} % of the image's width of its true "
    f"place in the last {FRAMES_BACK} frames, after looking back, else 0; in the table, the share "
    "of scenes with the 95 % interval of Clopper and Pearson",
    "object_error": "distance between the object's centroid, segmented by color among the colors "
    "of all bodies, and the centroid of its ground-truth ids, in percent of the width, median over "
    "the same frames",
    "region_psnr": "dB over the pixels of these frames where the object is or was before the move",
    "state_accuracy": "share of the object's points in the last state within 1 cm of its true "
    "surface; 0 without points",
    CASES_KEY: "the object is carried in view, or while the wearer looks elsewhere",
    "ground truth": "frames of the true world, which test the detection of the object, and the "
    "state by classical perception of them",
    "differences": "from no update, on the same scenes; mean and Student's 95 % interval",
}


@dataclass(frozen=True, kw_only=True)
class Story:
    """Three clips of one scene with their ground truth, and the reference of the last clip."""

    seed: int
    """Seed of the scene."""
    clips: tuple[TabletopClip, ...]
    """Clips with their ground truth."""
    target: str
    """Name of the carried object."""
    before: Bool[np.ndarray, "f h w"]
    """Pixels of the last frames that show the object at its initial position."""
    background: UInt8[np.ndarray, "f h w 3"]
    """Last frames without hands and without the object."""
    degrees: float
    """Turn of the head, positive to the left."""
    caption: str
    """Action of the hand, in words."""

    def record(self, case: str, method: str, videos: Sequence[np.ndarray], fps: int) -> Record:
        """Return the record of a video of each clip, for WRBench."""
        cameras = [to_action(clip).cameras for clip in self.clips]
        poses = [camera.world_from_camera for camera in cameras]
        family = f"tabletop_{self.seed}"
        return Record(
            name=f"{family}_{case}_{folder_name(method)}",
            frames=_joined(videos),
            fps=fps,
            world_from_camera=_joined(poses),
            intrinsics_px=cameras[0].intrinsics_px,
            degrees=self.degrees,
            about={
                "model": method,
                "family_id": family,
                "variant_id": f"{family}__{case}",
                "prompt_id": f"{family}__{case}",
                "event_delta": "spatial",
                "scenario_type": case,
                "world_state_prompt": self.caption,
                "expected_state": f"After looking back, the {self.target} is where it was put.",
                "expected_behavior": DEFINITIONS[CASES_KEY],
            },
        )

    def score(self, frames: UInt8[np.ndarray, "f h w 3"]) -> dict[str, float]:
        """Return every measure of a video of the last clip."""
        clip, last = self.clips[-1], slice(-FRAMES_BACK, None)
        number = clip.body_ids[self.target]
        here = clip.ids[last] == number
        silhouettes = region.find(number, frames[last], self.background, clip.paints)
        errors = region.centroid_errors(silhouettes, here)
        error = 100 * float(np.median(errors)) / frames.shape[2] if len(errors) else np.nan
        return {
            "kept": 100.0 * (error <= NEAR_PERCENT),
            "region_psnr": region.region_psnr(frames[last], clip.frames[last], here | self.before),
            "object_error": error,
        }

    def score_state(self, state: SceneState) -> dict[str, float]:
        """Return the accuracy of the object in the last state."""
        clip = self.clips[-1]
        body, number = clip.parts[self.target], clip.body_ids[self.target]
        surface = transform(clip.world_from_body[self.target][-1], body.vertices_m), body.triangles
        points = state.points_m[state.object_ids == number]
        near = distance_to_mesh(points, surface) <= ON_SURFACE_M if len(points) else np.zeros(1)
        return {"state_accuracy": 100 * float(near.mean())}


def run(settings: LookAway) -> None:
    """Simulate every story by each method and compare the last frames."""
    generator, out = settings.open(), settings.out
    spec = generator.config.video
    scripts = carrying(settings.first_scene, spec)
    outside = (seed for seed, script in scripts if _turn_away(script) is not None)
    seeds = list(islice(outside, settings.scenes))
    jobs = [(case, seed) for case in CASES for seed in seeds]
    scores: dict[str, list[dict[str, float]]] = {}
    records = []
    for case, seed in track(jobs, "scenes", total=len(jobs)):
        story = make_story(seed, spec, case)
        videos = {TRUE: [clip.frames for clip in story.clips]}
        true = story.score(story.clips[-1].frames) | _perceive_true(story, spec)
        scores.setdefault(f"{case}: {TRUE}", []).append(true)
        for method in METHODS:
            folder = _folder(out, case, method, seed)
            simulated = _simulate(story, generator, method, folder)
            scores.setdefault(f"{case}: {method}", []).append(simulated)
            videos[method] = _clips(folder, spec)
        for method, clips in videos.items():
            record = story.record(case, method, clips, spec.fps)
            records.append(record.write(out / "wrbench"))
    write_manifest(out / "wrbench", records)
    table, gaps = summaries(scores, MEASURES), {}
    for name, values in scores.items():
        table[name]["kept"] = rate(sum(value["kept"] > 0 for value in values), len(values))
    for case in CASES:
        by_method = {f"{case}: {method}": scores[f"{case}: {method}"] for method in METHODS}
        gaps |= differences(by_method, f"{case}: {NOT_UPDATED}", MEASURES)
    write_report(
        out,
        definitions=DEFINITIONS,
        seeds=seeds,
        table=table,
        scores=scores,
        differences=gaps,
    )
    show("after looking back: mean ± spread over scenes, kept [95 %]", table, MEASURES)
    show("difference from no update, with its 95 % interval", gaps, MEASURES)
    _draw(out, seeds[:SHEET_SCENES], spec)
    print_line(out / "wrbench" / "videos.json")


def _folder(out: Path, case: str, method: str, seed: int) -> Path:
    """Return the folder of a simulation."""
    return out / case / folder_name(method) / str(seed)


def _simulate(story: Story, generator: Generator, method: str, folder: Path) -> dict[str, float]:
    """Return the scores of one story, simulated in its folder."""
    episode, name = to_episode(story.clips, fps=generator.config.video.fps), METHODS[method]
    simulator = Simulator(
        generator=generator,
        perception=registry.parse(name).build(episode.observations()) if name else None,
        fps=episode.fps,
    )
    steps = Rollout(simulator, folder).run(
        episode.state, episode.actions, seed=story.seed, first_frame=episode.first_frame
    )
    *_, last = steps
    return story.score(last.clip.frames) | story.score_state(last.state)


def _clips(folder: Path, spec: VideoSpec) -> list[np.ndarray]:
    """Return the frames of each clip of a simulation."""
    paths = [folder / f"clip_{number}" / "frames.npz" for number in (1, 2, 3)]
    return [load_clip(path, spec.fps).frames for path in paths]


def _joined(clips: Sequence[np.ndarray]) -> np.ndarray:
    """Return clips one after the other; the first frame of each is the last one before it."""
    return np.concatenate([clips[0], *(clip[1:] for clip in clips[1:])])


def _perceive_true(story: Story, spec: VideoSpec) -> dict[str, float]:
    """Return the accuracy of the state by classical perception of the ground truth."""
    perceive, state = registry.parse("classical").build(), story.clips[0].state
    for clip in story.clips:
        seen = Clip(frames=clip.frames, fps=spec.fps)
        state = fuse(state, perceive(seen, to_action(clip), state))
    return story.score_state(state)


def _turn_away(script: Script) -> float | None:
    """Return the turn in radians that takes the object out of view, or None."""
    places = np.stack(
        [moment.scene.body(script.intent.name).world_from_body[:3, 3] for moment in script.moments]
    )
    for sign in (1.0, -1.0):
        turned = turn_camera(script.cameras, 0.0, sign * np.radians(AWAY_DEGREES), len(places))
        local = transform(invert(turned.world_from_camera[-1]), places)
        angles = np.degrees(np.arctan2(np.abs(local[:, 0]), local[:, 2]))
        if angles.min() > OUTSIDE_DEGREES:
            return sign * np.radians(AWAY_DEGREES)
    return None


def make_story(seed: int, spec: VideoSpec, case: str) -> Story:
    """Return the clips of a scene, with the object carried in view (`seen`) or out of view."""
    script = next(make_scripts(seed, spec=spec))
    angle, frames = _turn_away(script), spec.frames
    if angle is None:
        raise ValueError(f"the object of scene {seed} cannot be out of view")
    joints, prompt = script.action.joints_m[:, :1], script.caption
    missing = np.full_like(joints, np.nan)
    if case == "seen":
        poses = script.cameras.world_from_camera[-1:]
        view, hands = replace(script.cameras, world_from_camera=poses), [joints, missing, missing]
        cameras = [
            script.cameras,
            turn_camera(view, 0.0, angle, frames),
            turn_camera(view, angle, 0.0, frames),
        ]
        prompts = [prompt, LOOK_AROUND_PROMPT, LOOK_AROUND_PROMPT]
    else:
        view, hands = script.cameras, [missing, joints, missing]
        ends = ((0.0, angle), (angle, angle), (angle, 0.0))
        cameras = [turn_camera(view, first, last, frames) for first, last in ends]
        prompts = [LOOK_AROUND_PROMPT] * 3
    world, clips = World(scene=script.scene, seed=seed), []
    for path, joint, text in zip(cameras, hands, prompts, strict=True):
        action = Action(cameras=path, joints_m=missing, kind=script.kind, prompt=text)
        clip, world = world.execute(action, joints_m=joint)
        clips.append(clip)
    target, last = script.intent.name, cameras[-1]
    back = replace(last, world_from_camera=last.world_from_camera[-FRAMES_BACK:])
    number = script.scene.instance_id(target)
    return Story(
        seed=seed,
        clips=tuple(clips),
        target=target,
        before=np.stack(
            [frame.ids == number for frame in render_scenes([script.scene] * FRAMES_BACK, back)]
        ),
        background=np.stack(
            [p.colors for p in render_scenes([world.scene] * FRAMES_BACK, back, without=target)]
        ),
        degrees=float(np.degrees(angle)),
        caption=prompt,
    )


def _draw(out: Path, seeds: list[int], spec: VideoSpec) -> None:
    """Draw the last clip of some scenes: ground truth and each method."""
    shown = []
    for case in CASES:
        for seed in seeds:
            story = make_story(seed, spec, case)
            videos = {"ground truth, first clip": story.clips[0].frames}
            videos["ground truth"] = story.clips[-1].frames
            for method in METHODS:
                videos[method] = _clips(_folder(out, case, method, seed), spec)[-1]
            title = f"{case}, scene {seed}, last clip: {', '.join(videos)}"
            shown.append(SheetClip(title, list(videos.values())))
    moments = [0, spec.frames // 4, spec.frames // 2, 3 * spec.frames // 4, spec.frames - 1]
    draw_sheet(shown, out / "contact_sheet.png", moments=moments)
    print_line(out / "contact_sheet.png")
