"""Checkpoint folders: other networks, partial downloads and pickles are refused."""

import json
import shutil
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


def change(**values):
    def write(folder):
        path = folder / "config.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), **values}))

    return write


def index(content):
    name = "model.safetensors.index.json"
    return lambda folder: (folder / name).write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            change(model_type="sam3_video"),
            "'sam3_video': Depth Anything V2 .* needs depth_anything",
        ),
        (change(depth_estimation_type="relative"), "estimates 'relative' depth"),
        (lambda folder: (folder / "config.json").unlink(), "has no config.json"),
        (lambda folder: (folder / "preprocessor_config.json").unlink(), "has no preprocessor"),
        (lambda folder: (folder / "config.json").write_text("[]"), "must hold an object"),
        (
            lambda folder: (folder / "model.safetensors").rename(folder / "pytorch_model.bin"),
            r"has no model.safetensors.*pytorch_model.bin is a pickle",
        ),
        (index({"weight_map": {"a": "one.safetensors"}}), "has no one.safetensors"),
        (index({"weight_map": {"a": "../one.safetensors"}}), "outside its folder"),
        (index({"weight_map": {"a": 1}}), "no weight_map"),
        (index([]), "no weight_map"),
    ],
)
def test_a_folder_that_is_no_complete_checkpoint_is_refused(folder, damage, message):
    damage(folder)
    with pytest.raises(InputError, match=message):
        DepthAnything(folder)


@pytest.mark.parametrize(
    ("fields", "message"), [({"timeout_s": 0.0}, "--timeout-s"), ({"batch": 0}, "batch must be")]
)
def test_impossible_parameters_are_refused(folder, fields, message):
    with pytest.raises(InputError, match=message):
        DepthAnything(folder, **fields)


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


def test_missing_weights_are_refused(monkeypatch):
    monkeypatch.setattr(checkpoint, "check_device", lambda name: name)
    report = {"missing_keys": {"head.weight"}, "mismatched_keys": set()}
    network = SimpleNamespace(
        from_pretrained=lambda folder, **_: (None, report), __name__="DepthNetwork"
    )
    with pytest.raises(InputError, match=r"lacks 1 weights of DepthNetwork, such as 'head.weight'"):
        checkpoint.load_network(network, "somewhere", "cpu", "float32")
