"""`egosim-convert`: base models with fewer channels to ours."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from flax import nnx
from safetensors.torch import save_file

from egosim_jax.convert.__main__ import main
from egosim_jax.convert.tables import wan_dit
from egosim_jax.io.weights import flat_shapes
from egosim_jax.models.wan.dit import WanDiT
from tests.translation import translate_back
from tests.unit.convert.made import CONFIG, prefixed


@pytest.mark.parametrize(
    ("naming", "prefix", "widen"),
    [("wan", "", "polarity"), ("diffusers", "", "copy"), ("wan", "diffusion_model.", "polarity")],
)
def test_a_widened_model_is_verified_with_its_base(tmp_path, capsys, naming, prefix, widen):
    narrow = replace(CONFIG.dit, in_channels=36)
    shapes = flat_shapes(nnx.eval_shape(lambda: WanDiT(narrow, rngs=nnx.Rngs(0))))
    rng = np.random.default_rng(0)
    ours = {path: 0.2 * rng.normal(size=shape) for path, shape in shapes.items()}
    base = translate_back(ours, getattr(wan_dit, naming)(narrow))
    tensors = {name: torch.tensor(np.ascontiguousarray(x)).float() for name, x in base.items()}
    save_file(prefixed(tensors, prefix), tmp_path / "base.safetensors")
    args = [str(tmp_path / "base.safetensors"), "--config", "debug", "--widen", widen]
    assert main(["weights", *args, "--out", str(tmp_path / "out")]) == 0
    verify = ["verify", args[0], str(tmp_path / "out"), *args[1:]]
    assert main(verify) == 0
    assert "dit: forward differs from PyTorch's by" in capsys.readouterr().out
    other = {"copy": "polarity", "polarity": "copy"}[widen]
    assert main([*verify[:-1], other]) == 1
    said = capsys.readouterr().out
    assert "patch.kernel differs" in said
    assert "dit: forward differs by more than rounding" in said
