"""Predicted against true motion, from hands and points alone.

    python -m tests.benchmarks.bench_predict [--scenes 100] [--first 40000] [--noise-mm 3]

draws scenes of each kind from the tabletop world, in which an object moves by at least 1 cm (in
failed grasps: in which none moves). It prints the median and the 95th percentile of the distances
of the moved objects' points from their true places, in all frames after the motion begins; the
scenes whose moved object is predicted to move by less than 30 % of the way; the scenes in which an
object moves that rests; and the processor time of a prediction. With noise, 10 % of the frames have
no hand.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from egosim_jax.dynamics import predict
from egosim_jax.geometry import invert, transform
from egosim_jax.types import Action, InputError, Kind, SceneState, VideoSpec, seen_hands
from egosim_jax.worlds.tabletop import encounters, make_scripts
from egosim_jax.worlds.tabletop.clips import first_view, provenance
from egosim_jax.worlds.tabletop.encounters import Encounter, Start
from egosim_jax.worlds.tabletop.policies import POLICIES
from egosim_jax.worlds.tabletop.scene import Scene
from egosim_jax.worlds.tabletop.sequence import Script
from egosim_jax.worlds.tabletop.world import World

SPEC = VideoSpec(frames=17, height=96, width=160, fps=8)
SCRIPTED = {"carry": "carry", "lift": "lift", "stack": "stack", "turn": "turn"}
DRAWN = {
    "push": encounters.push,
    "two hands": encounters.two_hands,
    "rider": encounters.rider,
    "taken off": encounters.take_off,
    "double speed": encounters.fast,
}
MOVED_M, RESTED_M, MISSED = 0.01, 0.002, 0.3
"""Motion of an object that counts, that rests, and share of a motion below which it is missed."""
VARIANTS = 12
"""Scripts of a scene that are searched for a verb."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """A state, an action and the true motion of each object since the first frame."""

    state: SceneState
    action: Action
    truth: dict[int, np.ndarray]

    @property
    def moved_m(self) -> float:
        """Largest motion of an object's points."""
        return max(moved_m(self, number, self.truth[number]).max() for number in ids(self.state))


def ids(state: SceneState) -> list[int]:
    """Return the ids of a state's objects."""
    return np.unique(state.object_ids[state.object_ids > 0]).tolist()


def points_of(case: Case, number: int) -> np.ndarray:
    """Return some points of an object."""
    return case.state.points_m[case.state.object_ids == number][::5].astype(float)


def moved_m(case: Case, number: int, path: np.ndarray) -> np.ndarray:
    """Return how far a path moves an object's farthest point, in each frame."""
    points = points_of(case, number)
    return np.linalg.norm(transform(path, points) - points, axis=-1).max(axis=1)


def case_of(scenes: list[Scene], script: Script, joints: np.ndarray, seed: int) -> Case | None:
    """Return the case of some scenes; None if a hand is never in view."""
    _, state = first_view(scenes[0], script.cameras)
    try:
        action = Action(
            cameras=script.cameras,
            joints_m=seen_hands(script.cameras, joints),
            kind=script.kind,
            prompt=script.caption,
        )
    except InputError:
        return None
    paths = {
        scenes[0].instance_id(body.name): np.stack([s.first_part_pose(body.name) for s in scenes])
        for body in scenes[0].bodies
    }
    rest = np.repeat(np.eye(4)[None], len(scenes), axis=0)
    truth = {number: rest for number in ids(state)}
    truth |= {number: path @ invert(path[0]) for number, path in paths.items()}
    return Case(state=replace(state, provenance=provenance(seed)), action=action, truth=truth)


def make_case(kind: str, seed: int) -> Case | None:
    """Return a case of a kind; None if the seed's scene has none."""
    hands: Kind = "robot" if seed % 4 == 0 and kind != "two hands" else "human"
    variants = [
        next(make_scripts(seed, spec=SPEC, kind=hands, variant=variant))
        for variant in range(1 if kind in DRAWN else VARIANTS)
    ]
    if kind in DRAWN:
        (script,) = variants
        start = Start(
            scene=script.scene,
            hands=(),
            kind=hands,
            frames=SPEC.frames,
            rng=np.random.default_rng([seed, 9]),
        )
        encounter: Encounter | None = DRAWN[kind](start)
        if encounter is None:
            return None
        joints = np.stack(
            [[hand.grip.pose(hands, hand.side)[0] for hand in path] for path in encounter.hands], 1
        )
        return executed(encounter.scene, script, joints, seed)
    if kind == "failed grasp":
        carries = [script for script in variants if script.intent.verb == "carry"]
        faulty = [p for p in POLICIES if not p.grasps or p.grasp_m > 0.015]
        rng = np.random.default_rng([seed, 9])
        if not carries:
            return None
        policy = faulty[int(rng.integers(len(faulty)))]
        return executed(carries[0].scene, carries[0], policy.plan(carries[0], rng), seed)
    found = [script for script in variants if is_kind(kind, script)]
    if not found:
        return None
    scenes = [moment.scene for moment in found[0].moments]
    return case_of(scenes, found[0], found[0].joints_m, seed)


