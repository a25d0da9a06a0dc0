"""The generator of an experiment with a trained model."""

from __future__ import annotations

from dataclasses import replace

from egosim_jax import configs
from egosim_jax.experiments.config import ModelExperiment
from egosim_jax.generation.generator import Generator
from egosim_jax.io.run import open_folder
from egosim_jax.io.weights import hashes
from egosim_jax.types import check_counts, check_seed


def open_experiment(settings: ModelExperiment) -> Generator:
    """Open the folder of an experiment, new or of equal settings, and load its generator."""
    check_counts({"--steps": settings.steps})
    check_seed(settings.first_scene, name="--first-scene")
    config = configs.get(settings.config)
    config = replace(config, steps=settings.steps or config.steps)
    weights = configs.weights_of(settings.config, settings.weights)
    record = {"experiment": settings, "model": config, "weights": hashes(weights)}
    open_folder(settings.out, record, mutable=["experiment.weights"])
    return Generator.load(config, weights)
