"""Models without weights, and checkpoints and runs that are given as weights."""

import dataclasses
import shlex
import shutil

import numpy as np
import pytest
from safetensors.numpy import save_file

from egosim_jax import configs
from egosim_jax.cli.__main__ import main
from egosim_jax.generation.generator import Generator
from egosim_jax.io import weights
from egosim_jax.io.run import write_json
from egosim_jax.train import recipes
from egosim_jax.types import InputError

TRAINED = (
    "debug",
    "real_tiny",
    "dwm_tabletop",
    "egosim_1_3b",
    "egosim_14b_student",
    "egosim_1_3b_student",
)


@pytest.mark.parametrize("name", TRAINED)
def test_a_model_without_weights_names_its_training(name, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(InputError, match=f"Train them: egosim train {name}") as caught:
        configs.weights_of(name, None)
    command = str(caught.value).split("Train them: ")[1].split(". Or name")[0]
    _, _, recipe, *options = shlex.split(command)
    fields = {field.name for field in dataclasses.fields(recipes.get(recipe))}
    given = {word[2:].replace("-", "_") for word in options if word.startswith("--")}
    assert "out" in given
    assert given <= fields


@pytest.mark.parametrize(
    "name", sorted(set(configs.names()) - {*TRAINED, "tabletop", "tabletop_student"})
)
def test_a_released_model_without_weights_names_fetch_or_convert(name, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    commands = rf"egosim models fetch {name}|egosim convert weights DOWNLOAD --config {name} --out"
    with pytest.raises(InputError, match=commands):
        configs.weights_of(name, None)


def checkpoint(folder, form):
    """A download in one of the layouts of releases; the path that a user gives."""
    files = {
        "EgoSim": ["diffusion_pytorch_model.safetensors"],
        "Wan": ["Wan2.1_VAE.pth", "diffusion_pytorch_model-00001-of-00002.safetensors"],
        "diffusers": ["model_index.json", "transformer/diffusion_pytorch_model.safetensors"],
        "ComfyUI": ["wan.safetensors", "vae.safetensors"],
        "a file": ["wan.safetensors"],
    }[form]
    for name in files:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".safetensors":
            save_file({"a": np.zeros(3, np.float32)}, path, {"format": "pt"})
        else:
            path.write_bytes(b"{}")
    return folder / files[0] if form == "a file" else folder


@pytest.mark.parametrize(
    ("command", "form"),
    [
        ("generate", "EgoSim"),
        ("generate", "diffusers"),
        ("simulate", "Wan"),
        ("play", "ComfyUI"),
        ("play", "a file"),
    ],
)
def test_a_checkpoint_given_as_weights_is_to_be_converted(command, form, tmp_path, capsys):
    given = checkpoint(tmp_path / "EgoSim", form)
    args = [command, "--config", "debug", "--weights", str(given)]
    args += [] if command == "play" else ["--out", str(tmp_path / "out")]
    assert main(args) == 2
    said = capsys.readouterr().err
    assert f"egosim convert weights {given} --config debug --out weights/debug" in said


def test_a_checkpoint_is_refused_by_the_library_and_by_training(tmp_path):
    given = checkpoint(tmp_path / "EgoSim", "EgoSim")
    with pytest.raises(InputError, match="egosim convert weights"):
        Generator.load("debug", given)
    recipe = dataclasses.replace(
        recipes.get("egosim_14b"), out=tmp_path / "out", latents=given, weights=given
    )
    with pytest.raises(InputError, match=r"egosim convert weights .*--config egosim_14b"):
        recipe.train()


def test_a_run_given_as_weights_is_named_with_its_folder(debug_weights, tmp_path):
    shutil.copytree(debug_weights, tmp_path / "run" / "weights")
    with pytest.raises(InputError, match=r"run is a run: its weights are in .*run/weights\. \("):
        configs.weights_of("debug", tmp_path / "run")
    assert configs.weights_of("debug", tmp_path / "run" / "weights")


def test_weights_of_the_tabletop_world_are_known_by_their_folder(debug_weights, tmp_path):
    assert configs.trained_on("tabletop", configs.shipped_weights("tabletop")) == "tabletop"
    assert configs.trained_on("debug", debug_weights) is None
    run = tmp_path / "run" / "weights"
    run.mkdir(parents=True)
    for written, known in (
        ({"type": type(recipes.get("tabletop")).__name__}, "tabletop"),
        ({"type": type(recipes.get("real_tiny")).__name__}, None),
        ([], None),
    ):
        write_json(run.parent / "config.json", written)
        assert configs.trained_on("tabletop", run) == known
    (run.parent / "config.json").write_text("{")
    assert configs.trained_on("tabletop", run) is None


def test_a_scene_that_weights_were_not_made_for_is_said_in_one_line():
    for world, provenance in (
        (None, {}),
        (None, {"world": "tabletop"}),
        ("tabletop", {"world": "tabletop", "seed": "3"}),
    ):
        assert configs.scene_warning(world, provenance) is None
    note = configs.scene_warning("tabletop", {"source": "depth image"})
    assert "\n" not in note
    for command in ("egosim models fetch egosim_14b", "egosim train real_tiny --metadata"):
        assert command in note


@pytest.mark.parametrize("has", [[], ["vae"], ["lora"]])
def test_a_folder_of_ours_without_a_denoiser_is_no_checkpoint(has, tmp_path):
    for name in has:
        weights.write(tmp_path / f"{name}.safetensors", {"a": np.zeros(3, np.float32)})
    with pytest.raises(InputError, match=r"No weights file at .*dit\.safetensors"):
        configs.weights_of("debug", tmp_path)
