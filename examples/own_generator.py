"""Close the loop around your own generator: here it returns the view, the baseline to beat."""

import numpy as np

import egosim_jax as egosim
from egosim_jax.types import VideoSpec
from egosim_jax.worlds.tabletop import make_sequence, observation_of, to_episode


def copy_view(view, action, first_frame, seed):
    """Return the view, unobserved pixels filled from the first frame."""
    return np.where(view.mask[..., None] > 0, first_frame, view.frames)


video = VideoSpec(frames=17, height=96, width=160, fps=8)
clips = list(make_sequence(7, spec=video, clips=3))
episode = to_episode(clips, fps=video.fps)
oracle = egosim.get_perception("oracle")().build(
    {step: observation_of(clip) for step, clip in enumerate(clips)}
)
for name, perception in {"not updated": None, "updated by the oracle": oracle}.items():
    simulator = egosim.Simulator(generator=copy_view, perception=perception, fps=video.fps)
    state = episode.state
    for number, (clip, action) in enumerate(zip(clips, episode.actions, strict=True), start=1):
        step = simulator.step(state, action, seed=number)
        error = np.square(step.clip.frames[1:] / 255 - clip.frames[1:] / 255).mean(axis=(1, 2, 3))
        print(f"{name}, clip {number}: {np.mean(-10 * np.log10(error)):.2f} dB")
        state = step.state
