"""Settings of the experiments."""

from dataclasses import fields
from importlib import import_module

import pytest

from egosim_jax.cli.experiment import MODULES
from egosim_jax.types import InputError

WITH_SCENES = [kind for kind in MODULES if "first_scene" in {f.name for f in fields(kind)}]


@pytest.mark.parametrize("kind", WITH_SCENES, ids=lambda kind: MODULES[kind])
def test_a_negative_scene_is_refused_before_anything_is_made(kind, tmp_path):
    experiment = import_module(f"egosim_jax.experiments.{MODULES[kind]}")
    with pytest.raises(InputError, match="--first-scene must be a whole number from 0"):
        experiment.run(kind(out=tmp_path / "out", first_scene=-1))
    assert not (tmp_path / "out").exists()
