"""Checkpoints and LoRAs are read after any prefix, by one rule; of several, one is chosen."""

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from egosim_jax.convert.__main__ import main
from egosim_jax.convert.detect import detect
from egosim_jax.convert.lora import read_lora
from egosim_jax.io.mapped import read_safetensors
from egosim_jax.types import InputError
from tests.unit.convert.made import (
    CONFIG,
    DIM,
    LAYER,
    arrays,
    foreign,
    one_line,
    pair,
    prefixed,
    save,
)  # fmt: skip

LAYER_NAME = "blocks.0.self_attn.q"


def compiled(tensors, infix="_orig_mod"):
    """As FSDP and torch.compile of each block name the tensors."""
    return {name.replace("blocks.0.", f"blocks.0.{infix}."): t for name, t in tensors.items()}


def wrapped(*keys):
    """Put a state dict below keys, as trainers save it."""

    def put(tensors):
        for key in reversed(keys):
            tensors = {key: tensors}
        return tensors

    return put


FORMS = {
    "plain": lambda t: t,
    "module.": lambda t: prefixed(t, "module."),
    "_orig_mod.": lambda t: prefixed(t, "_orig_mod."),
    "module._orig_mod.model.": lambda t: prefixed(t, "module._orig_mod.model."),
    "generator.model.": lambda t: prefixed(t, "generator.model."),
    "pipe.dit.": lambda t: prefixed(t, "pipe.dit."),
    "any.text.at.all.": lambda t: prefixed(t, "any.text.at.all."),
    "_orig_mod inside": compiled,
    "_fsdp_wrapped_module inside": lambda t: compiled(t, "_fsdp_wrapped_module"),
    "_checkpoint_wrapped_module inside": lambda t: compiled(t, "_checkpoint_wrapped_module"),
    "state_dict.pth": wrapped("state_dict"),
    "lora_sd.pth": wrapped("lora_sd"),
    "model.module.pth": wrapped("model", "module"),
}


def written(form, tensors, folder):
    path = folder / ("x.pth" if form.endswith(".pth") else "x.safetensors")
    (torch.save if path.suffix == ".pth" else save_file)(FORMS[form](tensors), path)
    return path


@pytest.mark.parametrize("form", FORMS)
def test_a_checkpoint_is_read_after_any_prefix(form, tmp_path):
    (found,) = detect(written(form, foreign(), tmp_path)).found
    assert found.tensors.keys() == foreign().keys()


@pytest.mark.parametrize("form", [*FORMS][1::3])
def test_a_lora_is_read_after_the_same_prefixes(form, tmp_path):
    changes = read_lora(written(form, pair(name=LAYER_NAME), tmp_path), CONFIG.dit)
    down, up = pair().values()
    (delta,) = changes.values()
    np.testing.assert_array_equal(delta.down[0], down.numpy().T)
    np.testing.assert_array_equal(delta.up[0], up.numpy().T)
    assert changes.keys() == {LAYER}


PROJECTS = [
    ("lora_unet_blocks_0_self_attn_q", "lora_A lora_B"),
    ("lora_unet__blocks_0_self_attn_q", "lora_down lora_up"),
    ("lora_unet__orig_mod_blocks_0_self_attn_q", "lora.down lora.up"),
    ("lora_unet_blocks_0__orig_mod_self_attn_q", "lora_down lora_up"),
    ("lycoris_blocks_0_self_attn_q", "lora_A lora_B"),
    ("model.lora_unet_blocks_0_self_attn_q", "lora_down lora_up"),
    ("base_model.model.model.blocks.0.self_attn.q", "lora_A lora_B"),
    ("transformer.blocks.0.attn1.to_q", "lora.down lora.up"),
    ("model.diffusion_model.blocks.0.self_attn.q", "lora_down lora_up"),
]


@pytest.mark.parametrize(("name", "ends"), PROJECTS)
def test_a_lora_is_read_in_the_names_of_every_project(name, ends, tmp_path):
    tensors = zip(ends.split(), pair().values(), strict=True)
    named = {f"{name}.{end}.weight": tensor for end, tensor in tensors}
    assert read_lora(save(tmp_path / "x.safetensors", named), CONFIG.dit).keys() == {LAYER}


def in_adapter(name, adapter):
    pairs = zip("AB", pair().values(), strict=True)
    return {f"{name}.lora_{end}.{adapter}.weight": tensor for end, tensor in pairs}


