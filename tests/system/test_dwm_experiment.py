"""`egosim experiment dwm` from clips to its report, and again for the missing parts."""

import json
from dataclasses import replace

import pytest
from flax import nnx

from egosim_jax import configs
from egosim_jax.cli.__main__ import main
from egosim_jax.configs.model import Networks
from egosim_jax.experiments.scenes import HeldOutClip
from egosim_jax.io import weights
from tests.parity.cogvideox_configs.dwm_tiny import CONFIG as TINY

pytestmark = pytest.mark.slow
STAGES = ("autoencoder", "base", "adaptation")


@pytest.fixture
def run(monkeypatch, tmp_path):
    """Run the experiment on a tiny config, one update a training, from a random autoencoder."""
    config = replace(TINY, encoders="joint")
    monkeypatch.setattr(configs, "get", lambda name: config)
    counts = "--moving-scenes 2 --fixed-scenes 1 --held-out 2 --batch-size 2 --seeds 1 --rank 2"
    trainings = " ".join(f"--{stage}.steps 1 --{stage}.batch-size 2" for stage in STAGES)
    out = tmp_path / "run"

    def command():
        given = f"experiment dwm --steps 2 {counts} {trainings} --only no_hands --out {out}"
        assert main(given.split()) == 0
        return out, json.loads((out / "report.json").read_text())

    weights.save(out / "autoencoder/weights/vae.safetensors", config.vae.build(rngs=nnx.Rngs(0)))
    return command


@pytest.mark.usefixtures("without_lpips")
def test_it_trains_compares_and_repeats_no_work(run):
    out, report = run()
    rows = {
        "full", "no_hands", "sdedit", "hands_dropped", "autoencoder", "prior copied",
        "first frame repeated",
    }  # fmt: skip
    for camera in ("moving", "fixed"):
        assert report["tables"][camera].keys() == rows
        assert report["differences"][camera].keys() == rows - {"full"}
        psnr = report["tables"][camera]["full"]["psnr"]["mean"]
        copied = report["tables"][camera]["prior copied"]["psnr"]["mean"]
        gain = report["differences"][camera]["prior copied"]["psnr"]
        assert gain["low"] <= gain["mean"] <= gain["high"]
        assert gain["mean"] == pytest.approx(psnr - copied, abs=1e-6)
        assert (out / f"contact_sheet_{camera}.png").stat().st_size > 1000
    made = [
        path
        for pattern in ("*/lora.safetensors", "*/weights/*", "generated/*.npy")
        for path in out.glob(pattern)
    ]
    kept = {path: path.stat().st_mtime_ns for path in made}
    sheet = out / "contact_sheet_fixed.png"
    sheet.unlink()
    _, again = run()
    assert again == report
    assert sheet.exists()
    assert {path: path.stat().st_mtime_ns for path in made} == kept


def test_the_other_experiments_give_a_model_of_dwm_its_conditions_or_refuse_it(
    monkeypatch, tmp_path, capsys
):
    monkeypatch.setattr(configs, "get", lambda name: replace(TINY, encoders="joint"))
    Networks.random(configs.get("dwm_tabletop"), seed=0).save(tmp_path / "weights")
    model = f"--config dwm_tabletop --weights {tmp_path / 'weights'} --out {tmp_path}"
    assert main(f"experiment tabletop --scenes 1 --seeds 1 --steps 2 {model}/run".split()) == 0
    tables = json.loads((tmp_path / "run/report.json").read_text())["tables"]
    assert tables.keys() == {"human"}  # a gripper has no mesh
    twin = HeldOutClip.make(100, TINY, conditions=("static", "mesh"))
    copied = twin.evaluate(twin.triplet.prior)["psnr"]
    assert tables["human"]["prior copied"]["psnr"]["mean"] == pytest.approx(copied)
    for command, reason in (
        ("simulate --clips 1", "a video of the whole scene"),
        ("experiment embodiment", "robots do not have"),
    ):
        assert main(f"{command} {model}/refused".split()) == 2
        assert reason in capsys.readouterr().err
