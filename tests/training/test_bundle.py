"""A bundle trains like the trainer, with few packages, and its weights can be joined again."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egosim_jax import configs
from egosim_jax.conditioning.condition import ConditionDropout
from egosim_jax.data.shards import ShardReader, ShardWriter
from egosim_jax.generation.generator import Generator
from egosim_jax.io import parts
from egosim_jax.runtime.command import ExitCode
from egosim_jax.testing import write_latents
from egosim_jax.train import bundle_writer
from egosim_jax.train.bundle import FILES, LATENTS, BundleRecipe, Latents, main
from egosim_jax.train.bundle_writer import write_bundle
from egosim_jax.train.config import OptimizerConfig, TrainConfig
from egosim_jax.train.loop import train
from egosim_jax.train.recipes import TABLETOP
from egosim_jax.train.task import Stage
from egosim_jax.train.tasks.denoising import Denoising
from egosim_jax.types import InputError
from tests.flags import QUICK
from tests.training.killing import logged

STEPS = 3
MODEL = configs.get("debug")
STAGE = Stage(
    Denoising(model=MODEL, dropout=ConditionDropout(prior=0.3), change_loss_weight=2.0),
    TrainConfig(
        steps=STEPS,
        batch_size=2,
        optimizer=OptimizerConfig(name="muon", learning_rate=1e-2, warmup_steps=1, ema_decay=0.9),
        log_every=1,
    ),
)
ABSENT = "grain tyro av open3d cv2 array_record ftfy tokenizers matplotlib huggingface_hub"
"""Packages that a bare machine lacks."""
BARE = f"""
import sys
sys.modules.update(dict.fromkeys({ABSENT!r}.split()))
from egosim_jax.train.bundle import main
import egosim_jax
print(egosim_jax.__file__)
sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture(scope="module")
def latents(tmp_path_factory):
    """Shards with one record five times: every batch is the same, and exact in float16."""
    folder = tmp_path_factory.mktemp("latents")
    record = ShardReader(write_latents(folder / "any", MODEL, records=1))[0]
    arrays = {
        name: array.astype(np.float16).astype(array.dtype) if array.dtype.kind == "f" else array
        for name, array in record.arrays.items()
    }
    provenance = {"config": MODEL.name, "encoders": {}}
    with ShardWriter(
        folder / "same", kind="latents", spec=MODEL.video, grid=MODEL.grid, provenance=provenance
    ) as writer:
        for _ in range(5):
            writer.add(arrays, record.metadata)
    return folder / "same"


@pytest.fixture(scope="module")
def written(latents, debug_weights, tmp_path_factory):
    out = tmp_path_factory.mktemp("bundle") / "bundle"
    data = {"train": latents, "test": latents}
    write_bundle(out, STAGE, latents=data, weights=debug_weights, dtype="float16")
    return out


@pytest.fixture(scope="module")
def trained(written, tmp_path_factory):
    """Run folder of an uninterrupted training from the bundle."""
    out = tmp_path_factory.mktemp("trained") / "run"
    assert main(["train", "--bundle", str(written), "--out", str(out)]) == ExitCode.DONE
    return out


def test_a_validation_has_every_record_once_in_batches_of_one_size(written):
    batches = list(Latents(written, "test").one_pass(2))
    assert [batch["record"].tolist() for batch in batches] == [[0, 1], [2, 3], [4, 5]]
    assert [batch["weight"].tolist() for batch in batches] == [[1, 1], [1, 1], [1, 0]]
    assert {len(batch["target"]) for batch in batches} == {2}


def losses(out: Path) -> list[float]:
    return [line["loss"] for line in logged(out) if "loss" in line]


@pytest.mark.slow
def test_the_losses_are_those_of_the_trainer_on_the_same_batches(
    trained, latents, debug_weights, tmp_path
):
    train(*STAGE, data=latents, validation=None, out=tmp_path / "run", weights=debug_weights)
    expected = losses(tmp_path / "run")
    assert len(expected) == STEPS
    assert losses(trained) == expected


@pytest.mark.slow
def test_the_weights_come_back_in_parts_that_a_generator_loads(trained, tmp_path, capsys):
    assert main(["join", str(trained / "weights"), "--out", str(tmp_path / "w")]) == 0
    names = {Path(line).name for line in capsys.readouterr().out.split()}
    assert names == {f"{name}.safetensors" for name in ("dit", "vae", "text", "image")}
    Generator.load(MODEL, tmp_path / "w")
    assert max(path.stat().st_size for path in trained.rglob("*.0*")) <= 16 << 20


