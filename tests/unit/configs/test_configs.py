"""The released models by name."""

import dataclasses

import pytest
from flax import nnx

from egosim_jax import configs
from egosim_jax.configs.model import Networks
from egosim_jax.io.weights import flat_shapes
from egosim_jax.models.wan.clip_vision import CLIPVisionConfig
from egosim_jax.types import InputError


def test_every_config_knows_its_own_name():
    assert [configs.get(name).name for name in configs.names()] == configs.names()
    with pytest.raises(InputError, match="Nearest: real_tiny"):
        configs.get("real-tinny")


def test_egosim_14b_has_the_released_networks_at_their_size():
    config = configs.get("egosim_14b")
    parts = Networks.abstract(config).parts()
    patch = flat_shapes(parts["dit"])["patch.kernel"]
    assert patch == (52, 2, 2, 5120)
    assert parts.keys() == {"dit", "vae", "text", "image"}


def test_dwm_is_sampled_as_released_or_as_for_the_paper():
    config = configs.get("dwm_cogvideox_5b")
    assert configs.sampled(config, "released") == config
    assert (config.vae.decode_first, config.dit.time_angles) == (3, "float32")
    paper = configs.sampled(config, "paper")
    assert paper.vae.decode_first == 1
    assert paper.solver.stochastic
    assert paper.unconditional_prompt.startswith("The video is not of a high quality")
    assert paper.encoding_noise.prior_pixels == 0.0563
    assert (paper.steps, paper.guidance.scale) == (50, 6.0)


@pytest.mark.parametrize(
    ("name", "sampling", "message"),
    [
        ("dwm_cogvideox_5b", "papers", "Nearest: paper. All: released, paper"),
        ("egosim_14b", "paper", "egosim_14b has no named samplings"),
    ],
)
def test_an_unknown_sampling_is_refused(name, sampling, message):
    with pytest.raises(InputError, match=message):
        configs.sampled(configs.get(name), sampling)


@pytest.mark.parametrize(("frames", "nearest"), [(13, "9 or 17"), (51, "49 or 57")])
def test_a_length_that_the_chunks_of_a_codec_do_not_take_is_refused(frames, nearest):
    config = configs.get("dwm_cogvideox_5b")
    with pytest.raises(InputError, match=rf"needs 8k\+1 frames\. Nearest: {nearest}"):
        dataclasses.replace(config, video=dataclasses.replace(config.video, frames=frames))


def test_dwm_on_wan_has_image_tokens_of_zeros_and_no_encoder():
    config = configs.get("dwm_wan_14b")
    assert "image" not in config.networks
    assert config.zero_image(2).shape == (2, 257, 1280)
    assert (config.layout.channels, config.layout.mask_scale) == (52, 1.0)
    with pytest.raises(InputError, match="without an image encoder"):
        dataclasses.replace(config, image=CLIPVisionConfig())


@pytest.mark.parametrize("name", ["debug", "dwm_tabletop"])
def test_every_weight_names_one_logical_axis_a_dimension(name):
    for network in Networks.abstract(configs.get(name)).parts().values():
        for path, leaf in nnx.to_flat_state(nnx.state(network, nnx.Param)):
            axes = leaf.get_metadata()["axes"]
            assert len(axes) == len(leaf.shape), path
            assert (axes[0] == "layers") == (path[0] == "blocks"), path
