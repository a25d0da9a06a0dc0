"""metrics.jsonl of resumed runs."""

import pytest

from egosim_jax.train.metric_writers import JsonLines, WandB


@pytest.mark.parametrize(("resume_after", "kept"), [(0, 0), (5, 2)])
def test_a_run_repeats_no_line(tmp_path, resume_after, kept):
    path = tmp_path / "metrics.jsonl"
    writer = JsonLines(path)
    for step in (0, 5, 10):
        writer.write(step, {"loss": 1.0})
    JsonLines(path, resume_after=resume_after)
    assert len(path.read_text().splitlines()) == kept


def test_wandb_writes_in_a_folder_without_settings(tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    writer = WandB(tmp_path, project="clips", name="a")
    writer.write(1, {"loss": 1.0})
    writer.close()
    (run,) = (tmp_path / "wandb").glob("offline-run-*/run-*.wandb")
    assert b"loss" in run.read_bytes()
