"""Weights folders of earlier versions: names of files and tensors, values and hashes."""

from pathlib import Path

import numpy as np
from flax import nnx
from safetensors.flax import load_file

from egosim_jax.configs.model import ModelConfig, Networks
from egosim_jax.io.mapped import read_safetensors
from egosim_jax.io.weights import hashes
from egosim_jax.models.wan.clip_vision import CLIPVisionConfig
from egosim_jax.models.wan.dit import WanDiTConfig
from egosim_jax.models.wan.umt5 import UMT5Config
from egosim_jax.models.wan.vae import WanVAEConfig
from egosim_jax.types import VideoSpec

FOLDER = Path(__file__).parent / "old_weights"
"""Random weights in bfloat16 that version 0.1.0 wrote at commit b291cad."""
CONFIG = ModelConfig(
    name="tiny",
    video=VideoSpec(frames=5, height=32, width=32, fps=16),
    dit=WanDiTConfig(dim=16, heads=1, ffn_dim=8, layers=2, text_dim=4, image_dim=8, freq_dim=8),
    vae=WanVAEConfig(dim=2, dim_mult=(1, 1, 1, 1), res_blocks=1),
    text=UMT5Config(vocab=16, dim=4, ffn_dim=4, heads=1, head_dim=4, layers=1),
    image=CLIPVisionConfig(image_size=8, patch=4, dim=8, layers=2, heads=1, ffn_dim=4),
)

HASHES = {
    "dit": "d5d160429cbde454", "vae": "8c41b70be5b95660",
    "text": "cbc414d3914eb7f6", "image": "10ca21459716b0f2",
}  # fmt: skip
"""First digits of the networks' hashes as that commit gave them."""


def test_a_weights_folder_of_an_earlier_version_loads_bit_for_bit():
    parts = Networks.load(CONFIG, FOLDER).parts()
    assert parts.keys() == {"dit", "vae", "text", "image"}
    for name, network in parts.items():
        written = load_file(FOLDER / f"{name}.safetensors")
        state = nnx.to_flat_state(nnx.state(network, nnx.Param))
        loaded = {".".join(map(str, path)): leaf.get_value() for path, leaf in state}
        assert loaded.keys() == written.keys()
        for path, array in loaded.items():
            assert array.dtype == written[path].dtype
            np.testing.assert_array_equal(array, written[path])


def test_the_hashes_of_an_earlier_version_are_the_same():
    assert {name: found[:16] for name, found in hashes(FOLDER).items()} == HASHES
    tensors = read_safetensors(FOLDER / "dit.safetensors").values()
    assert all(tensor.intact and not tensor.checksums for tensor in tensors)
