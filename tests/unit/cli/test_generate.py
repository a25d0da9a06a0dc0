"""`egosim generate`: invalid input is refused before compilation."""

from dataclasses import replace

import numpy as np
import pytest
from safetensors.numpy import save_file

from egosim_jax import configs
from egosim_jax.cli.__main__ import main
from egosim_jax.cli.generate import Generate
from egosim_jax.data.clips import write_clips
from egosim_jax.diffusion import Guidance, Progressive, Renoise
from egosim_jax.generation.batch import BatchJob
from egosim_jax.runtime.command import ExitCode
from egosim_jax.types import InputError, VideoSpec
from egosim_jax.worlds.tabletop import make_sequence, to_triplet


def test_a_lora_of_other_weights_is_refused(debug_weights, tmp_path, capsys):
    adapter = tmp_path / "lora.safetensors"
    save_file({"a": np.zeros(3, np.float32)}, adapter, metadata={"base_sha256": "5" * 64})
    options = ["--weights", str(debug_weights), "--lora", str(adapter)]
    code = main(["generate", "--config", "debug", "--out", str(tmp_path / "out"), *options])
    assert code == ExitCode.USAGE
    assert "was trained on other weights" in capsys.readouterr().err


def test_a_lora_of_weights_in_8_bits_is_refused(debug_weights, tmp_path, capsys):
    narrow = tmp_path / "int8"
    quantize = ["quantize", str(debug_weights), "--out", str(narrow), "--kind", "int8"]
    assert main(["convert", *quantize]) == ExitCode.DONE
    options = ["--weights", str(narrow), "--lora", str(tmp_path / "lora.safetensors")]
    code = main(["generate", "--config", "debug", "--out", str(tmp_path / "out"), *options])
    assert code == ExitCode.USAGE
    said = " ".join(capsys.readouterr().err.split())
    assert "take no LoRA" in said
    assert "egosim convert lora --merge" in said


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--lora-scale", "0.5"], "(--lora)"),
        (["--metadata", "a.csv", "--robot"], "(--robot, --metadata)"),
        (["--solver", "eulr"], "(--solver)"),
        (["--activations-8bit"], "(--weights)"),
    ],
)
def test_options_that_cannot_be_are_refused(tmp_path, capsys, options, named):
    command = ["generate", "--config", "debug", "--out", str(tmp_path / "out"), *options]
    assert main(command) == ExitCode.USAGE
    assert named in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_a_job_is_of_all_files_of_its_lora(debug_weights, tmp_path):
    (tmp_path / "lora").mkdir()
    files = [tmp_path / "lora" / f"{stem}.safetensors" for stem in ("lora", "non_lora_weights")]
    for file in files:
        save_file({"a": np.zeros(3, np.float32)}, file)
    job = BatchJob(
        model=configs.get("debug"), out=tmp_path / "out", weights=debug_weights,
        lora=tmp_path / "lora",
    )  # fmt: skip
    job.open()
    job.open()
    save_file({"a": np.ones(3, np.float32)}, files[1])
    with pytest.raises(InputError, match="lora"):
        job.open()


@pytest.fixture(scope="module")
def clip():
    return to_triplet(next(make_sequence(0, spec=VideoSpec(frames=9, height=64, width=96))))


@pytest.mark.parametrize("other", ["x_cmp", "x_vae"])
def test_two_clips_that_would_write_one_file_are_refused(clip, other, tmp_path, capsys):
    clips = [replace(clip, video_id=name) for name in ("x", other)]
    metadata = write_clips(tmp_path / "clips", clips, fps=8)
    args = ["--config", "debug", "--metadata", str(metadata), "--out", str(tmp_path / "out")]
    assert main(["generate", *args]) == ExitCode.USAGE
    assert f"The clips x and {other} would both write {other}.mp4" in capsys.readouterr().err
    assert not list((tmp_path / "out").glob("*.mp4"))


@pytest.mark.parametrize(
    ("args", "name"),
    [
        (["generate", "--config", "debug", "--start"], "start"),
        (["generate", "--start", "--config", "debug"], "start"),
        (["data", "mix", "--out", "x", "--shards"], "shards"),
        (["evaluate", "--metadata", "x.csv", "--generated"], "generated"),
        (["evaluate", "--metadata", "x.csv", "--generated", "x", "--lpips"], "lpips"),
    ],
)
def test_an_option_without_its_values_is_refused(args, name, capsys):
    try:
        code = main(args)
    except SystemExit as error:  # tyro's own error
        code = error.code
    assert code == ExitCode.USAGE
    assert name in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "recognized"),
    [
        ("wan2.1_i2v_lora_rank64_lightx2v_4step.safetensors", True),
        ("Wan21_I2V_14B_lightx2v_cfg_step_distill_lora_rank64.safetensors", True),
        ("lightx2v_I2V_14B_480p_cfg_step_distill_rank16_bf16.safetensors", True),
        ("wan2.2_i2v_lightx2v_4steps_lora_v1_high_noise.safetensors", False),
        ("my_kitchen_lora.safetensors", False),
    ],
)
def test_a_step_distilled_lora_brings_its_sampler(name, recognized, tmp_path, capsys):
    plain = configs.get("egosim_14b")
    (tmp_path / "dit.safetensors").touch()
    command = Generate(config="egosim_14b", weights=tmp_path, lora=tmp_path / name)
    model = command._model()
    shift = replace(plain.process, shift=5.0)
    sampler = (4, Renoise(), Guidance(), shift)
    usual = (plain.steps, plain.solver, plain.guidance, plain.process)
    got = (model.steps, model.solver, model.guidance, model.process)
    assert got == (sampler if recognized else usual)
    assert ("is distilled: 4 steps" in capsys.readouterr().err) == recognized
    assert replace(command, steps=8)._model().steps == 8


def test_a_share_of_the_steps_is_asked_for_on_half_the_grid(tmp_path):
    (tmp_path / "dit.safetensors").touch()
    plain = configs.get("egosim_14b").at(tmp_path)
    command = Generate(config="egosim_14b", weights=tmp_path, progressive=0.66)
    assert command._model() == replace(plain, progressive=Progressive(share=0.66))
    assert replace(command, progressive=None)._model() == plain


@pytest.mark.parametrize(
    ("config", "options", "message"),
    [
        ("egosim_14b_student", {}, "chunk by chunk, which supports only progressive None"),
        ("dwm_cogvideox_5b", {}, "CogVideoXDiTConfig does not run on half its grid"),
        ("egosim_14b", {"solver": "renoise"}, "Renoise adds noise"),
        ("egosim_14b", {"steps": 1}, "each of the two grids needs at least one step"),
    ],
)
def test_models_without_steps_on_half_the_grid_refuse_them(config, options, message, tmp_path):
    (tmp_path / "dit.safetensors").touch()
    command = Generate(config=config, weights=tmp_path, progressive=0.5, **options)
    with pytest.raises(InputError, match=message):
        command._model()
