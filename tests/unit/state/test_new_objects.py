"""Ids of objects that a state gets later."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.perception import archive
from egosim_jax.state.fuse import fuse
from egosim_jax.state.new_objects import is_among, next_object_id, with_objects, without_ids
from egosim_jax.state.snapshot import fingerprint
from tests.unit.state.test_fuse import COARSE, HERE, THERE, at, start, tracked


@pytest.fixture(scope="module")
def whole():
    return start()


@pytest.fixture(scope="module")
def bare(whole):
    """The state of a plate on a table without the plate's id."""
    return without_ids(whole)


@pytest.fixture(scope="module")
def plate(whole):
    return whole.points_m[whole.object_ids == 1]


def moved(plate):
    return replace(tracked(), new_objects={1: plate}, notes=("hand 0 moved something",))


def test_the_points_of_a_new_object_are_found_in_any_order(whole, bare, plate):
    order = np.random.default_rng(0).permutation(len(bare.points_m))
    shuffled = replace(bare, points_m=bare.points_m[order])
    np.testing.assert_array_equal(
        with_objects(shuffled, {1: plate}).object_ids, whole.object_ids[order]
    )


def test_an_id_that_the_state_has_stays_as_it_is(whole, plate):
    others = whole.points_m[whole.object_ids == 0]
    assert fingerprint(with_objects(whole, {1: others})) == fingerprint(whole)


def test_the_next_id_is_above_all_ids(bare):
    assert next_object_id(bare) == 1
    assert next_object_id(replace(bare, names={7: "cup"})) == 8
    assert next_object_id(replace(bare, world_from_object={9: np.eye(4)})) == 10


def test_a_new_object_moves_and_keeps_its_id(whole, bare, plate):
    after = fuse(bare, moved(plate), fusion=COARSE)
    assert fingerprint(after) == fingerprint(fuse(whole, tracked(), fusion=COARSE))
    assert at(after, HERE) == 0
    assert at(after, THERE) > 100


def test_fusing_a_new_object_again_changes_nothing(bare, plate):
    once = fuse(bare, moved(plate), fusion=COARSE)
    assert fingerprint(fuse(once, moved(plate), fusion=COARSE)) == fingerprint(once)


def test_new_objects_and_notes_are_stored(tmp_path, plate):
    archive.save(tmp_path / "perceived.npz", moved(plate))
    stored = archive.load(tmp_path / "perceived.npz")
    assert stored.notes == ("hand 0 moved something",)
    assert stored.new_objects.keys() == {1}
    assert is_among(plate, stored.new_objects[1]).all()
