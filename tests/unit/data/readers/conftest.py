"""A scene, and a fixture that imports recordings of it."""

import pytest

from egosim_jax.data.importing import import_recordings
from egosim_jax.data.recorded_files import DESCRIPTION
from egosim_jax.data.recording import Recording
from tests.captures import World


@pytest.fixture
def world():
    return World()


@pytest.fixture
def imported(tmp_path):
    """Return a function that imports and returns recordings and problems by id."""

    def run(reader, **options):
        total, outcomes = import_recordings(reader, tmp_path / "out", **options)
        outcomes = list(outcomes)
        assert len(outcomes) == total
        problems = {o.recording_id: o.problem for o in outcomes if o.problem}
        folders = [path for path in (tmp_path / "out").iterdir() if path.is_dir()]
        assert all((path / DESCRIPTION).exists() for path in folders), "a part of a recording"
        done = {
            o.recording_id: Recording.load(tmp_path / "out" / o.recording_id)
            for o in outcomes
            if not o.problem
        }
        return done, problems

    return run
