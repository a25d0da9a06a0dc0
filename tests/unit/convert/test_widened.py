"""`egosim-convert`: base models with fewer channels to ours."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from flax import nnx
from safetensors.torch import save_file

from egosim_jax.convert.__main__ import main
from egosim_jax.convert.tables import wan_dit
from egosim_jax.io.weights import flat_shapes, load
from egosim_jax.models.wan.dit import WanDiT
from tests.translation import translate_back
from tests.unit.convert.made import CONFIG
from tests.unit.convert.test_prefixes import prefixed


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


@pytest.mark.slow
def test_a_wider_model_of_a_base_model_gives_the_same_velocity(tmp_path):
    """The base's mask is 1 where ours is 0; the hands are not read yet."""
    narrow = replace(CONFIG.dit, in_channels=36)
    base = WanDiT(narrow, rngs=nnx.Rngs(0))
    _, state = nnx.split(base)
    rng = np.random.default_rng(0)
    base = nnx.merge(
        nnx.graphdef(base),
        jax.tree.map(lambda x: jnp.asarray(0.2 * rng.normal(size=x.shape), x.dtype), state),
    )
    ours = {".".join(map(str, path)): np.asarray(leaf.get_value())
            for path, leaf in nnx.to_flat_state(nnx.state(base, nnx.Param))}  # fmt: skip
    theirs = translate_back(ours, wan_dit.wan(narrow))
    tensors = {n: torch.tensor(np.ascontiguousarray(t)) for n, t in theirs.items()}
    save_file(tensors, tmp_path / "base.safetensors")
    shape = (1, 3, 4, 6)
    noisy, clip, hands = (rng.normal(size=(*shape, 16)).astype(np.float32) for _ in range(3))
    mask = rng.integers(0, 2, (*shape, 4)).astype(np.float32)
    tokens = (rng.normal(size=(1, 5, dim)) for dim in (narrow.text_dim, narrow.image_dim))
    rest = [jnp.array(x, jnp.float32) for x in ([400.0], *tokens)]
    weights = ["weights", str(tmp_path / "base.safetensors"), "--config", "debug"]
    for how, ours_mask in (("copy", mask), ("polarity", 1 - mask)):
        out = tmp_path / how
        assert main([*weights, "--out", str(out), "--widen", how]) == 0
        wide = nnx.eval_shape(lambda: WanDiT(CONFIG.dit, rngs=nnx.Rngs(0)))
        load(out / "dit.safetensors", wide)
        kernel = np.asarray(wide.patch.kernel[...])
        assert not kernel[36:].any()
        np.testing.assert_array_equal(kernel[:16], base.patch.kernel[...][:16])
        expected = base(jnp.concatenate([noisy, mask, clip], axis=-1), *rest)
        found = wide(jnp.concatenate([noisy, ours_mask, clip, hands], axis=-1), *rest)
        scale = float(jnp.abs(expected).max())
        np.testing.assert_allclose(found, expected, atol=1e-6 * scale)
        args = ["verify", str(tmp_path / "base.safetensors"), str(out), "--config", "debug"]
        assert main([*args, "--widen", how]) == 0
    assert main([*weights, "--out", str(tmp_path / "none")]) == 2
