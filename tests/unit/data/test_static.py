"""EgoSim's conditions are refused where a DWM model would accept them as its own."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax import configs
from egosim_jax.data.clips import write_clips
from egosim_jax.data.dwm import write_folders
from egosim_jax.data.metadata import read_metadata
from egosim_jax.data.pack import triplet_record
from egosim_jax.data.shards import ShardReader, ShardWriter
from egosim_jax.data.static import check_observed
from egosim_jax.data.windows import windows_of
from egosim_jax.generation.batch import BatchJob
from egosim_jax.testing import random_triplet
from egosim_jax.train.encode import encode_shards
from egosim_jax.types import InputError

MODEL = configs.get("dwm_tabletop")


@pytest.fixture(scope="module")
def holes():
    triplet = random_triplet(MODEL.video)
    return replace(triplet, target=triplet.prior)


def shards(folder, triplet, **conditions):
    with ShardWriter(
        folder, kind="frames", spec=MODEL.video, grid=MODEL.grid, provenance=conditions
    ) as writer:
        record = triplet_record(triplet)
        writer.add(record.arrays, record.metadata)
    return ShardReader(folder)


@pytest.mark.parametrize(
    ("prior", "hands", "refused"),
    [
        ("state", "mesh", True),
        ("static", "skeleton", True),
        ("static", "mask", False),
        ("static", "mesh", False),
    ],
)
def test_shards_of_states_and_skeletons_are_not_encoded(prior, hands, refused, holes, tmp_path):
    source = shards(tmp_path / "shards", holes, prior=prior, hands=hands)
    fixed = {"out": tmp_path / "out", "stride": 1, "batch_size": 1}
    # The others fail later: there are no weights.
    message = f"prior {prior} and hands {hands}" if refused else "No weights file"
    with pytest.raises(InputError, match=message):
        encode_shards(MODEL, tmp_path, source=source, **fixed)
    assert (tmp_path / "out").exists() != refused


def test_pinholes_are_no_holes():
    mask = np.zeros((10, 10, 10), np.uint8)
    mask[0, 0] = 255
    check_observed(mask)
    mask[0, 1, 0] = 255
    with pytest.raises(InputError, match=r"says that 1\.1% of the pixels"):
        check_observed(mask)


def test_a_mask_with_holes_is_not_dropped_from_folders(holes, tmp_path):
    with pytest.raises(InputError, match=r"clip_0: The mask says that \d+\.\d% of the pixels"):
        write_folders(tmp_path, [holes], name="x", fps=8)
    assert not list(tmp_path.rglob("*.mp4"))


def test_a_clip_with_holes_is_not_generated(holes, tmp_path, capsys):
    windows = windows_of(read_metadata(write_clips(tmp_path / "clips", [holes], fps=8)), (0,))
    job = BatchJob(model=MODEL, out=tmp_path / "out", weights=None)
    job.open()
    loaded, ((_, problem),) = job._load(windows)
    assert loaded == []
    assert "of the pixels were not observed" in problem
