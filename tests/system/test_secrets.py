"""Commands write and say no token or password of the environment, and listen nowhere."""

import os
import subprocess
import sys

import pytest

from tests.system.test_sockets import LOOPBACK, seen_while

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
def test_a_command_reveals_no_secret_and_listens_nowhere(name, tmp_path):
    said = tmp_path / "said"
    with said.open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", *COMMANDS[name], "--out", str(tmp_path / "run")],
            env={**os.environ, **SECRETS},
            stdout=log,
            stderr=log,
        )
        found = seen_while([process])
    assert found <= (LOOPBACK if name == "train" else set())
    files = [path for path in (tmp_path / "run").rglob("*") if path.is_file()]
    assert any(path.name == "environment.json" for path in files)
    written = [said.read_bytes(), *(path.read_bytes() for path in files)]
    for secret in SECRETS.values():
        assert not any(secret.encode() in data for data in written)
