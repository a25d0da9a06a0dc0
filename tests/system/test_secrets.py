"""Commands write and say no token or password of the environment, and listen nowhere."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.system.test_sockets import seen_while

SECRETS = {
    "WANDB_API_KEY": "5ecre7-wandb",
    "HF_TOKEN": "hf_5ecre7",
    "AWS_SECRET_ACCESS_KEY": "5ecre7-aws",
    "HTTPS_PROXY": "http://user:5ecre7-proxy@localhost:9",
}
COMMANDS = {
    "generate": ["egosim_jax.cli", "generate", "--config", "debug"],
    "simulate": ["egosim_jax.cli", "simulate", "--clips", "1"],
}
"""`tests/training/test_from_scratch.py` has a training."""


def reveals_nothing(command: Sequence[str], out: Path, **environment: str) -> set[str]:
    """Run a command that writes to OUT; return where it listened."""
    said = out.with_name("said")
    with said.open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", *command, "--out", str(out)],
            env={**os.environ, **SECRETS, **environment},
            stdout=log,
            stderr=log,
        )
        found = seen_while([process])
    files = [path for path in out.rglob("*") if path.is_file()]
    assert any(path.name == "environment.json" for path in files)
    written = [said.read_bytes(), *(path.read_bytes() for path in files)]
    for secret in SECRETS.values():
        assert not any(secret.encode() in data for data in written)
    return found


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_reveals_no_secret_and_listens_nowhere(name, tmp_path):
    assert reveals_nothing(COMMANDS[name], tmp_path / "run") == set()
