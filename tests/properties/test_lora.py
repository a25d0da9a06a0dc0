"""A LoRA of any layers and rank is the same after it was written in foreign names and read."""

import tempfile
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import save_file

from egosim_jax import configs
from egosim_jax.configs.model import Networks
from egosim_jax.convert.lora import read_lora
from egosim_jax.convert.lora_export import exported, exported_metadata
from egosim_jax.io.weights import flat_shapes
from egosim_jax.models.lora import Delta

CONFIG = configs.get("debug").dit
SHAPES = {
    name.removesuffix(".kernel"): shape
    for name, shape in flat_shapes(
        Networks.abstract(configs.get("debug"), only=["dit"]).dit
    ).items()
    if name.startswith("blocks.") and name.endswith(".kernel")
}


@settings(max_examples=8)
@given(
    st.sets(st.sampled_from(sorted(SHAPES)), min_size=1), st.integers(1, 5), st.integers(0, 1000)
)
def test_a_lora_is_read_as_it_was_written(layers, rank, seed):
    rng = np.random.default_rng(seed)
    deltas = {}
    for name in layers:
        *stack, wide, out = SHAPES[name]
        down, up = (
            rng.normal(size=(*stack, *ends)).astype(np.float32)
            for ends in ((wide, rank), (rank, out))
        )
        deltas[name] = Delta(down=down, up=up)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "lora.safetensors"
        save_file(exported(deltas, CONFIG), path, metadata=exported_metadata(deltas))
        back = read_lora(path, CONFIG)
    assert back.keys() == deltas.keys()
    for name, delta in deltas.items():
        np.testing.assert_array_equal(back[name].down, delta.down)
        np.testing.assert_array_equal(back[name].up, delta.up)