@pytest.mark.parametrize("adapter", ["default", "wan-style", "my_lora_2", "weights"])
def test_an_adapter_may_have_any_name(adapter, tmp_path):
    file = save(tmp_path / "x.safetensors", in_adapter(LAYER_NAME, adapter))
    assert read_lora(file, CONFIG.dit).keys() == {LAYER}
    assert read_lora(file, CONFIG.dit, adapter=adapter).keys() == {LAYER}


def test_of_several_adapters_one_is_chosen(tmp_path, capsys):
    second = {name: 2 * tensor for name, tensor in in_adapter(LAYER_NAME, "hands").items()}
    file = save(tmp_path / "x.safetensors", in_adapter(LAYER_NAME, "default") | second)
    args = ["lora", file, "--config", "debug", "--out", tmp_path / "out.safetensors"]
    assert "adapters 'default'; 'hands': choose one of them. (" in one_line(capsys, 2, *args)
    assert "'default'; 'hands'" in one_line(capsys, 2, *args, "--adapter", "feet")
    assert main([str(arg) for arg in [*args, "--adapter", "hands"]]) == 0
    (delta,) = read_lora(tmp_path / "out.safetensors", CONFIG.dit).values()
    np.testing.assert_array_equal(delta.down[0], 2 * next(iter(pair().values())).numpy().T)


TWINS = [
    ("model.", "ema.", "ema"),
    ("generator.", "generator_ema.", "generator_ema"),
    ("", "ema_model.module.", "ema_model"),
    ("online.dit.", "target.dit.", "target.dit"),
]


@pytest.mark.parametrize(("first", "second", "chosen"), TWINS)
def test_of_two_checkpoints_in_a_file_one_is_chosen(first, second, chosen, tmp_path, capsys):
    tensors = prefixed(foreign(), first) | prefixed(foreign(add=1), second)
    torch.save(tensors, tmp_path / "x.pt")
    args = ["weights", tmp_path / "x.pt", "--config", "debug", "--out"]
    said = one_line(capsys, 2, *args, tmp_path / "none")
    assert repr(first) in said
    assert repr(second) in said
    assert "(--prefix)" in said
    for prefix, add in ((chosen, 1), (first, 0)):
        out = tmp_path / f"out{add}"
        assert main([*map(str, [*args, out]), "--prefix", prefix]) == 0
        have = read_safetensors(out / "dit.safetensors")
        for path, array in arrays("dit").items():
            np.testing.assert_array_equal(have[path].array(), array + np.float32(add))
    args += [tmp_path / "none", "--prefix", "student"]
    assert "no network after 'student'" in one_line(capsys, 2, *args)


@pytest.mark.parametrize(("first", "second", "chosen"), TWINS[1:3])
def test_of_two_loras_in_a_file_one_is_chosen(first, second, chosen, tmp_path, capsys):
    doubled = {name: 2 * tensor for name, tensor in pair(name=LAYER_NAME).items()}
    tensors = prefixed(pair(name=LAYER_NAME), first) | prefixed(doubled, second)
    file = save(tmp_path / "x.safetensors", tensors)
    args = ["lora", file, "--config", "debug", "--out", tmp_path / "out.safetensors"]
    said = one_line(capsys, 2, *args)
    assert repr(first) in said
    assert repr(second) in said
    assert "--prefix" in said
    assert "after 'student'" in one_line(capsys, 2, *args, "--prefix", "student")
    assert main([*map(str, args), "--prefix", chosen]) == 0
    (delta,) = read_lora(tmp_path / "out.safetensors", CONFIG.dit).values()
    np.testing.assert_array_equal(delta.down[0], 2 * next(iter(pair().values())).numpy().T)


def test_verify_takes_the_prefix(tmp_path, capsys):
    tensors = prefixed(foreign(), "model.") | prefixed(foreign(add=1), "ema.")
    torch.save(tensors, tmp_path / "x.pt")
    args = [str(tmp_path / "x.pt"), "--config", "debug", "--prefix", "ema"]
    assert main(["weights", *args, "--out", str(tmp_path / "out")]) == 0
    assert main(["verify", args[0], str(tmp_path / "out"), *args[1:]]) == 0
    assert "weights equal" in capsys.readouterr().out


def test_of_two_files_the_path_of_one_is_given(tmp_path, capsys):
    source = tmp_path / "theirs"
    for name in ("a", "b"):
        (source / name).mkdir(parents=True)
        half = dict(list(foreign().items())[::2])
        rest = {key: tensor for key, tensor in foreign().items() if key not in half}
        for number, part in enumerate((half, rest), 1):
            save_file(part, source / name / f"dit-{number:05d}-of-00002.safetensors")
    args = ["--config", "debug", "--out", tmp_path / "out"]
    said = one_line(capsys, 2, "weights", source, "--only", "dit", *args)
    assert "2 checkpoints of the network dit (a, b): give the path" in said
    assert main([str(a) for a in ["weights", source / "a", "--only", "dit", *args]]) == 0


