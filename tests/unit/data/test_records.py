"""Arrays of records keep their order; other bytes are refused (`tests/properties/test_data.py`)."""

import json

import numpy as np
import pytest
import safetensors.numpy

from egosim_jax.data.records import Record, RecordError, from_bytes, to_bytes


def test_a_transposed_array_keeps_its_order():
    array = np.arange(6, dtype=np.int32).reshape(2, 3).T
    back = from_bytes(to_bytes(Record(arrays={"x": array}, metadata={})))
    np.testing.assert_array_equal(back.arrays["x"], array)


@pytest.mark.parametrize(
    "data", [b"", b"short", bytes(64), to_bytes(Record(arrays={}, metadata={}))[:-1]]
)
def test_bytes_that_are_no_record_are_refused(data):
    with pytest.raises(RecordError, match="is not a valid record"):
        from_bytes(data)


@pytest.mark.parametrize(
    "metadata", [[], {"video_id": 3}, {"extra": []}, {"extra": {"a": 1}}, {"prompt": None}]
)
def test_a_record_of_wrong_types_is_refused(metadata):
    header = {"json": json.dumps(metadata)}
    data = safetensors.numpy.save({"x": np.zeros(2, np.float32)}, metadata=header)
    with pytest.raises(RecordError, match="is not a valid record"):
        from_bytes(data)
