"""`egosim episode make` from a user's own files."""

import json

import numpy as np
import pytest

from egosim_jax.cli.episode import MakeEpisode, summary
from egosim_jax.simulation.actions import read_action
from egosim_jax.simulation.episode import Episode
from egosim_jax.types import InputError, SceneState

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


@pytest.mark.parametrize("option", [{"clips": 2}, {"seed": 0}, {"robot": True}])
def test_options_of_the_tabletop_world_are_refused_with_own_actions(own, tmp_path, option):
    name = next(iter(option))
    with pytest.raises(InputError, match=f"--{name} is for the tabletop world"):
        MakeEpisode(out=tmp_path / "out", actions=(own(),), **option).run()


def test_the_summary_names_clips_without_hands(own):
    hand = np.linspace((0.0, 0.0, 0.5), (0.1, 0.1, 0.5), 21).tolist()
    shown = read_action(own(joints_m=[[hand], [None]]), **READ)
    hidden = read_action(own(), **READ)
    state = SceneState(
        points_m=np.full((2, 3), (0, 0, 1), np.float32),
        colors=np.zeros((2, 3), np.uint8),
        object_ids=np.zeros(2, np.int32),
        last_seen=np.zeros(2, np.int32),
        intrinsics_px=shown.cameras.intrinsics_px,
    )
    assert "human hands, 2 points" in summary(Episode(state=state, actions=(shown,), fps=8))
    both = summary(Episode(state=state, actions=(shown, hidden), fps=8))
    assert "2 clips of 2 frames of 80x48 at 8 fps, human hands (none in clip 2), 2 points" in both
