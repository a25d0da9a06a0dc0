"""Agreement of two cameras: clips of one state and prediction, against independent clips.

    python -m tests.benchmarks.bench_views [--config preview] [--scenes 8] [--clips 2]

The camera of the head, with its own loop, is in all rows. The second camera is fixed next to the
table or is on a wrist. Its clips are made

    one state     from the state of the head's camera and the motion predicted in it
    independent   in a separate loop: the state of the camera's first frame with its true depth, a
                  separate prediction, perception and updates; the hands are the true ones
    true world    by the tabletop world, which shows the cost of the resampling

A pixel of one camera is compared with the other camera's image of the same surface, in both
directions: the surface is at the depth that the clip's own view has there. Pixels on hands, behind
what the other camera shows, and where it observed nothing do not count. With `--exact` the surfaces
come from the true world, for all rows. The table has the PSNR over all pixels, and over those on
objects that move. It is the mean over scenes, each the PSNR of all its clips, with the standard
error of the difference from `independent`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from egosim_jax.geometry import invert, pixel_rays, project, transform
from egosim_jax.interactive.env import ActionSpec, load_backend
from egosim_jax.rendering.mesh import Side
from egosim_jax.rendering.skeleton import NEAR_M
from egosim_jax.simulation.actions import all_joints_of, with_all_joints
from egosim_jax.simulation.rig import Mount, MountedCamera, Rig
from egosim_jax.simulation.simulator import Simulator
from egosim_jax.types import Action, Cameras, InputError, SceneState, VideoSpec, seen_hands
from egosim_jax.worlds.tabletop import make_scripts
from egosim_jax.worlds.tabletop.clips import TabletopClip, first_view, provenance
from egosim_jax.worlds.tabletop.scene import FIRST_HAND
from egosim_jax.worlds.tabletop.sequence import Script
from egosim_jax.worlds.tabletop.world import World, sides_of
from tests.painted import SIDE, WRIST

SAME_M = 0.01
"""Maximum difference of true depths at which two pixels show one surface, in meters."""
MOVED_M = 0.01
"""Motion of an object that counts as moved, in meters."""
MADE = ("one state", "independent", "true world")


@dataclass(frozen=True)
class Look:
    """Clip of a camera, with the surface that each of its pixels shows."""

    frames: np.ndarray
    cameras: Cameras
    depth_m: np.ndarray
    """Depth of the surfaces that the clip shows, `f h w`; infinite where nothing was observed."""
    ids: np.ndarray
    """Object of each pixel, `f h w`."""
    hands: np.ndarray
    """Pixels of hands and arms in the true world, and around them, `f h w`."""


def look(clip: Any, view: Any, truth: TabletopClip) -> Look:
    """Return the look of a generated clip, whose surfaces are its view's."""
    hands = (truth.ids >= FIRST_HAND).astype(np.uint8)
    square = np.ones((5, 5), np.uint8)
    near = np.stack([cv2.dilate(frame, square) for frame in hands]) > 0
    ids = view.object_ids if hasattr(view, "object_ids") else view.ids
    return Look(clip.frames, truth.cameras, view.depth_m, ids, near)


