"""Processes with any rows of a batch train as one process does.

`run_rows` runs several meshes in each start of processes. Two records cannot be read.
"""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egosim_jax.configs.model import Networks
from egosim_jax.data.shards import ShardReader
from egosim_jax.io.video import read_video
from egosim_jax.preflight.targets import DEVICES, Target
from egosim_jax.testing import write_latents
from egosim_jax.train import preflight, recipes
from egosim_jax.types import InputError, MeshConfig
from tests.machines import MACHINES
from tests.training import run_tiny
from tests.training.killing import logged
from tests.training.line import write_points
from tests.training.run_rows import SAVE_EVERY, STEPS, Case, launch, run


@pytest.fixture(scope="module")
def points(tmp_path_factory) -> str:
    return str(write_points(tmp_path_factory.mktemp("points"), unreadable=(3, 17)))


@pytest.fixture(scope="module")
def alone(points, tmp_path_factory) -> Path:
    """The run of one process with one device."""
    out = tmp_path_factory.mktemp("alone")
    run(Case("alone", points), out)
    return out / "alone"


def check(out: Path, alone: Path, *, first: int = 1, atol: float = 1e-6) -> None:
    """Compare the run folder OUT with the run of one process, from update `first` on."""
    have, want = (dict(np.load(f"{folder}.npz")) for folder in (out, alone))
    # The first batch is the example that the update is compiled for.
    for name in have.keys() & {"record", "x"}:
        np.testing.assert_array_equal(have[name][1:], want[name][first:])
    np.testing.assert_allclose(have["weights"], want["weights"], rtol=1e-6, atol=atol)
    # Accumulated parts of a batch have other `ids`; the records were compared above. A bad record
    # is counted when it is read ahead, so earlier or later.
    others = ("ids", "skipped_records")
    logs = [
        [{name: line[name] for name in line if name not in others} for line in logged(folder)]
        for folder in (out, alone)
    ]
    if first == 1:
        bad = [
            [line["skipped_records"] for line in logged(folder) if "skipped_records" in line]
            for folder in (out, alone)
        ]
        assert bad[0][-1:] == bad[1][-1:]
    assert [line.keys() for line in logs[0]] == [line.keys() for line in logs[1]]
    for mine, theirs in zip(*logs, strict=True):
        assert mine == pytest.approx(theirs, rel=1e-6)


def interrupted(run: Path, copy: Path) -> None:
    """Copy a run without its last checkpoint."""
    shutil.copytree(run, copy)
    shutil.rmtree(copy / "checkpoints" / str(STEPS))


def test_a_single_process_reads_the_next_record_instead_of_a_bad_one(points, alone):
    batches, source = np.load(f"{alone}.npz"), ShardReader(Path(points))
    assert batches["record"].shape == (1 + STEPS, 8)
    counts = np.bincount(batches["record"][1:].ravel(), minlength=40)
    assert counts[[3, 17]].tolist() == [0, 0]
    assert sorted(counts) == [0, 0, *[1] * 36, 2, 2]
    for record, x in zip(batches["record"].ravel(), batches["x"].reshape(-1, 4), strict=True):
        np.testing.assert_array_equal(source[int(record)].arrays["x"], x)


@pytest.mark.slow
def test_two_processes_with_any_rows_train_as_one_and_resume_its_run(points, alone, tmp_path):
    cases = [
        Case("fsdp", points),
        Case("interleaved", points, order="interleaved", parts=2),
        Case("context", points, (2, 1, 2), order="interleaved"),
        Case("resumed", points, order="interleaved"),
    ]
    interrupted(alone, tmp_path / "resumed")
    launch(tmp_path, cases, processes=2, devices=2)
    for case in cases[:-1]:
        check(tmp_path / case.name, alone)
    check(tmp_path / "resumed", alone, first=SAVE_EVERY + 1)
    interrupted(tmp_path / "interleaved", tmp_path / "back")
    run(Case("back", points), tmp_path)
    check(tmp_path / "back", alone, first=SAVE_EVERY + 1)


def test_the_preflight_prints_the_rows_of_each_host():
    stage = next(iter(recipes.get("egosim_14b").stages().values()))
    stage = stage._replace(training=replace(stage.training, batch_size=16, grad_accum_steps=1))
    target = Target(name="v6e:4x4", device=DEVICES["v6e"], devices=MACHINES["v6e:4x4"])
    hosts = preflight.hosts_of(stage, target)
    assert [host.rows for host in hosts] == [
        (0, 1, 6, 15), (2, 3, 4, 5), (7, 12, 13, 14), (8, 9, 10, 11),
    ]  # fmt: skip
    assert [host.devices for host in hosts] == [4] * 4
    assert preflight._rows(hosts).splitlines() == [
        "  rows of the batch by host, 4 devices each",
        "    0  0, 1, 6, 15",
        "    1  2 to 5",
        "    2  7, 12 to 14",
        "    3  8 to 11",
    ]
    shared = replace(stage.training, mesh=MeshConfig(context=8))
    hosts = preflight.hosts_of(stage._replace(training=shared), target)
    assert preflight._rows(hosts).splitlines()[1:] == ["    0, 1  0 to 7", "    2, 3  8 to 15"]
    refused = replace(stage.training, batch_size=24)
    with pytest.raises(InputError, match="A batch of 24 cannot be shared"):
        preflight.hosts_of(stage._replace(training=refused), target)


@pytest.mark.slow
def test_four_processes_with_any_rows_train_as_one(points, alone, tmp_path):
    cases = [
        Case("fsdp", points, (1, 8, 1)),
        Case("all", points, (2, 2, 2), "interleaved", parts=2),
        Case("data", points, (4, 2, 1), "scattered"),
        Case("context", points, (1, 2, 4), "scattered", parts=2),
        Case("resumed", points, (2, 2, 2), "scattered"),
    ]
    interrupted(alone, tmp_path / "resumed")
    launch(tmp_path, cases, processes=4, devices=2)
    for case in cases[:-1]:
        check(tmp_path / case.name, alone)
    check(tmp_path / "resumed", alone, first=SAVE_EVERY + 1)


@pytest.mark.slow
def test_two_processes_that_share_clips_train_sample_and_generate_as_one(tmp_path):
    data, weights = tmp_path / "latents", tmp_path / "weights"
    write_latents(data, run_tiny.MODEL)
    Networks.random(run_tiny.MODEL, seed=0).save(weights)
    shared = {"data": str(data), "weights": str(weights)}
    run(Case("alone", **shared), tmp_path)
    case = Case("context", mesh=(1, 2, 2), order="interleaved", **shared)
    launch(tmp_path, [case], processes=2, devices=2)
    check(tmp_path / "context", tmp_path / "alone", atol=2 * STEPS * 1e-5)
    clips = [np.load(tmp_path / f"{name}.npz")["clips"] for name in ("context", "alone")]
    assert np.abs(np.subtract(*clips, dtype=int)).max() <= 1
    clips = [
        read_video(tmp_path / name / "samples" / f"step_{STEPS:06d}.mp4").frames
        for name in ("context", "alone")
    ]
    assert np.abs(np.subtract(*clips, dtype=int)).max() <= 2
