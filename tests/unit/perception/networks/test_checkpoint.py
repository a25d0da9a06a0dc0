"""Checkpoint folders: other networks, partial downloads and pickles are refused."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from egosim_jax.io.digest import fingerprint
from egosim_jax.perception.networks import checkpoint
from egosim_jax.perception.networks.depth_anything import DepthAnything
from egosim_jax.types import InputError


@pytest.fixture
def folder(tmp_path):
    """Return a complete folder, except for real weights."""
    folder = tmp_path / "small"
    folder.mkdir()
    config = {"model_type": "depth_anything", "depth_estimation_type": "metric"}
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "preprocessor_config.json").write_text("{}")
    (folder / "model.safetensors").write_bytes(b"weights")
    return folder


def refused(folder, message, **fields):
    with pytest.raises(InputError, match=message):
        DepthAnything(folder, **fields)


def change(folder, **values):
    path = folder / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


def test_a_folder_of_another_network_is_refused_with_its_name(folder):
    change(folder, model_type="sam3_video")
    refused(folder, "model_type 'sam3_video': Depth Anything V2 .* needs depth_anything")


def test_a_relative_network_is_refused(folder):
    change(folder, depth_estimation_type="relative")
    refused(folder, "estimates 'relative' depth")


@pytest.mark.parametrize("missing", ["config.json", "preprocessor_config.json"])
def test_a_missing_file_is_named(folder, missing):
    (folder / missing).unlink()
    refused(folder, f"has no {missing}")


def test_pickled_weights_are_not_read(folder):
    (folder / "model.safetensors").rename(folder / "pytorch_model.bin")
    refused(folder, r"has no model.safetensors.*pytorch_model.bin is a pickle")


@pytest.mark.parametrize(
    ("index", "message"),
    [
        ({"weight_map": {"a": "one.safetensors"}}, "has no one.safetensors"),
        ({"weight_map": {"a": "../one.safetensors"}}, "outside its folder"),
        ({"weight_map": {"a": 1}}, "no weight_map"),
        ([], "no weight_map"),
    ],
)
def test_a_partial_or_damaged_index_of_shards_is_refused(folder, index, message):
    (folder / "model.safetensors.index.json").write_text(json.dumps(index))
    refused(folder, message)


def test_a_config_that_is_not_an_object_is_refused(folder):
    (folder / "config.json").write_text("[]")
    refused(folder, "must hold an object")


@pytest.mark.parametrize(
    ("fields", "message"), [({"timeout_s": 0.0}, "--timeout-s"), ({"batch": 0}, "batch must be")]
)
def test_impossible_parameters_are_refused(folder, fields, message):
    refused(folder, message, **fields)


def test_the_fingerprint_follows_the_content_and_not_the_place(folder, tmp_path):
    network = DepthAnything(folder)
    before = fingerprint(network)
    moved = shutil.copytree(folder, tmp_path / "moved")
    assert fingerprint(DepthAnything(moved, device="cuda:1")) == before
    assert fingerprint(DepthAnything(folder, dtype="bfloat16")) != before
    (moved / "model.safetensors").write_bytes(b"Weights")
    assert fingerprint(DepthAnything(moved)) != before


def test_a_missing_extra_is_named_before_a_worker_starts(folder, monkeypatch):
    monkeypatch.setattr(checkpoint, "find_spec", lambda name: None if name == "torch" else name)
    with pytest.raises(InputError, match=r"torch must be installed. pip install .*networks"):
        DepthAnything(folder).ask({"frames": np.zeros((1, 4, 4, 3), np.uint8)})


def test_missing_weights_are_refused():
    found = {"missing_keys": {"head.weight"}, "mismatched_keys": set()}
    network = SimpleNamespace(
        from_pretrained=lambda folder, **_: (None, found), __name__="DepthNetwork"
    )
    with pytest.raises(InputError, match=r"lacks 1 weights of DepthNetwork, such as 'head.weight'"):
        checkpoint.load_network(network, Path("somewhere"), device="cpu", dtype="float32")
