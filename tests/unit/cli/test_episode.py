"""`egosim episode make` from a user's own files."""

import json

import numpy as np
import pytest

from egosim_jax.cli.episode import MakeEpisode
from egosim_jax.simulation.actions import read_action
from egosim_jax.types import InputError

READ = {"height": 48, "width": 80, "prompt": None}


@pytest.fixture
def own(tmp_path):
    """Return a function that writes an action file with some fields replaced."""

    def write(**fields):
        path = tmp_path / "clip.json"
        action = {
            "world_from_camera": [np.eye(4).tolist()] * 2,
            "intrinsics_px": [[60, 0, 39.5], [0, 60, 23.5], [0, 0, 1]],
            "joints_m": [[None], [None]],
            "prompt": "Pick up the cup.",
        }
        path.write_text(json.dumps({**action, **fields}))
        return path

    return write


def test_hands_that_are_all_missing_are_human(own):
    action = read_action(own(), **READ)
    assert action.kind == "human"
    assert action.joints_m.shape == (2, 1, 21, 3)
    assert np.isnan(action.joints_m).all()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"prompt": 3}, "prompt is 3: it must be text"),
        ({"prompt": ""}, "has no prompt: give one per clip"),
        ({"intrinsics_px": [[10**400, 0, 1], [0, 1, 1], [0, 0, 1]]}, "not an array of numbers"),
        ({"joints_m": [[None], None]}, "not an array of numbers"),
        ({"speed": 1}, "must be an object of world_from_camera"),
    ],
)
def test_an_action_file_that_is_wrong_is_refused(own, fields, message):
    with pytest.raises(InputError, match=message):
        read_action(own(**fields), **READ)


@pytest.mark.parametrize("option", [{"seed": 0}, {"robot": True}])
def test_options_of_the_tabletop_world_are_refused_with_own_actions(own, tmp_path, option):
    name = next(iter(option))
    with pytest.raises(InputError, match=f"--{name} is for the tabletop world"):
        MakeEpisode(out=tmp_path / "out", actions=(own(),), **option).run()
