"""Interrupted runs continue as if nothing had happened.

`python -m tests.endurance` does the same twenty times.
"""

import pytest

from egosim_jax.testing import write_latents
from tests.training.killing import Run
from tests.training.run_tiny import TASKS

STEPS, SAVE_EVERY = 14, 4


@pytest.mark.parametrize("task", ["egosim", pytest.param("dwm", marks=pytest.mark.slow)])
def test_a_killed_run_repeats_losses_and_weights_bit_for_bit(task, tmp_path):
    write_latents(tmp_path / "latents", TASKS[task].model)
    whole, killed = (
        Run(tmp_path / "latents", tmp_path / name, steps=STEPS, save_every=SAVE_EVERY, task=task)
        for name in ("whole", "killed")
    )
    whole.finish()
    assert killed.kill_when(lambda: len(killed.lines()) >= SAVE_EVERY + 2)
    killed.finish()
    assert killed.lines() == whole.lines()
    assert [line["step"] for line in killed.lines()] == list(range(1, STEPS + 1))
    weights = [(run.out / "dit.safetensors").read_bytes() for run in (killed, whole)]
    assert weights[0] == weights[1]