def is_kind(kind: str, script: Script) -> bool:
    """Return True if a script is of a kind."""
    shape = script.scene.body(script.intent.name).shape
    if kind == "drawer":
        return shape == "drawer" and script.intent.verb in ("open", "close")
    return SCRIPTED[kind] == script.intent.verb


def executed(scene: Scene, script: Script, joints: np.ndarray, seed: int) -> Case | None:
    """Return the case of joints that the true world executes."""
    scenes, _ = World(scene=scene, seed=seed).move(script.action, joints_m=joints)
    return case_of(scenes, script, joints, seed)


def cases_of(kind: str, first: int, count: int) -> Iterator[Case]:
    """Yield the first cases of a kind from a seed on."""
    made, seed = 0, first
    while made < count and seed < first + 60 * count:
        case = make_case(kind, seed)
        seed += 1
        if case is not None and (case.moved_m < 1e-4 if fails(kind) else case.moved_m > MOVED_M):
            made += 1
            yield case


def fails(kind: str) -> bool:
    """Return True for a kind in which nothing moves."""
    return kind == "failed grasp"


def noisy(action: Action, sigma_m: float, seed: int) -> Action:
    """Return an action with jitter of its joints, and without hands in 10 % of the frames."""
    rng = np.random.default_rng(seed)
    joints = action.joints_m + rng.normal(0, sigma_m, action.joints_m.shape)
    joints[rng.random(len(joints)) < 0.1] = np.nan
    return replace(action, joints_m=joints)


def judge(case: Case, action: Action) -> dict[str, Any]:
    """Return the errors of a prediction in meters, and whether it misses or invents a motion."""
    then = time.process_time()
    motion = predict(case.state, action, fps=SPEC.fps)
    cost_s = time.process_time() - then
    errors, missed, invented = [], False, False
    for number in ids(case.state):
        points, true = points_of(case, number), case.truth[number]
        rest = np.repeat(np.eye(4)[None], len(true), axis=0)
        path = motion.paths[number].motion if number in motion.paths else rest
        gone, predicted = (moved_m(case, number, p).max() for p in (true, path))
        if gone > RESTED_M:
            start = int((moved_m(case, number, true) > 1e-4).argmax())
            gaps = np.linalg.norm(transform(true, points) - transform(path, points), axis=-1)
            errors.append(gaps.mean(axis=1)[start:])
            missed |= bool(gone > 2 * MOVED_M and predicted < MISSED * gone)
        else:
            invented |= bool(predicted > RESTED_M)
    return {"errors": errors, "missed": missed, "invented": invented, "cost_s": cost_s}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.bench_predict")
    parser.add_argument("--scenes", type=int, default=100)
    parser.add_argument("--first", type=int, default=40_000)
    parser.add_argument("--noise-mm", type=float, default=0.0)
    parser.add_argument("--kinds", nargs="*")
    options = parser.parse_args()
    kinds = options.kinds or [*SCRIPTED, "drawer", *DRAWN, "failed grasp"]
    print(f"{'':14} scenes  median mm  95 % mm  missed  moved at rest  ms")
    for kind in kinds:
        results = []
        for number, case in enumerate(cases_of(kind, options.first, options.scenes)):
            action = case.action
            if options.noise_mm:
                action = noisy(action, options.noise_mm / 1000, number)
            results.append(judge(case, action))
        errors = [1000 * e for result in results for e in result["errors"]]
        middle, high = np.percentile(np.concatenate(errors), [50, 95]) if errors else (0.0, 0.0)
        missed, invented = (sum(r[name] for r in results) for name in ("missed", "invented"))
        cost = 1000 * np.median([result["cost_s"] for result in results])
        print(
            f"{kind:14} {len(results):6} {middle:10.1f} {high:8.1f} {missed:7} {invented:14} "
            f"{cost:4.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
