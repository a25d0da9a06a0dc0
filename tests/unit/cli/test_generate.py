"""`egosim generate`: input that is refused before anything is compiled."""

from dataclasses import replace

import numpy as np
import pytest
from safetensors.numpy import save_file

from egosim_jax import configs
from egosim_jax.cli.__main__ import main
from egosim_jax.command import ExitCode
from egosim_jax.data.clips import write_clips
from egosim_jax.testing import write_weights
from egosim_jax.types import VideoSpec
from egosim_jax.worlds.tabletop import make_sequence, to_triplet


def test_a_lora_of_other_weights_is_refused(tmp_path, capsys):
    write_weights(tmp_path / "weights", configs.get("debug"))
    adapter = tmp_path / "lora.safetensors"
    save_file({"a": np.zeros(3, np.float32)}, adapter, metadata={"base_sha256": "5" * 64})
    options = ["--weights", str(tmp_path / "weights"), "--lora", str(adapter)]
    code = main(["generate", "--config", "debug", "--out", str(tmp_path / "out"), *options])
    assert code == ExitCode.USAGE
    assert "was trained on other weights" in capsys.readouterr().err


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
