"""A video of a hand in place of a camera moves an object on the page of `egosim play`."""

from importlib.util import find_spec

import numpy as np
import pytest

from egosim_jax.cli.play import Play
from egosim_jax.interactive.play.moves import pre_grasp_pose, suggest_goal
from egosim_jax.interactive.play.own_hand import OwnHand
from egosim_jax.perception.video.hands import litert
from egosim_jax.simulation.episode import Episode
from egosim_jax.types import InputError
from egosim_jax.worlds.tabletop import start_of_sequence
from tests.browser import browse, playing
from tests.own_hands import Wearer, film, way
from tests.system.test_play import SEED, VIDEO, pixels_of_places, redness, settled

needs_viser = pytest.mark.skipif(find_spec("viser") is None, reason="needs viser")


def film_of_carry(path):
    """Write the video of a hand that carries the suggested object to a place, as in a mirror."""
    scene, camera, *_ = start_of_sequence(SEED, spec=VIDEO)
    name, goal = suggest_goal(scene, "right")
    wearer = camera.world_from_camera[0, :3, :3]
    home = OwnHand("right", wearer).home
    person = Wearer(home, wearer, facing=True)
    grip = pre_grasp_pose(scene, name, "right").point_m
    moments = way(home, grip, [*goal, grip[2] + 0.01], still_s=6, slowness=1.3)
    film(path, [person.joints(pose, pinches=pinches) for pose, pinches in moments])


@needs_viser
def test_a_camera_that_is_not_there_ends_the_command_before_anything_is_loaded(monkeypatch):
    monkeypatch.setattr(litert, "fetch_weights", lambda: ())
    monkeypatch.setattr(litert, "HandNetworks", lambda *_, **__: None)
    with pytest.raises(InputError, match=r"Camera 77 cannot be opened"):
        Play(camera="77", port=0).run()


@pytest.fixture
def hand_networks():
    """The networks that find hands, which are fetched once."""
    try:
        litert.fetch_weights()
    except InputError as error:
        pytest.skip(str(error))


@pytest.mark.slow
@needs_viser
def test_the_hand_of_a_video_makes_clips_that_are_saved_and_undone(tmp_path, hand_networks):
    old, _ = pixels_of_places()
    film_of_carry(tmp_path / "hand.mp4")
    options = ("--seed", str(SEED), "--config", "preview", "--camera", tmp_path / "hand.mp4")
    with playing(tmp_path / "runs", *options) as url, browse(url, tmp_path) as page:
        page.wait_for_text("Press follow")
        generated, _, true = settled(page)
        assert redness(generated, old) > 0.3
        assert redness(true, old) > 0.3
        page.click("follow")
        page.wait_for_text("The video in place of a camera has ended")
        page.wait_for_text("the hand has opened")
        page.wait_for_text(", painted")
        page.wait_for("document.body.innerText.includes('All motion is painted')", timeout_s=300)
        page.click("save")
        page.wait_for_text("episode.zip")
        page.wait_for_text("Paused")
        page.screenshot(tmp_path / "page.png")
        (saved,) = tmp_path.glob("runs/*/episode.zip")
        actions = Episode.load(saved).actions
        # A busy machine drops frames, and with them a pinch: test_following has the grasps.
        wrist = np.concatenate([action.joints_m[:, 0, 0] for action in actions])
        assert np.linalg.norm(wrist - wrist[0], axis=1).max() > 0.05
        for moment in reversed(range(len(actions))):
            page.click("undo")
            page.wait_for_text(f"{moment}: ")
        page.wait_for_text("0: The beginning")
        generated, _, true = settled(page)
        assert redness(generated, old) > 0.3
        assert redness(true, old) > 0.3
