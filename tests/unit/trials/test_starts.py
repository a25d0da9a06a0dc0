"""Starts of trials by text."""

import json

import numpy as np
import pytest

from egosim_jax.interactive.env import ActionSpec
from egosim_jax.trials.starts import carried, read_starts
from egosim_jax.types import InputError
from egosim_jax.worlds.tabletop import episode_of_sequence
from tests.painted import VIDEO, painted
from tests.unit.trials.conftest import no_dataset

SPEC = ActionSpec()


@pytest.fixture(scope="module")
def episode():
    return episode_of_sequence(3, spec=VIDEO)


def read(*texts, read_lerobot=no_dataset):
    return read_starts(texts, VIDEO, read_lerobot)


def test_tabletop_scenes_are_named_by_their_seeds():
    starts = read("tabletop:3-5", "tabletop:9")
    assert [start.name for start in starts] == [f"tabletop:{seed}" for seed in (3, 4, 5, 9)]
    begun = starts[0].begin(painted(), SPEC)
    assert begun.seed == 3
    assert begun.prompt == "The right hand moves."


def test_the_script_of_a_scene_has_its_goal():
    carries, lifts = read("tabletop:0", "tabletop:5")
    condition = carried(carries.script(SPEC, VIDEO))
    assert condition.object == "green cone"
    assert np.linalg.norm(condition.offset_m) > 0.05
    assert lifts.script(SPEC, VIDEO) is carried(None) is None


def test_black_and_hinged_objects_cannot_be_picked_up():
    (start,) = read("tabletop:9")
    loose = start.loose(start.begin(painted(), SPEC), SPEC, VIDEO)
    assert loose == ["green cup", "red ball", "yellow cone"]


@pytest.mark.parametrize("name", ["mine", "mine.zip"])
def test_an_episode_begins_with_its_scene_and_a_neutral_prompt(episode, tmp_path, name):
    episode.save(tmp_path / name)
    (start,) = read(str(tmp_path / name))
    begun = start.begin(painted(), SPEC)
    assert start.name == name
    assert begun.prompt == "The right hand moves."
    np.testing.assert_array_equal(begun.state.points_m, episode.state.points_m)
    assert start.loose(begun, SPEC, VIDEO) == list(episode.state.names.values())
    assert start.script(SPEC, VIDEO) is None


def dataset(folder, episodes=3):
    (folder / "meta").mkdir(parents=True)
    about = {"codebase_version": "v3.0", "total_episodes": episodes, "features": {}, "fps": 8}
    (folder / "meta" / "info.json").write_text(json.dumps(about))
    return folder


@pytest.mark.parametrize(("chosen", "numbers"), [("", [0, 1, 2]), (":1-2", [1, 2]), (":2", [2])])
def test_a_dataset_gives_the_first_frames_of_its_episodes(episode, tmp_path, chosen, numbers):
    asked = []

    def read_lerobot(root, number, video):
        asked.append((root.name, number, video))
        return episode

    starts = read(f"{dataset(tmp_path / 'set')}{chosen}", read_lerobot=read_lerobot)
    assert [start.name for start in starts] == [f"set:{number}" for number in numbers]
    assert asked == [("set", number, VIDEO) for number in numbers]


@pytest.mark.parametrize(
    "text", ["tabletop:", "tabletop:5-3", "tabletop:a", "tabletop:0-1000", "nowhere", "tabletop"]
)
def test_other_texts_are_refused(text):
    with pytest.raises(InputError, match="--starts"):
        read(text)


def test_a_start_is_given_once():
    with pytest.raises(InputError, match="twice"):
        read("tabletop:0-2", "tabletop:2")
