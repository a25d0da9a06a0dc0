"""What `egosim generate` refuses before it compiles anything."""

import numpy as np
from safetensors.numpy import save_file

from egosim_jax import configs
from egosim_jax.cli.__main__ import main
from egosim_jax.command import USAGE
from egosim_jax.generator import Networks


def test_a_lora_of_other_weights_is_refused(tmp_path, capsys):
    Networks.random(configs.get("debug"), seed=0).save(tmp_path / "weights")
    adapter = tmp_path / "lora.safetensors"
    save_file({"a": np.zeros(3, np.float32)}, adapter, metadata={"base_sha256": "5" * 64})
    options = ["--weights", str(tmp_path / "weights"), "--lora", str(adapter)]
    code = main(["generate", "--config", "debug", "--out", str(tmp_path / "out"), *options])
    assert code == USAGE
    assert "was trained on other weights" in capsys.readouterr().err