def test_a_lora_of_a_convolution_is_the_product_of_its_factors(tmp_path):
    down = torch.randn(2, CONFIG.dit.in_channels, 1, 2, 2)
    up = torch.randn(DIM, 2, 1, 1, 1)
    name = "diffusion_model.patch_embedding"
    tensors = {f"{name}.lora_A.weight": down, f"{name}.lora_B.weight": up}
    file = save(tmp_path / "x.safetensors", tensors | {f"{name}.alpha": torch.tensor(6.0)})
    (change,) = read_lora(file, CONFIG.dit).values()
    product = torch.einsum("or,rcij->ocij", up[:, :, 0, 0, 0], down[:, :, 0]).numpy()
    np.testing.assert_allclose(change, 3 * product.transpose(1, 2, 3, 0), rtol=1e-5, atol=1e-5)
    save(tmp_path / "x.safetensors", tensors | {f"{name}.lora_B.weight": up[:5].clone()})
    with pytest.raises(InputError, match="whose product is not of the kernel"):
        read_lora(file, CONFIG.dit)


OTHERS = {
    "DoRA": ["lora_magnitude_vector", "dora_scale", "lora_magnitude_vector.default.weight"],
    "LoHa": ["hada_w1_a", "hada_w2_b", "hada_t1"],
    "LoKr": ["lokr_w1", "lokr_w2_a", "lokr_t2"],
    "OFT": ["oft_blocks", "oft_diag", "boft_R"],
    "LoRA with biases": ["lora_B.bias", "lora_A.default.bias"],
    "LoRA with a middle factor": ["lora_mid.weight"],
}


@pytest.mark.parametrize("kind", OTHERS)
def test_another_kind_of_adapter_is_named(kind, tmp_path):
    for end in OTHERS[kind]:
        tensors = pair() | {f"diffusion_model.{LAYER_NAME}.{end}": torch.rand(DIM)}
        with pytest.raises(InputError, match=f"tensors of {kind}.*egosim convert weights"):
            read_lora(save(tmp_path / "x.safetensors", tensors), CONFIG.dit)


@pytest.mark.parametrize(
    "name",
    [
        "diffusion_model.vace_blocks.0.self_attn.q",
        "single_blocks.0.head.head",
        "lora_unet_vace_blocks_0_self_attn_q",
        "diffusion_model.blocks.0.self_attn.q.extra",
    ],
)
def test_a_layer_of_another_network_is_not_taken_for_one_of_this(name, tmp_path):
    file = save(tmp_path / "x.safetensors", pair() | pair(name=name))
    with pytest.raises(InputError, match="not of a layer of this network"):
        read_lora(file, CONFIG.dit)


def test_what_is_outside_the_prefix_is_skipped_with_a_message(tmp_path, capsys):
    saved = {"state_dict": pair(name=LAYER_NAME), "optimizer": {"state": {0: torch.rand(2)}}}
    torch.save(saved, tmp_path / "x.pth")
    assert read_lora(tmp_path / "x.pth", CONFIG.dit).keys() == {LAYER}
    assert "skipped 1 tensors that are not of the LoRA, such as 'opt" in capsys.readouterr().err


def test_the_lora_of_a_checkpoint_that_was_saved_with_it_is_read_and_merged(tmp_path, capsys):
    """The fix that `convert weights` gives for such a checkpoint."""
    tensors = foreign() | pair(name=LAYER_NAME)
    for kind in ("weight", "bias"):
        name = f"{LAYER_NAME}.{kind}"
        tensors[f"{LAYER_NAME}.base_layer.{kind}"] = tensors.pop(name)
    file = save(tmp_path / "x.safetensors", tensors)
    base = tmp_path / "base"
    args = ["--config", "debug", "--out"]
    assert main(["weights", str(file), *args, str(base)]) == 0
    assert "egosim convert lora --merge" in capsys.readouterr().err
    merge = ["--merge", str(base)]
    assert main(["lora", str(file), *args, str(tmp_path / "out"), *merge]) == 0
    have = read_safetensors(tmp_path / "out" / "dit.safetensors")[f"{LAYER}.kernel"].array()[0]
    down, up = pair().values()
    expected = arrays("dit")[f"{LAYER}.kernel"][0] + (up @ down).numpy().T
    np.testing.assert_allclose(have, expected, atol=1e-5)
