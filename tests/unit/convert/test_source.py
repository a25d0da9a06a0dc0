"""Foreign checkpoints open in every published form, and damage is reported."""

import json

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from egosim_jax.convert.detect import detect
from egosim_jax.convert.source import sources
from egosim_jax.io.mapped import read_safetensors
from egosim_jax.types import InputError


def test_safetensors_keep_their_bits(tmp_path):
    dtypes = (
        torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.float8_e4m3fn,
        torch.float8_e5m2, torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8,
        torch.uint16, torch.uint32, torch.uint64, torch.bool,
    )  # fmt: skip
    values = {str(dtype): (10 * torch.rand(3, 5)).to(dtype) for dtype in dtypes}
    save_file(values, tmp_path / "x.safetensors", {"format": "pt"})
    found = read_safetensors(tmp_path / "x.safetensors")
    assert found.keys() == values.keys()
    for name, tensor in found.items():
        array = tensor.array()
        assert f"torch.{array.dtype.name}" == name
        np.testing.assert_array_equal(array.view(np.uint8), values[name].view(torch.uint8).numpy())
        assert not array.flags.writeable


def test_numbered_files_and_files_of_an_index_are_one_checkpoint(tmp_path):
    parts = [{"a": torch.rand(2)}, {"b": torch.rand(3)}]
    for number, part in enumerate(parts, start=1):
        save_file(part, tmp_path / f"model-{number:05d}-of-00002.safetensors")
        save_file(part, tmp_path / f"odd_{number}.safetensors")
    places = {"a": "odd_1.safetensors", "b": "odd_2.safetensors"}
    index = tmp_path / "odd.safetensors.index.json"
    index.write_text(json.dumps({"weight_map": places}), encoding="utf-8")
    torch.save({"c": torch.rand(1)}, tmp_path / "other.pth")
    found = {source.name: source for source in sources(tmp_path)}
    assert found.keys() == {"odd", "model", "other.pth"}
    assert found["odd"].tensors.keys() == found["model"].tensors.keys() == {"a", "b"}
    assert found["model"].bytes == 20
    for number in (1, 2):
        (whole,) = sources(tmp_path / f"model-{number:05d}-of-00002.safetensors")
        assert (whole.name, whole.files) == ("model", found["model"].files)
    (tmp_path / "odd_2.safetensors").unlink()
    with pytest.raises(InputError, match="odd_2"):
        list(sources(tmp_path))
    index.unlink()
    (tmp_path / "model-00001-of-00002.safetensors").unlink()
    with pytest.raises(InputError, match="1 of the 2 files of model"):
        list(sources(tmp_path))
    (alone,) = sources(tmp_path / "model-00002-of-00002.safetensors")
    assert [*alone.tensors] == ["b"]


@pytest.mark.parametrize("indexed", [False, True])
def test_files_next_to_a_single_one_are_chosen_by_the_path_in_the_refusal(tmp_path, indexed):
    save_file({"visual.cls_embedding": torch.rand(1)}, tmp_path / "model.safetensors")
    names = ["visual.cls_embedding", "other"]
    files = [f"x-{number:05d}-of-00002.safetensors" for number in (1, 2)]
    for file, name in zip(files, names, strict=True):
        save_file({name: torch.rand(1)}, tmp_path / file)
    if indexed:
        places = json.dumps({"weight_map": dict(zip(names, files, strict=True))})
        (tmp_path / "x.safetensors.index.json").write_text(places, encoding="utf-8")
    path = "x.safetensors.index.json" if indexed else files[0]
    with pytest.raises(InputError, match=rf"\({path}, model\.safetensors\)|, {path}\)"):
        detect(tmp_path).network("image")
    assert detect(tmp_path / path).network("image").tensors.keys() == {*names}


def test_a_file_is_read_by_its_first_bytes(tmp_path):
    torch.save({"a": torch.rand(2)}, tmp_path / "of_torch.ckpt")
    save_file({"b": torch.rand(3)}, tmp_path / "of_safetensors.bin")
    found = {source.name: [*source.tensors] for source in sources(tmp_path)}
    assert found == {"of_safetensors.bin": ["b"], "of_torch.ckpt": ["a"]}
    (quantized := tmp_path / "q.safetensors").write_bytes(b"GGUF" + bytes(60))
    with pytest.raises(InputError, match="is a GGUF file"):
        list(sources(quantized))


def test_a_name_in_two_files_is_refused(tmp_path):
    for number in (1, 2):
        save_file({"a": torch.rand(2)}, tmp_path / f"m-{number:05d}-of-00002.safetensors")
    with pytest.raises(InputError, match="which another file of m also has"):
        list(sources(tmp_path))


def test_networks_are_detected_by_their_names_under_any_prefix(tmp_path):
    names = {
        ("dit", "wan", "diffusion_model."): "diffusion_model.blocks.0.self_attn.q.weight",
        ("vae", "wan", "model."): "model.decoder.upsamples.0.residual.2.weight",
        ("text", "transformers", ""): "encoder.block.0.layer.0.SelfAttention.q.weight",
        ("image", "transformers", "vision_model."): "vision_model.embeddings.class_embedding",
    }  # fmt: skip
    for number, name in enumerate(names.values()):
        folder = tmp_path / "deep" / str(number) if number else tmp_path
        folder.mkdir(parents=True, exist_ok=True)
        save_file({name: torch.rand(1)}, folder / f"{number}.safetensors")
    save_file({"lora_A.weight": torch.rand(1)}, tmp_path / "z.safetensors")
    (tmp_path / "google" / "umt5-xxl").mkdir(parents=True)
    (tmp_path / "google" / "umt5-xxl" / "tokenizer.json").touch()
    (tmp_path / ".cache").mkdir()
    save_file({"x": torch.rand(1)}, tmp_path / ".cache" / "x.safetensors")
    folder = detect(tmp_path)
    assert {(f.network, f.naming, f.prefix) for f in folder.found} == names.keys()
    assert [source.name for source in folder.unknown] == ["z.safetensors"]
    assert folder.tokenizer == tmp_path / "google" / "umt5-xxl"
    assert list(folder.network("dit").tensors) == ["blocks.0.self_attn.q.weight"]


def test_of_two_tokenizers_that_of_t5_is_taken(tmp_path):
    """Wan's releases also have the tokenizer of CLIP's text encoder, one folder nearer."""
    (t5 := tmp_path / "google" / "umt5-xxl").mkdir(parents=True)
    (clip := tmp_path / "xlm-roberta-large").mkdir()
    for folder in (t5, clip):
        (folder / "tokenizer.json").touch()
    save_file({"x": torch.rand(1)}, tmp_path / "x.safetensors")
    assert detect(tmp_path).tokenizer == clip
    (t5 / "spiece.model").touch()
    assert detect(tmp_path).tokenizer == t5


def test_what_is_not_there_or_not_one_is_said(tmp_path):
    with pytest.raises(InputError, match="holds no checkpoint"):
        detect(tmp_path)
    with pytest.raises(InputError, match="No such file"):
        detect(tmp_path / "none")
    for name in "ab":
        save_file({"visual.cls_embedding": torch.rand(1)}, tmp_path / f"{name}.safetensors")
    with pytest.raises(InputError, match=r"2 checkpoints of the network image \(a\.s.*b\.s"):
        detect(tmp_path).network("image")
    with pytest.raises(InputError, match="0 checkpoints of the network dit"):
        detect(tmp_path).network("dit")