@pytest.mark.slow
def test_pieces_on_a_bare_machine_repeat_the_whole_run(written, trained, tmp_path):
    out = tmp_path / "run"
    command = [sys.executable, "-c", BARE, "train", "--out", str(out), "--minutes", "0"]
    variables = {**os.environ, "XLA_FLAGS": QUICK, "PYTHONPATH": ""}
    for piece in range(1, STEPS + 1):
        done = subprocess.run(command, cwd=written, env=variables, capture_output=True, text=True)
        expected = ExitCode.DONE if piece == STEPS else ExitCode.RESUBMIT
        assert done.returncode == expected, done.stderr
        assert Path(done.stdout.strip()) == written / "egosim_jax" / "__init__.py"
    assert losses(out) == losses(trained)
    for path in (*trained.glob("checkpoint/*"), *trained.glob("weights/*")):
        assert (out / path.relative_to(trained)).read_bytes() == path.read_bytes()


@pytest.mark.slow
def test_a_kill_between_checkpoint_and_weights_loses_neither(
    written, trained, tmp_path, monkeypatch
):
    out, cut, folders = tmp_path / "run", parts.cut, []

    def killed(files, folder):
        if folders:
            raise KeyboardInterrupt
        folders.append(folder)
        cut(files, folder)

    monkeypatch.setattr(parts, "cut", killed)
    command = ["train", "--bundle", str(written), "--out", str(out)]
    assert main(command) != ExitCode.DONE
    monkeypatch.setattr(parts, "cut", cut)
    assert main(command) == ExitCode.DONE
    for path in trained.glob("weights/*"):
        assert (out / "weights" / path.name).read_bytes() == path.read_bytes()


def test_a_wider_model_on_a_gpu_starts_from_random_weights(written):
    recipe = BundleRecipe.read(written, "gpu", steps=7)
    assert recipe.weights is None
    assert recipe.task.model.dit.dim == bundle_writer.WIDER["model"]["dit"]["dim"]
    assert recipe.training.steps == 7
    assert recipe.training.optimizer.name == "muon"  # as in the stage
    assert recipe.task.change_loss_weight == 2.0
    same = BundleRecipe.read(written, "cpu")
    assert (same.task, same.training) == STAGE


def test_each_epoch_has_every_record_once_in_another_order(written, monkeypatch, tmp_path):
    data = Latents(written, "train")
    monkeypatch.setattr(data, "arrays", {"record": np.arange(len(data))})
    batches = [data.batch(number, size=2, seed=3)["record"] for number in range(10)]
    epochs = np.concatenate(batches).reshape(4, 5)
    assert (np.sort(epochs) == np.arange(5)).all()
    assert len({tuple(epoch) for epoch in epochs}) > 1
    np.testing.assert_array_equal(data.batch(4, size=2, seed=3)["record"], batches[4])


def test_records_are_split_into_shards_of_limited_size(
    latents, debug_weights, tmp_path, monkeypatch
):
    record = sum(array.nbytes for array in ShardReader(latents)[0].arrays.values())
    monkeypatch.setattr(bundle_writer, "SHARD_BYTES", bundle_writer.HEADER_BYTES + record)
    data = {"train": latents, "test": latents}
    write_bundle(tmp_path / "b", STAGE, latents=data, weights=debug_weights, dtype="float16")
    shards = sorted(path.name for path in (tmp_path / "b" / LATENTS).glob("train-*"))
    assert len(shards) > 2
    assert len(Latents(tmp_path / "b", "train")) == 5


def test_a_damaged_shard_is_refused(written, tmp_path):
    shard = written / LATENTS / "test-000.npz"
    data = shard.read_bytes()
    try:
        shard.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
        with pytest.raises(InputError, match=r"test-000\.npz is damaged"):
            Latents(written, "test")
    finally:
        shard.write_bytes(data)


def test_every_file_has_its_hash_and_no_code_is_missing(written):
    hashes = json.loads((written / FILES).read_text())["sha256"]
    files = {str(p.relative_to(written)) for p in written.rglob("*") if p.is_file()} - {FILES}
    assert hashes.keys() == files
    assert {"egosim_jax/train/bundle.py", "recipe.json", "weights/dit.safetensors"} <= files


@pytest.mark.slow
def test_a_recipe_writes_its_clips_and_weights_into_a_bundle(debug_weights, tmp_path):
    out = tmp_path / "b"
    recipe = replace(
        TABLETOP,
        config="debug",
        denoiser=STAGE.training,
        scenes=2,
        held_out=1,
        weights=debug_weights,
        bundle=out,
    )
    assert recipe.train() == ExitCode.DONE
    assert [len(Latents(out, split)) for split in ("train", "test")] == [4, 1]
    written = BundleRecipe.read(out, "cpu")
    assert (written.task, written.training) == recipe.stages()["denoiser"]
    assert written.weights == out / "weights"
    assert (tmp_path / "b_data" / "latents").is_dir()


def test_an_existing_bundle_is_refused_before_any_work(written, capsys):
    from egosim_jax.train.__main__ import main as train_main

    assert train_main(["tabletop", "--bundle", str(written)]) == ExitCode.USAGE
    assert "written to a new folder. (--bundle)" in capsys.readouterr().err