def errors(first: Look, second: Look, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the squared differences from the second camera at each pixel of the first.

    Also returns which pixels count: those whose surface is in the second camera's image, not behind
    what it shows, and on no hand.
    """
    height, width = first.depth_m.shape[1:]
    known = np.isfinite(first.depth_m[frame])
    rays = pixel_rays(first.cameras.intrinsics_px, height=height, width=width)
    points = rays * np.where(known, first.depth_m[frame], 1.0)[..., None]
    points = transform(first.cameras.world_from_camera[frame], points.reshape(-1, 3))
    local = transform(invert(second.cameras.world_from_camera[frame]), points)
    ahead = local[:, 2] > NEAR_M
    local[~ahead] = 1.0
    x, y = (
        a.reshape(height, width).astype(np.float32)
        for a in project(second.cameras.intrinsics_px, local)
    )
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    row, column = (
        np.clip(np.rint(a), 0, size - 1).astype(int) for a, size in ((y, height), (x, width))
    )
    there = second.depth_m[frame][row, column]
    seen = np.isfinite(there) & (local[:, 2].reshape(height, width) < there + SAME_M)
    hands = first.hands[frame] | second.hands[frame][row, column]
    shown = cv2.remap(second.frames[frame].astype(np.float32), x, y, cv2.INTER_LINEAR)
    error = np.square(shown - first.frames[frame]).mean(axis=-1)
    return error, known & ahead.reshape(height, width) & inside & seen & ~hands


def totals(head: Look, other: Look, moved: Sequence[int]) -> np.ndarray:
    """Return sum and count of the errors in both directions, of all pixels and moved objects."""
    sums = np.zeros((2, 2))
    for first, second in ((head, other), (other, head)):
        for frame in range(len(first.frames)):
            error, counts = errors(first, second, frame)
            regions = counts, counts & np.isin(first.ids[frame], moved)
            for number, region in enumerate(regions):
                sums[number] += error[region].sum(), region.sum()
    return sums


def seen_by(action: Action, cameras: Any) -> Action:
    """Return the action as another camera sees it."""
    joints = all_joints_of(action)
    seen = seen_hands(cameras, joints)
    alone = Action(cameras=cameras, joints_m=seen, kind=action.kind, prompt=action.prompt)
    return with_all_joints(alone, joints) if np.isfinite(joints).all() else alone


def actions_of(scripts: Sequence[Script]) -> list[Action]:
    """Return the actions of scripts, with the joints of all hands."""
    return [
        seen_by(
            Action(cameras=s.cameras, joints_m=s.joints_m, kind="human", prompt=s.caption),
            s.cameras,
        )
        for s in scripts
    ]


def rig_of(mount: str, action: Action) -> Rig:
    """Return a rig of the second camera."""
    sides = sides_of(all_joints_of(action), "human")
    hand = int(np.ptp(all_joints_of(action)[:, :, 0], axis=0).max(axis=-1).argmax())
    on_wrist: dict[Side, Mount] = {"left": "left_wrist", "right": "right_wrist"}
    camera = MountedCamera(name="other", mount="world", pose=SIDE)
    if mount == "wrist":
        place = on_wrist[sides[hand]]
        camera = MountedCamera(name="other", mount=place, pose=WRIST, field_of_view_deg=90)
    return Rig(cameras=(camera,), sides=sides)


def loop(
    simulator: Simulator, state: SceneState, actions: Sequence[Action], seed: int
) -> Iterator[Any]:
    """Yield the steps of a loop."""
    for number, action in enumerate(actions, start=1):
        step = simulator.step(state, action, seed=seed + number)
        yield step
        state = step.state


def measure(
    simulator: Simulator, seed: int, mount: str, spec: VideoSpec, clips: int, exact: bool
) -> np.ndarray:
    """Return the PSNR of each way (`MADE`), over all pixels and over objects that move."""
    scripts = list(make_scripts(seed, spec=spec, clips=clips))
    actions = actions_of(scripts)
    rig = rig_of(mount, actions[0])
    others = [seen_by(a, rig.actions(a)["other"].cameras) for a in actions]
    world, truths = World(scene=scripts[0].scene, seed=seed), []
    for action, other in zip(actions, others, strict=True):
        joints = all_joints_of(action)
        clip, after = world.execute(action, joints_m=joints)
        truths.append((clip, world.execute(other, joints_m=joints)[0]))
        world = after
    state, own = (
        replace(first_view(scripts[0].scene, first.cameras)[1], provenance=provenance(seed))
        for first in (actions[0], others[0])
    )
    shared = loop(replace(simulator, rig=rig), state, actions, seed)
    alone = loop(simulator, own, others, seed)
    sums, before = np.zeros((len(MADE), 2, 2)), state
    for number, ((true, true_other), step, single) in enumerate(
        zip(truths, shared, alone, strict=True)
    ):
        motion = simulator.predict(before, actions[number])
        view = simulator.render(before, others[number], motion)
        head = look(step.clip, true if exact else step.view, true)
        ways = [
            (head, look(step.others["other"].clip, true_other if exact else view, true_other)),
            (head, look(single.clip, true_other if exact else single.view, true_other)),
            (look(true, true, true), look(true_other, true_other, true_other)),
        ]
        sums += [totals(*way, moved_in(true)) for way in ways]
        before = step.state
    with np.errstate(invalid="ignore"):
        return 10 * np.log10(255**2 / (sums[..., 0] / sums[..., 1]))


def moved_in(clip: TabletopClip) -> list[int]:
    """Return the ids of the objects that move in a clip."""
    return [
        clip.body_ids[name]
        for name, path in clip.world_from_body.items()
        if np.linalg.norm(path[:, :3, 3] - path[0, :3, 3], axis=1).max() > MOVED_M
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--config", default="preview")
    parser.add_argument("--scenes", type=int, default=8)
    parser.add_argument("--first", type=int, default=40_000)
    parser.add_argument("--clips", type=int, default=2)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--mounts", nargs="+", default=["world", "wrist"])
    parser.add_argument("--exact", action="store_true", help="surfaces of the true world")
    args = parser.parse_args()
    backend = load_backend(config=args.config, steps=args.steps, compile=False, batch=2)
    simulator = backend.simulator(backend.start(args.first, ActionSpec()))
    for mount in args.mounts:
        rows, seed = [], args.first
        while len(rows) < args.scenes:
            try:
                rows.append(measure(simulator, seed, mount, backend.video, args.clips, args.exact))
                print(mount, seed, rows[-1].round(2).tolist(), flush=True)
            except InputError as error:  # such as a camera inside an object
                print(mount, seed, "skipped:", error, flush=True)
            seed += 1
        report(mount, np.array(rows))


def report(mount: str, values: np.ndarray) -> None:
    """Print the means over scenes, and the differences from independent clips."""
    print(f"\n| second camera: {mount} | all pixels | difference | moved objects | difference |")
    print("|---|---|---|---|---|")
    for way, name in enumerate(MADE):
        cells = [name]
        for region in (0, 1):
            numbers = values[:, way, region]
            change = numbers - values[:, 1, region]
            change = change[np.isfinite(change)]
            error = change.std(ddof=1) / np.sqrt(len(change)) if len(change) > 1 else np.nan
            cells += [f"{np.nanmean(numbers):.1f} dB", f"{change.mean():+.1f} ± {error:.1f}"]
        print("| " + " | ".join(cells) + " |")
    print(flush=True)


if __name__ == "__main__":
    main()
