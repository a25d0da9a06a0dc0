"""Storage of the results of a stage."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.annotate import record as records
from egosim_jax.annotate.clip import Job, open_record
from egosim_jax.annotate.sources import find_sources, open_source
from egosim_jax.perception.video.estimates import SparsePoints
from egosim_jax.types import InputError
from tests.unit.annotate.stubs import StubCameras, StubHands, config, textured_video, write


@pytest.fixture
def record(tmp_path):
    path = write(tmp_path / "a.mp4", textured_video(9))
    open_source(find_sources([path])[0]).save(tmp_path / "recording")
    job = Job(
        video_id="a", recording=str(tmp_path / "recording"), start=0, stop=9, figures={"black": 0.0}
    )
    return open_record(job, config())


def test_stored_results_are_read_back_exactly(record, tmp_path):
    moving = np.zeros((9, 48, 80), bool)
    estimate = StubCameras(False, None)(record.frames, moving)
    points = SparsePoints(
        points_m=np.ones((2, 3)),
        error_px=np.array([0.5, 0.6]),
        frames=np.array([0, 1], np.int32),
        indices=np.array([0, 1], np.int32),
        pixels_px=np.full((2, 2), 3.0),
    )
    ids = np.zeros((9, 48, 80), np.int32)
    ids[2:5, 10:20, 30:50] = -1
    ids[4, 12, 33:40] = 7
    full = record.add(
        "cameras", {"rung": "static"},
        hands=StubHands(0.5, None)(record.frames), estimate=replace(estimate, points=points),
        object_ids=ids, names={7: "cup"},
    )  # fmt: skip
    fields = ("hands", "estimate", "object_ids", "names")
    records.save(tmp_path / "a.npz", full, fields, "cameras")
    found = records.load(tmp_path / "a.npz", record, fields, "cameras")
    assert found.notes == {"cameras": {"rung": "static"}}
    assert found.names == {7: "cup"}
    assert found.object_ids.dtype == np.int32
    assert np.array_equal(found.object_ids, ids)
    assert np.array_equal(found.hands.joints_px, full.hands.joints_px, equal_nan=True)
    assert found.estimate.verdict == estimate.verdict
    assert found.estimate.cameras.width == 80
    assert np.array_equal(found.estimate.points.pixels_px, points.pixels_px)
    assert found.estimate.lens is None


def test_damaged_results_are_refused(record, tmp_path):
    path = tmp_path / "a.npz"
    records.save(path, record.add("hands", {}, names={1: "cup"}), ("names",), "hands")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="is damaged"):
        records.load(path, record, ("names",), "hands")


def test_a_missing_field_is_named(record):
    with pytest.raises(InputError, match="object_ids is missing"):
        _ = record.moving
