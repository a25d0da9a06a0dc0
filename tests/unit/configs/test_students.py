"""A student that is a LoRA in its teacher's folder of weights."""

import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from flax import nnx
from safetensors.numpy import save_file

from egosim_jax import configs
from egosim_jax.cli.__main__ import main as egosim
from egosim_jax.configs.model import Networks, metadata_of
from egosim_jax.io import weights
from egosim_jax.models import lora
from egosim_jax.models.chunks import Chunks
from egosim_jax.train import recipes
from egosim_jax.types import InputError
from tests.unit.generation.test_causal import DEBUG, network

STUDENT = replace(DEBUG, dit=network().config, chunks=Chunks(sizes=(1, 2)))
TEACHER = replace(STUDENT, chunks=None)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a teacher, and a LoRA of one of its layers."""
    path = tmp_path_factory.mktemp("weights")
    Networks(dit=network()).save(path)
    write(path, base=weights.hashes(path)["dit"])
    return path


def write(folder, *, base, chunks=STUDENT.chunks):
    rng = np.random.default_rng(0)
    shape = network().blocks.self_attn.q.kernel.shape
    low = {"down": (*shape[:2], 2), "up": (shape[0], 2, shape[2])}
    tensors = {
        f"blocks.self_attn.q.{name}": rng.normal(size=size).astype(np.float32)
        for name, size in low.items()
    }
    metadata = {**lora.metadata("debug", base=base), **metadata_of("dit", chunks)}
    weights.write(folder / weights.STUDENT, tensors, metadata=metadata)


def load(config, folder):
    return Networks.load(config, folder, only=["dit"]).dit


def test_a_folder_has_a_teacher_and_its_student(folder):
    tensors = weights.read_safetensors(folder / weights.STUDENT)
    down, up = (tensors[f"blocks.self_attn.q.{name}"].array() for name in ("down", "up"))
    teacher, student = (
        dict(nnx.to_flat_state(nnx.state(load(c, folder)))) for c in (TEACHER, STUDENT)
    )
    for path, leaf in teacher.items():
        change = down @ up if path == ("blocks", "self_attn", "q", "kernel") else 0
        np.testing.assert_allclose(student[path].get_value(), leaf.get_value() + change, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"base": "0" * 64}, "trained on"),
        (
            {"chunks": Chunks(sizes=(2, 1))},
            "needs a causal student",
        ),
    ],
)
def test_a_lora_of_other_weights_or_chunks_is_refused(folder, changes, message, tmp_path):
    weights.add_others(tmp_path, folder)
    (tmp_path / weights.STUDENT).unlink()
    write(tmp_path, **{"base": weights.hashes(folder)["dit"], **changes})
    with pytest.raises(InputError, match=message):
        load(STUDENT, tmp_path)


def test_the_package_has_a_student_next_to_its_teacher():
    folder = configs.weights_of("tabletop_student", None)
    assert folder == configs.weights_of("tabletop", None)
    file = folder / weights.STUDENT
    assert file.stat().st_size < 10e6
    wanted = metadata_of("dit", configs.get("tabletop_student").chunks)
    assert weights.student_of(folder / "dit.safetensors", wanted) == file
    assert weights.student_of(folder / "dit.safetensors", {}) is None


@pytest.mark.parametrize("name", [name for name in configs.names() if name.endswith("_student")])
def test_a_students_config_is_what_its_last_stage_trains(name):
    trained, config = recipes.get(f"{name}_dmd").model(), configs.get(name)
    assert (trained.chunks, trained.steps) == (config.chunks, config.steps)
    assert f"{trained.name}_student" == name


def test_a_foreign_lora_is_trained_further_after_the_command_that_its_refusal_names(
    debug_weights, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    name = "diffusion_model.blocks.0.self_attn.q"
    factors = {"lora_A": np.ones((2, 48), np.float32), "lora_B": np.ones((48, 2), np.float32)}
    save_file({f"{name}.{end}.weight": factor for end, factor in factors.items()}, "x.safetensors")
    recipe = replace(
        recipes.get("egosim_14b_lora"), config="debug", lora=Path("x.safetensors"), rank=2,
        weights=debug_weights, latents=tmp_path / "none", out=tmp_path / "out",
    )  # fmt: skip
    with pytest.raises(InputError, match=r"egosim convert lora x\.safetensors") as caught:
        recipe.train()
    command = str(caught.value).partition("egosim ")[2].removesuffix(" (--lora)")
    assert egosim(shlex.split(command)) == 0
    file, changes = replace(recipe, lora=Path("lora.safetensors")).check_lora(debug_weights)
    assert (str(file), changes.keys()) == ("lora.safetensors", {"blocks.self_attn.q"})
    with pytest.raises(InputError, match="give its rank"):
        replace(recipe, rank=None).check_lora(debug_weights)
    assert not (tmp_path / "out").exists()
