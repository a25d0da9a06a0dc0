"""`egosim-convert`: released checkpoints to weights folders."""

import dataclasses
import math
import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from safetensors.flax import load_file as load_flax
from safetensors.flax import save_file as save_flax
from safetensors.numpy import load_file
from safetensors.torch import save_file

from egosim_jax import configs
from egosim_jax.configs.dwm_wan_14b import DWMWanDiTConfig
from egosim_jax.configs.model import Networks
from egosim_jax.convert import commands, writer
from egosim_jax.convert.__main__ import main
from egosim_jax.convert.detect import detect
from egosim_jax.convert.tables import table_of
from egosim_jax.diffusion import DDIM, RectifiedFlow, VariancePreserving
from egosim_jax.types import InputError
from tests.translation import translate_back
from tests.unit.convert.made import CONFIG, foreign, prefixed, sharded

NETWORKS = ("dit", "vae", "text", "image")


def egosim(folder):
    save_file(foreign("dit", "wan"), folder / "diffusion_pytorch_model.safetensors")
    torch.save(foreign("vae", "wan"), folder / "Wan2.1_VAE.pth")
    text = foreign("text", "wan") | {"spiece_model": torch.zeros(5, dtype=torch.uint8)}
    torch.save(text, folder / "models_t5_umt5-xxl-enc-bf16.pth")
    clip = foreign("image", "wan") | {"log_scale": torch.rand(()), "textual.a": torch.rand(2)}
    torch.save(clip, folder / "models_clip_open-clip-xlm-roberta-large-vit-huge-14.pth")


def wan(folder):
    sharded(folder, foreign("dit", "wan"), "diffusion_pytorch_model")
    torch.save({"model_state": prefixed(foreign("vae", "wan"), "model.")}, folder / "vae.pth")
    torch.save(foreign("text", "wan"), folder / "t5.pth")
    torch.save(prefixed(foreign("image", "wan"), "model."), folder / "clip.pth")


def diffusers(folder):
    for name in ("transformer", "vae", "text_encoder", "image_encoder"):
        (folder / name).mkdir()
    sharded(folder / "transformer", foreign("dit", "diffusers"), "diffusion_pytorch_model")
    save_file(foreign("vae", "diffusers"), folder / "vae" / "diffusion_pytorch_model.safetensors")
    sharded(folder / "text_encoder", foreign("text", "transformers"), "model", 2)
    clip = prefixed(foreign("image", "transformers"), "vision_model.")
    save_file(clip, folder / "image_encoder" / "model.safetensors")


def comfyui(folder):
    dit = prefixed(foreign("dit", "wan"), "diffusion_model.")
    save_file(dit, folder / "wan.safetensors")
    save_file(foreign("vae", "wan"), folder / "vae.safetensors")
    save_file(foreign("text", "transformers"), folder / "umt5.safetensors")
    save_file(foreign("image", "transformers"), folder / "clip_vision.safetensors")


LAYOUTS = {"EgoSim": egosim, "Wan": wan, "diffusers": diffusers, "ComfyUI": comfyui}


