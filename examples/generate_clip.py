"""Generate one scene with three seeds in one batch; write each clip next to the ground truth."""

from pathlib import Path

import numpy as np

import egosim_jax as egosim
from egosim_jax.worlds.tabletop import make_sequence, to_triplet

out = Path("runs/examples/generate_clip")
out.mkdir(parents=True, exist_ok=True)

generator = egosim.Generator.load("tabletop")
(scene,) = make_sequence(7, spec=generator.config.video, clips=1)
triplet = to_triplet(scene)  # prior, mask, hands, first frame, prompt; and the target

for seed, clip in enumerate(generator.generate([triplet] * 3, seeds=[0, 1, 2])):
    row = np.concatenate([triplet.prior, triplet.hands, clip.frames, triplet.target], axis=2)
    egosim.write_video(out / f"seed_{seed}.mp4", row, fps=clip.fps)
    error = np.square(clip.frames[1:] / 255 - triplet.target[1:] / 255).mean(axis=(1, 2, 3))
    print(f"seed {seed}: {np.mean(-10 * np.log10(error)):.2f} dB, {triplet.prompt}")
