"""Choice of what makes the clips of a world: a model with its weights, or the preview."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jax.sharding import Mesh

from egosim_jax import configs
from egosim_jax.configs.model import ModelConfig
from egosim_jax.generation.generator import Generator
from egosim_jax.io.weights import hashes
from egosim_jax.rendering import Renderer, jitted
from egosim_jax.simulation import preview
from egosim_jax.simulation.preview import Preview
from egosim_jax.types import InputError, VideoSpec


@dataclass(frozen=True, kw_only=True)
class Maker:
    """Model that makes clips, before its weights are loaded, or the preview."""

    name: str
    """Name of the model, or "preview"."""
    video: VideoSpec
    """Length, size and rate of the clips."""
    model: ModelConfig | None = None
    """Config of the model; None for the preview."""
    weights: Path | None = None
    """Folder of the model's weights; None for the preview."""
    trained_on: str | None = None
    """Simulated world whose clips trained the weights (`configs.trained_on`); None if unknown."""
    instead: bool = False
    """True for a preview of a scene that the shipped weights were not made for."""

    @property
    def chunk_frames(self) -> tuple[int, ...]:
        """Frames of each chunk of a clip."""
        return (self.video.frames,) if self.model is None else self.model.chunk_frames

    @property
    def made_of(self) -> dict[str, Any]:
        """Config and hashes of the weights, for the config of a run."""
        if self.model is None or self.weights is None:
            return {"model": preview.NAME, "weights": {}}
        student = self.model.chunks is not None
        return {"model": self.model, "weights": hashes(self.weights, student=student)}

    def note(self, provenance: Mapping[str, str]) -> str | None:
        """Return a one-line warning about the clips of a scene, or None."""
        if self.model is not None:
            return configs.scene_warning(self.trained_on, provenance)
        return preview_note(instead=self.instead)

    def load(self, *, renderer: Renderer = jitted, mesh: Mesh | None = None) -> Generator | Preview:
        """Return the generator."""
        if self.model is None:
            return Preview(renderer=renderer)
        return Generator.load(self.model, self.weights, renderer=renderer, mesh=mesh)


def choose(
    config: str | None,
    weights: Path | None = None,
    *,
    default: str,
    steps: int | None = None,
    provenance: Mapping[str, str] | None = None,
    video: VideoSpec | None = None,
) -> Maker:
    """Return what makes the clips: a model by name, or the preview.

    Without a name and weights it is the default model, if its weights were made for the scene of
    this provenance, and else the preview. A preview has clips of `video`. Raises `InputError` if
    there are no weights, and for options of models that a preview does not have.
    """
    name = config or default
    instead = False
    if config is None and weights is None and provenance is not None:
        world = configs.trained_on(name, configs.weights_of(name, None))
        instead = configs.scene_warning(world, provenance) is not None and steps is None
    if name == preview.NAME or instead:
        for option, value in {"--weights": weights, "--steps": steps}.items():
            if value is not None:
                raise InputError(
                    f"{option} {value} has no effect on a preview, which has no weights and no "
                    "denoising steps: omit it, or name a model. (--config)"
                )
        return Maker(name=preview.NAME, video=video or preview.VIDEO, instead=instead)
    model = configs.get(name)
    model = replace(model, steps=steps or model.steps)
    folder = configs.weights_of(name, weights)
    return Maker(
        name=name,
        video=model.video,
        model=model,
        weights=folder,
        trained_on=configs.trained_on(name, folder),
    )


def preview_note(*, instead: bool = False) -> str:
    """Return a warning that clips are previews; `instead` adds why, and how to get others."""
    if not instead:
        return f"These clips are {preview.ABOUT}."
    return (
        f"These clips are {preview.ABOUT}: the shipped weights were made for the tabletop world, "
        "and this scene is not of it. For clips of a model, train on your own clips "
        f"({configs.training_of('real_tiny')}), or fetch EgoSim's weights (egosim models fetch "
        "egosim_14b), and name it. (--config)"
    )
