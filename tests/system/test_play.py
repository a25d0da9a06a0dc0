"""The page of `egosim play` in a real browser; chromium is installed by .ci/run."""

import time
from importlib.util import find_spec

import numpy as np
import pytest

from egosim_jax import configs
from egosim_jax.cli.play import Play
from egosim_jax.geometry import invert, project, transform
from egosim_jax.interactive.options import ClipOptions
from egosim_jax.interactive.play.moves import suggest_goal
from egosim_jax.simulation.episode import Episode
from egosim_jax.types import InputError, VideoSpec
from egosim_jax.worlds.tabletop import start_of_sequence
from tests.browser import browse, playing

SEED = 1
"""A scene in which the hand is offered a red object."""
VIDEO = VideoSpec(frames=17, height=96, width=160, fps=8)
AROUND_PX = 9
"""Half the size of the window around an object, in pixels of the clip."""


def test_a_missing_library_is_named(monkeypatch):
    monkeypatch.setattr("egosim_jax.cli.play.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'egosim-jax\[play\]'"):
        Play().run()


def test_the_denoising_steps_are_those_that_are_given(monkeypatch):
    monkeypatch.setattr("egosim_jax.cli.play.find_spec", lambda name: True)

    def load(config, weights, **_):
        raise InputError(f"{config.steps} steps")

    monkeypatch.setattr("egosim_jax.generation.generator.Generator.load", load)
    for steps, loaded in ((2, 2), (None, configs.get("tabletop").steps)):
        with pytest.raises(InputError, match=f"^{loaded} steps"):
            Play(clips=ClipOptions(steps=steps), port=0).run()


def pixels_of_places():
    """Columns and rows, in the clip, of the suggested object and of the place that it is for."""
    scene, camera, *_ = start_of_sequence(SEED, spec=VIDEO)
    name, goal = suggest_goal(scene, "right")
    body = scene.body(name)
    assert name.startswith("red")
    here = body.world_from_body[:3, 3] + [0, 0, body.size_m[2] / 2]
    points = np.array([here, [*goal, here[2]]])
    local = transform(invert(camera.world_from_camera[0]), points)
    return np.stack(project(camera.intrinsics_px, local), axis=1)


def redness(image, place_px):
    """Share of pixels around a place that are red, which skin is not."""
    scale = image.shape[1] / VIDEO.width
    (x, y), reach = place_px * scale, AROUND_PX * scale
    window = image[int(y - reach) : int(y + reach), int(x - reach) : int(x + reach)].astype(int)
    return float((window[..., 0] - window[..., 1:].max(axis=-1) > 80).mean())


def settled(page):
    """Generated and true image when both have not changed for two seconds."""
    before, since = page.images(), time.monotonic()
    while time.monotonic() - since < 2:
        now = page.images()
        if any(not np.array_equal(a, b) for a, b in zip(now, before, strict=True)):
            before, since = now, time.monotonic()
    return before


@pytest.mark.slow
@pytest.mark.skipif(find_spec("viser") is None, reason="needs viser")
def test_an_object_is_picked_up_and_put_elsewhere_through_the_page(tmp_path):
    old, new = pixels_of_places()
    with (
        playing(tmp_path / "runs", "--seed", str(SEED)) as url,
        browse(url, tmp_path) as page,
    ):
        page.wait_for_text("put it on the ring")
        for image in settled(page):
            assert redness(image, old) > 0.3
            assert redness(image, new) < 0.05
        page.click("put it on the ring")
        page.wait_for_text("state updated after")
        generated, true = settled(page)
        page.screenshot(tmp_path / "page.png")
        assert redness(true, old) < 0.05
        assert redness(true, new) > 0.3
        assert redness(generated, old) < 0.1
        assert redness(generated, new) > 0.15
        page.click("save")
        page.wait_for_text("episode.zip")
        page.click("undo")
        page.wait_for_text("0: The beginning")
        for image in settled(page):
            assert redness(image, old) > 0.3
    (saved,) = tmp_path.glob("runs/*/episode.zip")
    assert "picks up the red" in Episode.load(saved).actions[0].prompt
