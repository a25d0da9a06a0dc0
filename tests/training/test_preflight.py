"""Preflights on this machine's CPU, whose memory can be measured."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from jax.sharding import AbstractMesh

from egosim_jax.cli.__main__ import main as egosim
from egosim_jax.preflight import targets
from egosim_jax.train import preflight as module
from egosim_jax.train import recipes
from egosim_jax.train.__main__ import main as egosim_train
from egosim_jax.train.preflight import Setting
from tests.flags import devices

pytestmark = pytest.mark.slow
SCRIPT = Path(__file__).parent / "run_memory.py"


def test_the_memory_of_an_update_is_predicted():
    """Within 15 %: the libraries' own buffers are not XLA's."""
    program = [sys.executable, "-m", "tests.training.run_memory"]
    ran = subprocess.run(
        program,
        env={**os.environ, **devices(1)},
        cwd=SCRIPT.parents[2],
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    found = json.loads(ran.stdout)
    assert found["measured"] == pytest.approx(found["predicted"], rel=0.15)


@pytest.fixture
def small(monkeypatch):
    """This machine with 1 MB of memory."""
    machine = targets._this_processor()
    monkeypatch.setattr(targets, "_this_processor", lambda: replace(machine, memory=1e6))


def test_a_recipe_is_compiled_without_any_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert egosim_train(["debug", "--preflight", "cpu:1"]) == 0
    printed = capsys.readouterr().out
    assert "vae on cpu:1, 1 x cpu: batch 2" in printed
    assert "denoiser on cpu:1, 1 x cpu: batch 2" in printed
    assert printed.count("rows of the batch by host, 1 devices each\n    0  0, 1\n") == 2
    assert printed.count(": fits") == 2
    assert printed.count("\n  a host          1 devices, ") == 2
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("small")
def test_json_has_the_memory_and_what_does_not_fit_ends_with_1(capsys):
    assert egosim_train(["debug", "--preflight", "cpu:1", "--json"]) == 1
    printed = json.loads(capsys.readouterr().out)["denoiser"]
    assert printed["hosts"] == [{"host": 0, "devices": 1, "rows": [0, 1]}]
    report = printed["asked"]
    assert not report["fits"]
    assert report["peak"] == sum(report["memory"].values()) > report["capacity"] == 1e6
    assert report["hardware_flops"] > report["model_flops"] > 0


@pytest.mark.parametrize(
    ("args", "said"),
    [
        ("debug --preflight h20:8", "Nearest device: h200"),
        ("debug --preflight cpu:1 --vae.batch-size 3 --vae.grad-accum-steps 2", "3"),
        ("debug --preflight cpu:1 --vae.mesh.fsdp 2", "does not fit 1 devices"),
        ("egosim_14b --out runs/a", "Missing --latents, --weights: required to train."),
        ("tabletop", "Missing --out: required to train."),
        ("real_tiny", "Missing --out, --metadata: required to train."),
        ("debug --json", "--json has no effect without --preflight"),
        ("debug --no-search", "--no-search has no effect without --preflight"),
    ],
)
def test_what_cannot_be_compiled_or_trained_is_refused(args, said, capsys):
    assert egosim_train(args.split()) == 2
    assert said in capsys.readouterr().err


@pytest.fixture(scope="module")
def compiled():
    """A stage with a batch of 8, this processor, and the report of the compiled update."""
    stage, target = recipes.DEBUG.stages()["denoiser"], targets.find("cpu:1")
    stage = stage._replace(training=replace(stage.training, batch_size=8))
    return stage, target, module.compile_step(stage, target)


@pytest.fixture
def room(compiled, monkeypatch):
    """Compile nothing: the test says which settings fit, and gets the tried ones."""
    stage, target, measured = compiled

    def look(fits):
        tried = []

        def report(setting):
            needed = replace(measured.memory, temporaries=0 if setting in fits else 10**12)
            seconds = {"offload": 4.5, "full": 4.0, "attention": 3.5}.get(setting.remat, 3.0)
            seconds += 0.2 / setting.clips
            return replace(measured, memory=needed, roofline_s=seconds)

        def compile_step(stage, target):
            tried.append(module._setting(stage, target))
            return report(tried[-1])

        monkeypatch.setattr(module, "compile_step", compile_step)
        asked = module._setting(stage, target)
        return list(module._others(stage, target, report(asked))), tried

    return look


def test_settings_that_fit_are_found_and_what_needs_more_is_not_tried(room):
    """A batch of 8 on one device, with room for 2 clips, or for 1 with attention's output."""
    fits = [
        Setting(clips=1, remat="attention"),
        Setting(clips=2, remat="full"),
        Setting(clips=1, remat="full"),
        Setting(clips=2, remat="offload"),
        Setting(clips=1, remat="offload"),
    ]
    found, tried = room(fits)
    assert found == fits
    assert [(setting.clips, setting.remat) for setting in tried] == [
        (1, "offload"),
        (1, "full"),
        (1, "attention"),
        (1, "projections"),
        (2, "offload"),
        (2, "full"),
        (2, "attention"),
        (4, "offload"),
    ]


def test_where_nothing_fits_more_devices_share_a_clip(room, monkeypatch):
    """Four devices take a batch of 8 in two parts of four clips, and two devices share a part."""

    def mesh_of_four(config, _):
        fsdp = 4 // config.context if config.fsdp == -1 else config.fsdp
        return AbstractMesh((config.data, fsdp, config.context), ("data", "fsdp", "context"))

    monkeypatch.setattr(module, "make_mesh", mesh_of_four)
    found, tried = room([Setting(clips=1, remat="offload", context=2)])
    assert found == [Setting(clips=1, remat="offload", context=2)]
    assert [(s.clips, s.remat, s.context) for s in tried] == [
        (1, "offload", 1),
        (1, "offload", 2),
        (1, "full", 2),
        (2, "offload", 2),
    ]


def test_generation_is_compiled_program_by_program(capsys):
    assert egosim(["preflight", "--config", "debug", "--target", "cpu:1", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert list(report) == ["encode", "denoise", "decode"]
    weights = min(program["memory"]["arguments"] for program in report.values())
    for program in report.values():
        assert program["fits"]
        assert weights <= program["memory"]["arguments"] < 2 * weights
        assert program["hardware_flops"] > 0


def test_options_that_save_passes_save_flops(capsys):
    """Guided: two passes a step, of 4 steps; half the grid has a quarter of the tokens."""
    flops = {}
    for options in ("", "--computed 0.5", "--progressive 0.5"):
        command = "preflight --config debug --target cpu:1 --json --guidance 2"
        assert egosim([*command.split(), *options.split()]) == 0
        flops[options] = json.loads(capsys.readouterr().out)["denoise"]["hardware_flops"]
    plain = flops[""]
    assert plain / 2 < flops["--computed 0.5"] < 0.6 * plain
    assert plain / 2 < flops["--progressive 0.5"] < 0.75 * plain


@pytest.mark.parametrize(
    ("options", "message"),
    [("--computed 1.5", "no share of computed steps"), ("--progressive 1", "--progressive")],
)
def test_shares_of_steps_out_of_range_are_refused(options, message, capsys):
    command = f"preflight --config debug --target cpu:1 {options}"
    assert egosim(command.split()) == 2
    assert message in capsys.readouterr().err


@pytest.mark.usefixtures("small")
def test_a_generation_that_does_not_fit_ends_with_1(capsys):
    assert egosim(["preflight", "--config", "debug", "--target", "cpu:1"]) == 1
    assert "does not fit" in capsys.readouterr().out
