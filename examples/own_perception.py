"""Register a perception pipeline: the stages of `classical`, and one of your own."""

from dataclasses import dataclass
from pathlib import Path

import egosim_jax as egosim
from egosim_jax.perception.pipeline import Pipeline
from egosim_jax.worlds.tabletop import make_sequence, to_episode


def print_shares(clip, action, state, observation):
    """Print the shares of hands and objects in the clip's last frame."""
    ids = observation.require("object_ids", "print_shares")[-1]
    print(f"clip {state.step + 1}: hands {(ids < 0).mean():.1%}, objects {(ids > 0).mean():.1%}")
    return observation


@egosim.register_perception("counting")
@dataclass(frozen=True, kw_only=True)
class Counting:
    """Config of the pipeline; its fields are options of `egosim simulate --perception`."""

    def build(self, ground_truth=None):
        """Return the pipeline. A config with fields would pass them as parameters."""
        classical = egosim.get_perception("classical")().build()
        return Pipeline(stages=(*classical.stages, print_shares))


generator = egosim.Generator.load("tabletop")
episode = to_episode(list(make_sequence(0, spec=generator.config.video, clips=2)), fps=8)
perception = egosim.get_perception("counting")().build()
simulator = egosim.Simulator(generator=generator, perception=perception, fps=8)
for step in egosim.Rollout(simulator, Path("runs/examples/own_perception")).run(
    episode.state, episode.actions, seed=0
):
    print("objects that moved:", [step.state.names[n] for n in step.state.world_from_object])
