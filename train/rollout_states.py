"""States of a model's own rollouts, from which priors to train on are rendered.

In a closed loop a clip starts from a state that was read back from generated frames, with their
errors, or from one that lacks what nobody has seen. A model that was trained on perfect states
alone has never had to make up for either.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from egosim_jax.io.weights import hashes
from egosim_jax.perception import registry
from egosim_jax.simulation.simulator import Simulator, VideoGenerator
from egosim_jax.types import SceneState
from egosim_jax.worlds.tabletop import TabletopClip, to_episode


@dataclass(frozen=True, kw_only=True)
class OwnRollouts:
    """States of a sequence's clips in a rollout of a model that is given the true actions."""

    config: str
    """Name of the model."""
    weights: Path
    """Folder of its weights."""
    digests: Mapping[str, str]
    """Hashes of the weights, so that a data set is not continued with others."""
    perceptions: tuple[str, ...] = ("classical", "oracle")
    """Perceptions that update the state, by name; a scene has the one of its seed."""

    @classmethod
    def of(cls, config: str, weights: Path) -> OwnRollouts:
        """Return the states of rollouts by a weights folder."""
        return cls(config=config, weights=weights, digests=hashes(weights))

    def __call__(self, clips: Sequence[TabletopClip]) -> Iterator[SceneState | None]:
        """Yield None, for the first clip has its own state, then the state before each clip."""
        yield None
        generator, fps = load_generator(self.config, self.weights)
        episode = to_episode(clips, fps=fps)
        name = self.perceptions[clips[0].seed % len(self.perceptions)]
        simulator = Simulator(
            generator=generator,
            perception=registry.parse(name).build(episode.observations()),
            fps=fps,
        )
        state, image = episode.state, episode.first_frame
        for clip, action in zip(clips[:-1], episode.actions, strict=False):
            seed = 1000 * clip.seed + clip.number
            state = simulator.step(state, action, seed=seed, first_frame=image).state
            image = None
            yield state


@cache
def load_generator(config: str, weights: Path) -> tuple[VideoGenerator, int]:
    """Return a model as a generator of clips and their frame rate, loaded once in a process."""
    from egosim_jax import configs
    from egosim_jax.generation.generator import Generator

    return Generator.load(config, weights), configs.get(config).video.fps
