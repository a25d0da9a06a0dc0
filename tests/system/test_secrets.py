"""No token or password of the environment gets into anything that is written or said."""

import os
import subprocess
import sys

import pytest

SECRETS = {
    "WANDB_API_KEY": "5ecre7-wandb",
    "HF_TOKEN": "hf_5ecre7",
    "AWS_SECRET_ACCESS_KEY": "5ecre7-aws",
    "HTTPS_PROXY": "http://user:5ecre7-proxy@localhost:9",
}
COMMANDS = {
    "train": ["egosim_jax.train", "debug", "--clips", "4", "--vae.steps", "1",
              "--denoiser.steps", "1"],
    "generate": ["egosim_jax.cli", "generate", "--config", "debug"],
    "simulate": ["egosim_jax.cli", "simulate", "--clips", "1"],
}  # fmt: skip


@pytest.mark.parametrize("name", COMMANDS)
def test_nothing_that_is_written_holds_a_secret(name, tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", *COMMANDS[name], "--out", str(tmp_path / "run")],
        env={**os.environ, **SECRETS},
        capture_output=True,
    )
    assert done.returncode == 0, done.stderr.decode()
    files = [path for path in (tmp_path / "run").rglob("*") if path.is_file()]
    assert any(path.name == "environment.json" for path in files)
    written = [done.stdout, done.stderr, *(path.read_bytes() for path in files)]
    for secret in SECRETS.values():
        assert not any(secret.encode() in data for data in written)
