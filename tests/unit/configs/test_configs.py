"""The released models by name."""

import pytest

from egosim_jax import configs
from egosim_jax.io.weights import flat_shapes
from egosim_jax.networks import Networks
from egosim_jax.types import InputError


def test_every_config_knows_its_own_name():
    assert configs.names() == [
        "debug",
        "dwm_cogvideox_5b",
        "egosim_14b",
        "egosim_1_3b",
        "real_tiny",
        "tabletop",
    ]
    assert [configs.get(name).name for name in configs.names()] == configs.names()


def test_a_typo_is_answered_with_the_nearest_name():
    with pytest.raises(InputError, match="Nearest: real_tiny"):
        configs.get("real-tinny")


def test_egosim_14b_has_the_released_networks_at_their_size():
    config = configs.get("egosim_14b")
    parts = Networks.abstract(config).parts()
    patch = flat_shapes(parts["dit"])["patch.kernel"]
    assert patch == (52, 2, 2, 5120)
    assert parts.keys() == {"dit", "vae", "text", "image"}


def test_egosim_14b_turns_on_the_quirks_of_the_release():
    config = configs.get("egosim_14b")
    assert config.image_range == "unit"
    assert config.process.timestep_rounding == "bfloat16"
    assert (config.process.shift, config.steps, config.guidance.scale) == (5.0, 50, 1.0)
    assert config.latent_shape == (16, 60, 104)
