"""DWM's checkpoints: read, and written back bit for bit."""

from dataclasses import replace
from math import prod

import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from safetensors.flax import save_file

from egosim_jax import configs
from egosim_jax.configs.dwm_wan_14b import DWMWanDiTConfig
from egosim_jax.convert.__main__ import main
from egosim_jax.convert.lora import check_base, read_lora
from egosim_jax.convert.lora_export import checkpoint
from egosim_jax.convert.plan import merged
from egosim_jax.convert.tables import table_of, weight_shapes
from egosim_jax.io.mapped import read_metadata, read_safetensors
from egosim_jax.io.weights import hashes
from egosim_jax.models.cogvideox.dit import CogVideoXDiTConfig
from egosim_jax.models.layers import Linear
from egosim_jax.models.lora import Delta, Value, apply
from egosim_jax.types import InputError
from tests.translation import translate_back

RANK, LAYERS = 4, 2
COGVIDEOX = CogVideoXDiTConfig(
    in_channels=49, dim=32, heads=2, layers=LAYERS, text_dim=16, time_dim=16, base_rows=2,
    base_columns=3,
)  # fmt: skip
WAN = DWMWanDiTConfig(dim=48, ffn_dim=96, heads=2, layers=LAYERS, text_dim=64, image_dim=32)


def wan_layers(dim=48, ffn=96, text=64, image=32, freq=256, layers=LAYERS, out=64):
    """Width and output of every linear layer of Wan's transformer, by VideoX-Fun's names."""
    attention = ("self_attn.q", "self_attn.k", "self_attn.v", "self_attn.o")
    attention += tuple(f"cross_attn.{name}" for name in ("q", "k", "v", "o", "k_img", "v_img"))
    found = {}
    for block in range(layers):
        found |= {f"blocks.{block}.{name}": (dim, dim) for name in attention}
        found |= {f"blocks.{block}.ffn.0": (dim, ffn), f"blocks.{block}.ffn.2": (ffn, dim)}
    return found | {
        "text_embedding.0": (text, dim), "text_embedding.2": (dim, dim),
        "time_embedding.0": (freq, dim), "time_embedding.2": (dim, dim),
        "time_projection.1": (dim, 6 * dim), "img_emb.proj.1": (image, image),
        "img_emb.proj.3": (image, dim), "head.head": (dim, out),
    }  # fmt: skip


def released(family, folder, dtype="float32"):
    """Write the two files of a training of DWM; return their tensors by stem."""
    rng = np.random.default_rng(0)
    draw = lambda *shape: rng.normal(size=shape).astype(jnp.dtype(dtype))  # noqa: E731
    low = {}
    if family == "cogvideox":
        for block in range(LAYERS):
            for name in ("to_q", "to_k", "to_v", "to_out.0"):
                layer = f"transformer_blocks.{block}.attn1.{name}"
                low[f"{layer}.lora_A.weight"] = draw(RANK, 32)
                low[f"{layer}.lora_B.weight"] = draw(32, RANK)
        files = {
            "pytorch_lora_weights": low,
            "non_lora_weights": {
                "patch_embed.proj.weight": draw(32, 49, 2, 2), "patch_embed.proj.bias": draw(32),
            },
        }  # fmt: skip
    else:
        for name, (wide, out) in wan_layers().items():
            layer = f"lora_unet__{name.replace('.', '_')}"
            low[f"{layer}.lora_down.weight"] = draw(RANK, wide)
            low[f"{layer}.lora_up.weight"] = draw(out, RANK)
            low[f"{layer}.alpha"] = np.array(RANK, jnp.dtype(dtype))
        files = {
            "lora_diffusion_pytorch_model": low,
            "non_lora_weights": {
                "patch_embedding.weight": draw(48, 52, 1, 2, 2), "patch_embedding.bias": draw(48),
            },
        }  # fmt: skip
    folder.mkdir()
    for stem, tensors in files.items():
        arrays = {name: jnp.asarray(tensor) for name, tensor in tensors.items()}
        save_file(arrays, folder / f"{stem}.safetensors")
    return files


@pytest.fixture
def tiny(monkeypatch):
    """Config `dwm_cogvideox_5b` with a small transformer."""
    model = configs.get("dwm_cogvideox_5b")
    tiny = replace(
        model, dit=COGVIDEOX, text=replace(model.text, dim=16, ffn_dim=32, heads=2, head_dim=8)
    )
    monkeypatch.setattr(configs, "get", lambda name: tiny)
    monkeypatch.setattr(configs, "names", lambda: ["dwm_cogvideox_5b"])


