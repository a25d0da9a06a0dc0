"""Files of an evaluation."""

import json

from egosim_jax.evaluation.files import finite


def test_what_could_not_be_measured_is_null_also_in_lists():
    report = {"by_index": {"generated": [{"psnr": {"mean": float("nan"), "spread": 0.5}}]}}
    written = json.dumps(finite(report), allow_nan=False)
    assert json.loads(written)["by_index"]["generated"] == [{"psnr": {"mean": None, "spread": 0.5}}]
