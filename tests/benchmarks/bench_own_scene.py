"""24 scenes of MuJoCo, given as RGB-D without ids: are their objects where the gripper put them?

    python -m tests.benchmarks.bench_own_scene [--scenes 24] [--first-seed 0] [--ids none auto true]
        [--show DIR]

The world's own frames take the place of a generated clip. `classical` perceives them, and fusion
updates the state. A scene passes if 90 % of the moved object's points are within 1 cm of their true
end, at most 2 % are left behind, and 99 % of the other objects' points are in place. `none` leaves
it to perception to find the object when the gripper closes on it; `auto` searches the first image
for objects; `true` has MuJoCo's ids, and is an upper bound. A seed's task is its remainder by 24.

`--show` writes a sheet for each scene and kind of ids: the clip, the state before it, the state
after it, and the state after it with green points in place, red ones not, and yellow points of the
table that moved. Points that are new in the state are magenta.
"""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from egosim_jax.data.sheet import SheetClip, draw_sheet
from egosim_jax.perception import registry
from egosim_jax.rendering import reference
from tests.mujoco_world.judge import Ids, Verdict, judge
from tests.mujoco_world.world import Film, make_film


def main(
    scenes: int = 24,
    first_seed: int = 0,
    ids: tuple[Ids, ...] = ("none", "auto", "true"),
    perception: str = "classical",
    show: Annotated[Path | None, tyro.conf.arg(help="Folder for sheets.")] = None,
) -> None:
    """Judge the perception of each scene.

    Args:
        scenes: Number of scenes.
        first_seed: Seed of the first scene.
        ids: Ids that the scenes are given with.
        perception: Name and options of the perception.
    """
    perceive = registry.parse(perception).build()
    print("seed task: ids, % in place, % left, % others in place, % table dragged, error mm")
    passed = dict.fromkeys(ids, 0)
    for seed in range(first_seed, first_seed + scenes):
        film = make_film(seed)
        for kind in ids:
            verdict = judge(film, perceive, kind)
            passed[kind] += verdict.passed
            print(f"{seed:3d} {title(film)}: {kind:4s} {describe(verdict)}", flush=True)
            if show is not None:
                draw(film, verdict, kind, show / f"{seed:03d}_{kind}.png")
    for kind, count in passed.items():
        print(f"{kind}: {count} of {scenes} scenes passed")


def title(film: Film) -> str:
    """Return the task in words."""
    task = film.layout.task
    words = [task.deed, task.solid]
    for word in ("behind", "below", "onto"):
        words += [word, getattr(task, word)] if getattr(task, word) else []
    return " ".join(words)


def describe(verdict: Verdict) -> str:
    """Return the figures of a verdict."""
    shares = verdict.moved, verdict.left, verdict.still, verdict.dragged
    figures = " ".join(f"{100 * share:5.1f}" for share in shares)
    word = "passed" if verdict.passed else "FAILED"
    return f"{figures} {1000 * verdict.error_m:6.1f} {word} {'; '.join(verdict.notes)}"


def draw(film: Film, verdict: Verdict, ids: Ids, out: Path) -> None:
    """Draw four frames of the clip, and of the states before and after it."""
    out.parent.mkdir(parents=True, exist_ok=True)
    moments = np.rint(np.linspace(0, len(film.clip.frames) - 1, 4)).astype(int)
    cameras = film.action.cameras
    cameras = replace(cameras, world_from_camera=cameras.world_from_camera[moments])
    states = verdict.before, verdict.after, verdict.marks
    videos = [reference.render(state, cameras, point_px=2).frames for state in states]
    name = f"{title(film)}, ids {ids}: {describe(verdict)}"
    clip = SheetClip(name, [film.clip.frames[moments], *videos])
    draw_sheet([clip], out, moments=range(len(moments)), width=2 * cameras.width)


if __name__ == "__main__":
    tyro.cli(main)
