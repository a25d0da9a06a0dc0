"""Clean inputs are read as before: recordings of every reader, clips, episodes and weights.

Protected is what a user brings without a fault: a constant frame rate, square pixels, upright
images, complete tables. Of each input these stay: names, sizes, rates and captions; which frame
of the video is taken for each row; cameras, hands, depth and points in our conventions; weights bit
for bit. What a reader says about its decisions (provenance) is free, and so are messages.

    python -m tests.golden.test_clean_inputs

accepts a change. The tests of the readers make most of the inputs.
"""

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

from tests.golden import clean_clips, clean_episodes, clean_recordings, clean_weights
from tests.golden import fingerprints as fp

GOLDEN = Path(__file__).with_name("clean_inputs.txt")
MODULES = (clean_recordings, clean_clips, clean_episodes, clean_weights)
"""Modules that add their inputs to `fp.INPUTS` when they are imported."""


def fingerprint(name: str, folder: Path) -> list[str]:
    """Make and read an input; return a line for each of its facts."""
    return [fp.line(name, field, value) for field, value in fp.INPUTS[name](folder)]


def parse(lines: list[str]) -> dict[str, Any]:
    """Return the values of lines by their fields."""
    parts = [line.partition(" = ") for line in lines]
    return {field: json.loads(value) for field, _, value in parts}


@pytest.mark.parametrize("name", fp.INPUTS)
def test_a_clean_input_is_read_as_before(name, tmp_path):
    lines = GOLDEN.read_text("utf-8").splitlines()
    golden = parse([line for line in lines if line.startswith(f"{name}: ")])
    found = parse(fingerprint(name, tmp_path))
    assert golden
    assert list(found) == list(golden)
    for field, value in golden.items():
        assert fp.is_same(found[field], value, fp.tolerance_of(field)), (field, found[field], value)


def test_the_golden_file_has_no_other_inputs():
    names = (text.partition(": ")[0] for text in GOLDEN.read_text("utf-8").splitlines())
    assert list(dict.fromkeys(names)) == list(fp.INPUTS)


if __name__ == "__main__":
    written = []
    for name in fp.INPUTS:
        with TemporaryDirectory() as made:
            written += fingerprint(name, Path(made).resolve())
    GOLDEN.write_text("\n".join(written) + "\n", encoding="utf-8")
