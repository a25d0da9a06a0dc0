"""Interrupted runs continue as if nothing had happened."""

import pytest

from egosim_jax.testing import write_latents
from tests.training.killing import Run, logged
from tests.training.run_tiny import TASKS, fit

STEPS, SAVE_EVERY = 8, 3


@pytest.mark.parametrize(
    "task",
    [
        "egosim",
        pytest.param("dwm", marks=pytest.mark.slow),
        pytest.param("student_cd", marks=pytest.mark.slow),
        pytest.param("student_dmd", marks=pytest.mark.slow),
    ],
)
def test_a_killed_run_repeats_losses_and_weights_bit_for_bit(task, tmp_path):
    latents, whole = tmp_path / "latents", tmp_path / "whole"
    write_latents(latents, TASKS[task].model)
    fit(latents, whole, steps=STEPS, save_every=SAVE_EVERY, task=task)
    killed = Run(latents, tmp_path / "killed", steps=STEPS, save_every=SAVE_EVERY, task=task)
    assert killed.kill_when(lambda: len(killed.lines()) >= SAVE_EVERY + 2)
    killed.finish()
    assert killed.lines() == logged(whole)
    assert [line["step"] for line in killed.lines()] == list(range(1, STEPS + 1))
    weights = [(out / "dit.safetensors").read_bytes() for out in (killed.out, whole)]
    assert weights[0] == weights[1]