@pytest.fixture(scope="module", params=LAYOUTS)
def checkpoint(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    LAYOUTS[request.param](folder)
    return folder


def convert(source, out, *more):
    return main(["weights", str(source), "--config", "debug", "--out", str(out), *more])


def test_every_network_of_every_layout_is_converted_bit_for_bit(checkpoint, tmp_path, capsys):
    assert convert(checkpoint, tmp_path / "out") == 0
    for network in NETWORKS:
        ours = load_file(tmp_path / "out" / f"{network}.safetensors")
        config = CONFIG.networks[network]
        back = translate_back(ours, table_of(config).rules("wan", config))
        expected = foreign(network, "wan")
        assert back.keys() == expected.keys()
        assert all(np.array_equal(back[name], expected[name].numpy()) for name in back)
    Networks.load(CONFIG, tmp_path / "out")
    names = {path.name for path in (tmp_path / "out").glob("[!.]*")}
    assert names == {f"{network}.safetensors" for network in NETWORKS}
    assert "GB/s" in capsys.readouterr().err


def test_inspect_says_what_is_there_and_which_config_fits(checkpoint, capsys):
    assert main(["inspect", str(checkpoint), "--tensors"]) == 0
    said = capsys.readouterr().out
    for network in NETWORKS:
        line = next(line for line in said.splitlines() if f"│ {network} " in line)
        assert "debug" in line
        assert f"{sum(math.prod(t.shape) for t in of_any(checkpoint, network)):,}" in line
    assert "missing networks: none" in said
    assert sum("float32" in line for line in said.splitlines()) > 200


def of_any(checkpoint, network):
    return detect(checkpoint).network(network).tensors.values()


def test_what_does_not_fit_is_one_list_and_nothing_is_written(tmp_path, capsys):
    (source := tmp_path / "theirs").mkdir()
    tensors = foreign("image", "wan")
    less = {name: tensor for name, tensor in tensors.items() if "pre_norm" not in name}
    less["visual.cls_embedding"] = torch.rand(1, 1, 7)
    less["surprise"] = torch.rand(1)
    torch.save(foreign("vae", "wan"), source / "vae.pth")
    save_file(less, source / "clip.safetensors")
    assert convert(source, tmp_path / "weights") == 2
    message = capsys.readouterr().err
    for name in (
        "visual.pre_norm.weight: missing", "visual.pre_norm.bias: missing",
        "surprise: not in the conversion table",
        "class_token: has shape (7,); expected (32,)",
    ):  # fmt: skip
        assert name in message
    assert "4 weights of clip.safetensors" in message
    assert not (tmp_path / "weights").exists()


def test_weights_are_stored_as_asked_and_half_precision_as_it_is(tmp_path):
    (source := tmp_path / "theirs").mkdir()
    save_file(foreign("dit", "wan", dtype=torch.bfloat16), source / "dit.safetensors")
    assert convert(source, tmp_path / "same", "--only", "dit") == 0
    assert convert(source, tmp_path / "wide", "--dtype", "float32", "--only", "dit") == 0
    same, wide = (load_flax(tmp_path / name / "dit.safetensors") for name in ("same", "wide"))
    for path in wide:
        assert same[path].dtype == "bfloat16"
        assert wide[path].dtype == "float32"
        np.testing.assert_array_equal(same[path].astype("float32"), wide[path])


def test_a_network_or_tokenizer_that_is_asked_for_must_be_there(tmp_path, capsys):
    (source := tmp_path / "theirs").mkdir()
    save_file(foreign("vae", "wan"), source / "vae.safetensors")
    assert convert(source, tmp_path / "out", "--only", "dit") == 2
    assert "network dit" in capsys.readouterr().err
    save_file({"a": torch.rand(1)}, source / "vae.safetensors")
    assert convert(source, tmp_path / "out") == 2
    assert "no known network" in capsys.readouterr().err


def test_the_base_of_dwm_is_converted_without_the_network_that_it_lacks(
    tmp_path, monkeypatch, capsys
):
    """By the command of docs/dwm.md, from a folder like the release Wan2.1-Fun-V1.1-14B-InP."""
    dwm, get = configs.get("dwm_wan_14b"), configs.get
    fields = {f.name: getattr(CONFIG.dit, f.name) for f in dataclasses.fields(CONFIG.dit)}
    tiny = replace(dwm, dit=DWMWanDiTConfig(**fields), vae=CONFIG.vae, text=CONFIG.text)
    monkeypatch.setattr(configs, "get", lambda name: tiny if name == dwm.name else get(name))
    (source := tmp_path / "theirs").mkdir()
    egosim(source)
    dit = foreign("dit", "wan")
    dit["patch_embedding.weight"] = dit["patch_embedding.weight"][:, :36].clone()
    save_file(dit, source / "diffusion_pytorch_model.safetensors")
    for folder, files in {
        "google/umt5-xxl": ("spiece.model", "tokenizer.json"),
        "xlm-roberta-large": ("sentencepiece.bpe.model", "tokenizer.json"),
    }.items():
        (source / folder).mkdir(parents=True)
        for name in files:
            (source / folder / name).write_text(folder, encoding="utf-8")
    command = ["weights", str(source), "--config", "dwm_wan_14b", "--widen", "polarity"]
    assert main([*command, "--out", str(tmp_path / "out")]) == 0
    assert "skipped, as dwm_wan_14b lacks it: image" in capsys.readouterr().err
    files = {path.stem for path in (tmp_path / "out").glob("[!.]*.safetensors")}
    assert files == {"dit", "vae", "text"}
    assert load_file(tmp_path / "out" / "dit.safetensors")["patch.kernel"].shape[0] == 52
    tokenizer = tmp_path / "out" / "google" / "umt5-xxl" / "tokenizer.json"
    assert tokenizer.read_text("utf-8") == "google/umt5-xxl"
    for only, message in (("image", "has no network image"), (None, "only image, which")):
        alone = source if only else next(source.glob("models_clip*"))
        options = ["--only", only] if only else []
        command = ["weights", str(alone), "--config", "dwm_wan_14b", *options]
        assert main([*command, "--out", str(tmp_path / "none")]) == 2
        assert message in capsys.readouterr().err


def pieces(count=8):
    """Weights of four pieces each, and the pieces that were computed."""
    computed = []

    def piece(name, number):
        computed.append((name, number))
        return np.full(100, ord(name) + number, np.float32)

    weights = [
        writer.Weight(
            name=name,
            shape=(4, 100),
            dtype=np.dtype(np.float32),
            pieces=tuple(partial(piece, name, number) for number in range(4)),
        )
        for name in "abcdefgh"[:count]
    ]
    return weights, computed


def write(target, weights, **options):
    return writer.write(target, weights, origin=[], metadata={"format": "egosim_jax"}, **options)


def test_an_interrupted_file_goes_on_from_what_is_on_disk_and_ends_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr(writer, "SYNC_BYTES", 2000)
    weights, computed = pieces()
    assert sum(write(tmp_path / "whole.safetensors", weights)) == 8 * 1600
    target = tmp_path / "out" / "x.safetensors"
    started = write(target, weights)
    assert [next(started) for _ in range(25)] == 25 * [400]
    started.close()
    (part,) = target.parent.iterdir()
    data = bytearray(part.read_bytes())
    data[-2000:] = bytes(2000)  # pages that a crash of the machine lost
    part.write_bytes(data)
    computed.clear()
    assert sum(write(target, weights)) == 8 * 1600
    assert 7 <= len(computed) <= 13
    assert [path.name for path in target.parent.iterdir()] == ["x.safetensors"]
    assert target.read_bytes() == (tmp_path / "whole.safetensors").read_bytes()
    for name, array in load_file(target).items():
        np.testing.assert_array_equal(array[:, 0], ord(name) + np.arange(4))


def test_a_complete_file_of_the_same_plan_is_kept_if_it_is_intact(tmp_path):
    weights, computed = pieces()
    target = tmp_path / "x.safetensors"
    sum(write(target, weights))
    expected = target.read_bytes()
    computed.clear()
    assert sum(write(target, weights)) == 8 * 1600
    assert not computed
    target.write_bytes(expected[:-1] + b"x")
    sum(write(target, weights))
    assert (len(computed), target.read_bytes() == expected) == (32, True)


@pytest.mark.parametrize("other", [{"settings": 0.5}, {"weights": pieces(7)[0]}])
def test_a_file_of_another_plan_is_not_continued(tmp_path, monkeypatch, other):
    monkeypatch.setattr(writer, "SYNC_BYTES", 400)
    weights, computed = pieces()
    started = write(tmp_path / "x.safetensors", **{"weights": weights, **other})
    assert [next(started) for _ in range(20)] == 20 * [400]
    started.close()
    computed.clear()
    sum(write(tmp_path / "x.safetensors", weights))
    assert len(computed) == 32
    assert [path.name for path in tmp_path.iterdir()] == ["x.safetensors"]


def back(weights, out, *more):
    return main(["to-torch", str(weights), "--config", "debug", "--out", str(out), *more])


@pytest.mark.parametrize("layout", ["wan", "diffusers"])
@pytest.mark.parametrize("checkpoint", ["EgoSim", "diffusers"], indirect=True)
def test_there_and_back_every_tensor_is_the_same(checkpoint, tmp_path, layout, monkeypatch):
    monkeypatch.setattr(writer, "MAX_FILE_BYTES", 200_000)  # bytes, so that there is more than one
    assert convert(checkpoint, tmp_path / "ours") == 0
    assert back(tmp_path / "ours", tmp_path / "theirs", "--layout", layout) == 0
    for network in NETWORKS:
        found = detect(tmp_path / "theirs").network(network)
        expected = foreign(network, found.naming)
        assert found.tensors.keys() == expected.keys()
        for name, tensor in found.tensors.items():
            np.testing.assert_array_equal(tensor.array(), expected[name].numpy())
    dit = detect(tmp_path / "theirs").network("dit").source.files
    assert len(dit) > 1
    assert all(file.stat().st_size < 250_000 for file in dit)
    assert convert(tmp_path / "theirs", tmp_path / "again") == 0
    for network in NETWORKS:
        file = f"{network}.safetensors"
        first, second = (load_file(tmp_path / name / file) for name in ("ours", "again"))
        assert all(np.array_equal(first[path], second[path]) for path in first)


def test_what_is_not_of_the_config_is_not_written_back(tmp_path, capsys):
    save_file(foreign("vae", "wan"), tmp_path / "vae.pth.safetensors")
    assert convert(tmp_path / "vae.pth.safetensors", tmp_path / "ours") == 0
    args = ["--config", "tabletop", "--out", str(tmp_path / "out"), "--only", "vae"]
    assert main(["to-torch", str(tmp_path / "ours"), *args]) == 2
    assert "has shape" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("process", "reason"),
    [(VariancePreserving(), "no VariancePreserving"), (RectifiedFlow(prediction="x0"), "x0")],
)
def test_a_process_without_a_scheduler_is_refused_before_writing(
    debug_weights, tmp_path, monkeypatch, process, reason
):
    changed = replace(CONFIG, process=process, solver=DDIM())
    monkeypatch.setattr(configs, "get", lambda name: changed)
    command = commands.ToTorch(
        weights=debug_weights, config="debug", out=tmp_path / "out", layout="diffusers"
    )
    with pytest.raises(InputError, match=reason):
        command.run()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("checkpoint", ["EgoSim", "diffusers"], indirect=True)