@pytest.mark.parametrize("dtype", ["float32", "float16", "bfloat16"])
@pytest.mark.parametrize(("family", "config"), [("cogvideox", COGVIDEOX), ("wan", WAN)])
def test_a_checkpoint_is_written_back_bit_for_bit(family, config, dtype, tmp_path):
    want = released(family, tmp_path / "checkpoint", dtype)
    have = checkpoint(read_lora(tmp_path / "checkpoint", config), config, None)
    assert have.keys() == want.keys()
    for stem, tensors in want.items():
        assert have[stem].keys() == tensors.keys()
        for name, tensor in tensors.items():
            assert (have[stem][name].dtype, have[stem][name].shape) == (tensor.dtype, tensor.shape)
            assert have[stem][name].tobytes() == tensor.tobytes(), name


def test_an_alpha_that_half_precision_cannot_hold_is_written_exactly():
    naming = table_of(WAN).checkpoint
    for rank, dtype in ((256, "bfloat16"), (257, "float32")):
        down, up = (np.zeros(shape, jnp.bfloat16) for shape in ((2, rank), (rank, 2)))
        alpha = naming.tensors("head.head", down, up)["lora_unet__head_head.alpha"]
        assert (alpha, alpha.dtype) == (rank, dtype)


@pytest.mark.parametrize("half", ["float16", "bfloat16"])
def test_half_precision_is_added_as_the_same_values_in_float32(half, tmp_path):
    """Applications and merges alike."""
    rng, shapes, half = np.random.default_rng(0), weight_shapes(WAN), jnp.dtype(half)
    wide, out = shapes["head.linear.kernel"]
    down, up, bias = (rng.normal(size=s).astype(half) for s in ((wide, RANK), (RANK, out), out))
    path = tmp_path / "dit.safetensors"
    save_file({name: jnp.full(shape, 0.1) for name, shape in shapes.items()}, path)

    def results(scale, dtype):
        changes = {
            "head.linear": Delta(down=down.astype(dtype), up=up.astype(dtype)),
            "head.linear.bias": Value(array=bias.astype(dtype)),
        }
        linear = Linear(wide, out, axes=(None, None), rngs=nnx.Rngs(0))
        apply(nnx.Dict(head=nnx.Dict(linear=linear)), changes, scale=scale)
        yield linear(jnp.ones((1, wide)))
        for weight in merged(read_safetensors(path), changes, WAN, scale=scale):
            if weight.name.startswith("head.linear"):
                yield weight.pieces[0]().astype(weight.dtype)

    for scale in (1.0, 0.3):
        for one, other in zip(results(scale, half), results(scale, np.float32), strict=True):
            np.testing.assert_array_equal(one, other)


