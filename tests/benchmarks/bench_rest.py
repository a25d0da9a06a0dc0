"""Three clips of a hand at rest against three clips without hands.

    python -m tests.benchmarks.bench_rest [--scenes 12]

Each scene has a fixed camera and is simulated twice, with the state of `classical`. Printed are the
PSNR of each clip against the true world, the PSNR of the targets through the autoencoder, which no
denoiser exceeds, and how far the colors of the objects, which nothing touches, drift from the end
of the first clip to the end of the last: the largest change of the mean of a channel over the
pixels of an object, in 8-bit levels.
"""

import numpy as np
import tyro

from egosim_jax import Generator, Simulator, get_perception
from egosim_jax.evaluation.metrics.report import score
from egosim_jax.types import Action
from egosim_jax.worlds.tabletop import make_scripts
from egosim_jax.worlds.tabletop.clips import to_action, to_triplet
from egosim_jax.worlds.tabletop.idle import ABSENT_PROMPT, RESTING_PROMPT
from egosim_jax.worlds.tabletop.scene import FIRST_BODY, FIRST_HAND
from egosim_jax.worlds.tabletop.world import World

CLIPS, MIN_PIXELS = 3, 30
"""Clips of a scene, and the pixels of an object whose color is compared."""


def main(scenes: int = 12, first_scene: int = 400, config: str = "tabletop") -> None:
    """Simulate scenes with a resting hand and without hands."""
    generator = Generator.load(config)
    spec = generator.config.video
    perception = get_perception("classical")().build()
    simulator = Simulator(generator=generator, perception=perception, fps=spec.fps)
    psnr: dict[str, list[list[float]]] = {"rests": [], "absent": []}
    ceilings: dict[str, list[list[float]]] = {"rests": [], "absent": []}
    drifts: dict[str, list[float]] = {"rests": [], "absent": []}
    for seed in range(first_scene, first_scene + scenes):
        script = next(make_scripts(seed, spec=spec, fixed_camera=True))
        joints = np.repeat(script.action.joints_m[:1], spec.frames, axis=0)
        for name, shown, prompt in (
            ("rests", joints, RESTING_PROMPT),
            ("absent", np.full_like(joints, np.nan), ABSENT_PROMPT),
        ):
            world, state, scores, ends = World(scene=script.scene, seed=seed), None, [], []
            limits = []
            action = Action(cameras=script.cameras, joints_m=shown, kind="human", prompt=prompt)
            for number in range(CLIPS):
                clip, world = world.execute(action)
                state = clip.state if state is None else state
                first = clip.first.colors if number == 0 else None
                step = simulator.step(state, to_action(clip), seed=seed + number, first_frame=first)
                state = step.state
                scores.append(score(step.clip.frames[1:], clip.frames[1:])["psnr"])
                (coded,) = generator.reconstruct([to_triplet(clip)])
                limits.append(score(coded.frames[1:], clip.frames[1:])["psnr"])
                ends.append(step.clip.frames[-1].astype(float))
            psnr[name].append(scores)
            ceilings[name].append(limits)
            drifts[name] += color_drifts(clip.ids[-1], ends[0], ends[-1])
        rests, absent = psnr["rests"][-1], psnr["absent"][-1]
        print(seed, *(f"{a:.2f} {b:.2f}" for a, b in zip(rests, absent, strict=True)), flush=True)
    for name, found in psnr.items():
        shown, coded = (
            " ".join(f"{value:.2f}" for value in np.mean(values, axis=0))
            for values in (found, ceilings[name])
        )
        print(
            f"{name}: clips 1 to {CLIPS} {shown} dB (autoencoder {coded}); "
            f"{len(drifts[name])} objects drift by {np.median(drifts[name]):.1f} levels, "
            f"at most {max(drifts[name]):.1f}"
        )


def color_drifts(ids: np.ndarray, begin: np.ndarray, end: np.ndarray) -> list[float]:
    """Return how far the mean color of each object changes from one frame to another."""
    bodies = np.unique(ids[(ids >= FIRST_BODY) & (ids < FIRST_HAND)])
    own = [ids == number for number in bodies]
    return [
        float(np.abs((end - begin)[mask].mean(axis=0)).max())
        for mask in own
        if mask.sum() >= MIN_PIXELS
    ]


if __name__ == "__main__":
    tyro.cli(main)
