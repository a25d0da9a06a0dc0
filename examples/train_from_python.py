"""Train all four networks of `debug` by its recipe, and generate a clip with them."""

from dataclasses import replace
from pathlib import Path

import egosim_jax as egosim
from egosim_jax.train.recipes import RECIPES
from egosim_jax.worlds.tabletop import make_sequence, to_triplet

out = Path("runs/examples/train_from_python")
about, recipe = RECIPES["debug"]
print(about)
vae, denoiser = (replace(stage, steps=4) for stage in (recipe.vae, recipe.denoiser))
short = replace(recipe, out=out, clips=4, clip_frames=9, vae=vae, denoiser=denoiser)
short.run()  # the same call resumes an interrupted training

generator = egosim.Generator.load("debug", out / "weights")
(scene,) = make_sequence(7, spec=generator.config.video, clips=1)
(clip,) = generator.generate([to_triplet(scene)], seeds=[0])
egosim.write_video(out / "clip.mp4", clip.frames, fps=clip.fps)