def test_a_forward_of_each_network_is_that_of_pytorch(checkpoint, tmp_path, capsys):
    assert convert(checkpoint, tmp_path) == 0
    assert main(["verify", str(checkpoint), str(tmp_path), "--config", "debug"]) == 0
    errors = re.findall(r"(\w+): forward differs from PyTorch's by (\S+)", capsys.readouterr().out)
    assert {network for network, _ in errors} == set(NETWORKS)
    # PyTorch's own umT5, whose attention is unscaled, is up to 1.7e-5 from float64.
    assert all(float(error) < 5e-5 for _, error in errors)


def test_verify_finds_one_changed_value(tmp_path, capsys):
    (source := tmp_path / "theirs").mkdir()
    save_file(foreign("image", "wan"), source / "clip.safetensors")
    save_file(foreign("dit", "wan"), source / "dit.safetensors")
    out = tmp_path / "ours"
    assert convert(source, out, "--dtype", "bfloat16", "--only", "image", "dit") == 0
    check = ["verify", str(source), str(out), "--config", "debug"]
    assert main(check) == 0
    said = capsys.readouterr().out
    assert "weights equal" in said
    assert "no checksums" not in said
    file = out / "dit.safetensors"
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(data)
    assert main(check) == 1
    assert "does not match its checksum" in capsys.readouterr().out
    save_flax(load_flax(file), file)  # as other programs write weights
    assert main(check) == 1
    said = capsys.readouterr().out
    assert "dit: no checksums" in said
    assert "differs" in said
