"""Baselines: what the generator is given instead of all conditions."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax import configs
from egosim_jax.batch import BatchJob
from egosim_jax.cli.generate import Generate
from egosim_jax.conditioning.baselines import STRENGTH, with_hand_mask
from egosim_jax.generator import Generator
from egosim_jax.testing import write_weights
from egosim_jax.types import Triplet


@pytest.fixture
def triplet():
    hands = np.zeros((2, 4, 6, 3), np.uint8)
    hands[:, 1, 2] = [60, 30, 20]  # 110 in all
    hands[:, 2, 3] = [60, 20, 20]  # 100
    frames = np.full((2, 4, 6, 3), 7, np.uint8)
    return Triplet(
        video_id="a",
        prompt="",
        prior=frames,
        mask=frames[..., 0],
        hands=hands,
        first_frame=frames[0],
    )


def test_the_hand_mask_is_white_where_hands_are_drawn(triplet):
    hands = with_hand_mask(triplet).hands
    assert hands[:, 1, 2].tolist() == [[255] * 3] * 2
    assert hands.sum() == 2 * 3 * 255
    assert hands.dtype == np.uint8


class Recorder(Generator):
    """A generator that keeps what it is given."""

    def __init__(self):
        pass

    def generate(self, triplets, seeds, *, without=None):
        self.hands, self.without = triplets[0].hands, without
        return []


@pytest.mark.parametrize(
    ("baseline", "without", "painted"),
    [(None, None, False), ("no_hands", "hands", False), ("hand_mask", None, True)],
)
def test_a_baseline_changes_the_conditions(triplet, tmp_path, baseline, without, painted):
    job = BatchJob(model=configs.get("debug"), out=tmp_path, weights=None, baseline=baseline)
    recorder = Recorder()
    job._clips(recorder, [triplet], [0])
    assert recorder.without == without
    assert (recorder.hands.max() == 255) == painted


def test_sdedit_begins_at_the_models_strength_or_its_default(tmp_path):
    write_weights(tmp_path, configs.get("debug"))
    command = Generate(config="debug", weights=tmp_path, baseline="sdedit")
    assert command._model().strength == STRENGTH
    assert replace(command, strength=0.5)._model().strength == 0.5
    assert replace(command, baseline="no_hands")._model().strength is None


def test_another_baseline_is_another_job(tmp_path):
    job = BatchJob(model=configs.get("debug"), out=tmp_path, weights=None, baseline="no_hands")
    job.open()
    with pytest.raises(Exception, match="baseline"):
        replace(job, baseline="hand_mask").open()
