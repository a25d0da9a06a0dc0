"""Holds that last over three clips: where is the object after each, with and without memory?

    python -m tests.benchmarks.bench_holds [--scenes 24] [--kind human] [--generated]

An action of 49 frames is given as three clips: the hand closes in the first and opens in the last.
The world's own frames take the place of generated clips; with `--generated`, `tabletop` makes them.
`classical` perceives them, and fusion updates the state. Printed is the distance of the object's
center from its true place after each clip, in mm, and how many scenes have it within 10 mm. Without
memory, the state forgets after each clip what the hand holds.
"""

from dataclasses import replace

import numpy as np
import tyro

from egosim_jax.generation.generator import Generator
from egosim_jax.geometry import invert, transform
from egosim_jax.perception import registry
from egosim_jax.simulation.actions import slice_action
from egosim_jax.simulation.simulator import Simulator
from egosim_jax.state.fuse import fuse
from egosim_jax.types import Clip, Kind, SceneState, VideoSpec
from egosim_jax.worlds.tabletop import TabletopClip, make_sequence, to_action

SPEC = VideoSpec(frames=49, height=96, width=160, fps=8)
CLIPS = (slice(0, 17), slice(16, 33), slice(32, 49))
NEAR_MM = 10.0


def main(
    scenes: int = 24, first_seed: int = 0, kind: Kind = "human", generated: bool = False
) -> None:
    """Update the state of each scene three times.

    Args:
        scenes: Number of scenes in which a hand moves something.
        first_seed: Seed of the first scene.
        kind: Kind of the hands.
        generated: Use frames of `tabletop` instead of the world's.
    """
    generator = Generator.load("tabletop") if generated else None
    errors: dict[bool, list[list[float]]] = {True: [], False: []}
    seed = first_seed
    while len(errors[True]) < scenes:
        clip = next(make_sequence(seed, spec=SPEC, kind=kind))
        seed += 1
        if not clip.target:
            continue
        line = f"{clip.seed}: {clip.caption}"
        for memory, found in errors.items():
            found.append(after_each(clip, generator, memory=memory))
            line += (
                f" | {'memory' if memory else 'none'}: {', '.join(f'{e:.0f}' for e in found[-1])}"
            )
        print(line, flush=True)
    for memory, found in errors.items():
        near = (np.array(found) <= NEAR_MM).sum(axis=0).tolist()
        median = np.median(found, axis=0).round(1).tolist()
        print(
            f"{'with' if memory else 'without'} memory, after clip 1, 2, 3: {near} of {scenes} "
            f"within {NEAR_MM:.0f} mm, median {median} mm"
        )


def after_each(clip: TabletopClip, generator: Generator | None, *, memory: bool) -> list[float]:
    """Return the distance of the moved object from its true place after each clip, in mm."""
    perceive = registry.parse("classical").build()
    target, path = clip.body_ids[clip.target], clip.world_from_body[clip.target]
    state, errors = clip.state, []
    for frames in CLIPS:
        action = slice_action(to_action(clip), frames.start, frames.stop)
        shown = Clip(frames=clip.frames[frames], fps=SPEC.fps)
        if generator is not None:
            simulator = Simulator(generator=generator, perception=None, fps=SPEC.fps)
            shown = simulator.step(state, action, seed=clip.seed).clip
        state = fuse(state, perceive(shown, action, state))
        if not memory:
            state = replace(state, held={})
        moved = path[frames.stop - 1] @ invert(path[0])
        true = transform(moved, _center(clip.state, target)[None])[0]
        errors.append(1000 * float(np.linalg.norm(_center(state, target) - true)))
    return errors


def _center(state: SceneState, number: int) -> np.ndarray:
    return state.points_m[state.object_ids == number].astype(float).mean(axis=0)


if __name__ == "__main__":
    tyro.cli(main)