def test_a_transformer_that_was_saved_with_its_lora_is_read_without_it(tiny, tmp_path, capsys):
    """As in the final folder of a training of DWM: PEFT renames the adapted layers."""
    rng = np.random.default_rng(0)
    ours = {n: rng.normal(size=s).astype(np.float32) for n, s in weight_shapes(COGVIDEOX).items()}
    theirs = translate_back(ours, table_of(COGVIDEOX).rules("diffusers", COGVIDEOX))
    adapted = {}
    for name, tensor in theirs.items():
        layer, _, kind = name.rpartition(".")
        if layer.endswith(("to_q", "to_k", "to_v", "to_out.0")):
            name = f"{layer}.base_layer.{kind}"
            adapted[f"{layer}.lora_A.default.weight"] = np.ones((RANK, 32), np.float32)
            adapted[f"{layer}.lora_B.default.weight"] = np.ones((32, RANK), np.float32)
        adapted[name] = np.ascontiguousarray(tensor)
    folder = tmp_path / "final" / "transformer"
    folder.mkdir(parents=True)
    file = folder / "diffusion_pytorch_model.safetensors"
    save_file({name: jnp.asarray(tensor) for name, tensor in adapted.items()}, file)
    command = f"weights {tmp_path / 'final'} --config dwm_cogvideox_5b --only dit --out".split()
    assert main([*command, str(tmp_path / "out")]) == 0
    assert "skipped 16 tensors of a LoRA" in capsys.readouterr().err
    have = read_safetensors(tmp_path / "out" / "dit.safetensors")
    assert have.keys() == ours.keys()
    assert all(np.array_equal(have[name].array(), ours[name]) for name in ours)
    adapted = {name: a for name, a in adapted.items() if "to_q.base_layer" not in name}
    save_file({name: jnp.asarray(tensor) for name, tensor in adapted.items()}, file)
    assert main([*command, str(tmp_path / "none")]) == 2
    assert "to_q.weight: missing" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "modules", "weights", "patch"),
    [
        ("dwm_cogvideox_5b", 168, 66_060_288, (49, 2, 2, 3072)),
        ("dwm_wan_14b", 488, 364_580_864, (52, 2, 2, 5120)),
    ],
)
def test_a_full_size_checkpoint_has_the_layers_of_the_release(name, modules, weights, patch):
    """Its low-rank tensors have rank 1; rank 64 has 64 times as many weights."""
    config = configs.get(name).dit
    shapes = weight_shapes(config)
    changes = {}
    for path, shape in shapes.items():
        *stack, wide, out = shape if path.endswith(".kernel") else (0, 0)
        patterns = ("blocks.attn.",) if name == "dwm_cogvideox_5b" else ("",)
        if path.endswith(".kernel") and path.startswith(patterns) and path != "patch.kernel":
            down, up = (
                np.zeros((*stack, wide, 1), np.float16),
                np.zeros((*stack, 1, out), np.float16),
            )
            changes[path.removesuffix(".kernel")] = Delta(down=down, up=up)
    (tensors,) = checkpoint(changes, config, None).values()
    pairs = [tensor for key, tensor in tensors.items() if not key.endswith("alpha")]
    assert len(pairs) == 2 * modules
    assert 64 * sum(prod(tensor.shape) for tensor in pairs) == weights
    if name == "dwm_wan_14b":
        sizes = wan_layers(5120, 13824, 4096, 1280, 256, 40)
        names = {f"lora_unet__{layer.replace('.', '_')}.lora_down.weight" for layer in sizes}
        assert names == {key for key in tensors if key.endswith("down.weight")}
    assert shapes["patch.kernel"] == patch


@pytest.mark.parametrize(
    ("path", "shape", "base", "config", "reason"),
    [
        ("patch.bias", 32, None, COGVIDEOX, r"give these weights\. \(--base\)"),
        ("blocks.attn.q.bias", (LAYERS, 32), {}, COGVIDEOX, "only outside the blocks"),
        ("patch.bias", 32, None, configs.get("debug").dit, r"only the models dwm_\*"),
    ],
)
def test_changes_that_a_checkpoint_cannot_have_are_refused(path, shape, base, config, reason):
    with pytest.raises(InputError, match=reason):
        checkpoint({path: np.ones(shape, np.float32)}, config, base)


def test_a_file_without_its_weights_in_full_is_refused(tiny, tmp_path, capsys):
    """Read alone, it would be applied without the projection of the hands."""
    released("cogvideox", tmp_path / "checkpoint")
    file = tmp_path / "checkpoint" / "pytorch_lora_weights.safetensors"
    for act in (read_lora, lambda path, _: check_base(path, ["0"])):
        with pytest.raises(InputError, match="only a part of a LoRA"):
            act(file, COGVIDEOX)
    assert main(["lora", str(file), "--config", "x", "--out", str(tmp_path / "out")]) == 2
    assert f"two files, {tmp_path / 'checkpoint'}" in capsys.readouterr().err


def test_a_checkpoint_says_on_which_weights_it_was_trained(tiny, tmp_path, capsys):
    """A LoRA that continues from merged weights does not fit the release's base."""
    released("cogvideox", tmp_path / "checkpoint")
    for name in ("base", "other"):
        (tmp_path / name).mkdir()
        save_file({"a": jnp.zeros(len(name))}, tmp_path / name / "dit.safetensors")
    convert = lambda source, *to: main(["lora", str(tmp_path / source), "--config", "x", *to])  # noqa: E731
    dwm = ("--layout", "dwm", "--out")
    assert convert("checkpoint", "--base", str(tmp_path / "base"), *dwm, str(tmp_path / "1")) == 0
    assert convert("1", *dwm, str(tmp_path / "2")) == 0
    known = hashes(tmp_path / "base", only=("dit",))["dit"]
    for file in [*(tmp_path / "1").iterdir(), *(tmp_path / "2").iterdir()]:
        assert file.name.startswith(".") or read_metadata(file)["base_sha256"] == known
    capsys.readouterr()
    out = str(tmp_path / "3")
    assert convert("2", "--merge", str(tmp_path / "other"), "--out", out) == 2
    assert "was trained on other weights" in capsys.readouterr().err
