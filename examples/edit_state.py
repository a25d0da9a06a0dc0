"""Move an object in the 3D state, and generate the same action from either state.

A state is a set of arrays. Each clip is generated from a view of the state, so the next clip shows
your change.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

import egosim_jax as egosim
from egosim_jax.worlds.tabletop import make_sequence, to_action

out = Path("runs/examples/edit_state")
out.mkdir(parents=True, exist_ok=True)

generator = egosim.Generator.load("tabletop")
simulator = egosim.Simulator(generator=generator, perception=None, fps=8)
(scene,) = make_sequence(3, spec=generator.config.video, clips=1)
action, state = to_action(scene), scene.state

number, name = min((n, name) for n, name in state.names.items() if name in action.prompt)
moved = state.points_m + np.where(state.object_ids == number, 1, 0)[:, None] * [0.06, 0, 0]
edited = replace(state, points_m=moved.astype(np.float32))

clips = [simulator.step(s, action, seed=1).clip.frames for s in (state, edited)]
egosim.write_video(out / "before_after.mp4", np.concatenate(clips, axis=2), fps=8)
egosim.save_state(out / "edited", edited)
print(f"{name} was moved by 6 cm: {out / 'before_after.mp4'}")
