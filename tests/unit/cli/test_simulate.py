"""`egosim simulate`: refused options and the table of scores."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax import configs
from egosim_jax.cli import simulate
from egosim_jax.evaluation.metrics.loop import MEASURES
from egosim_jax.generation.generator import Generator
from egosim_jax.simulation.episode import Episode
from egosim_jax.state.depth import state_from_depth
from egosim_jax.types import Action, Cameras, InputError


def test_clips_with_other_ground_truth_have_empty_cells(capsys):
    names = list(MEASURES)
    report = [
        {"clip": 1, "action": "lift", names[0]: 1.0},
        {"clip": 2, "action": "drop", names[1]: 2.0},
        {"clip": 3, "action": "wave"},
    ]
    simulate._print(report)
    table = capsys.readouterr().out
    for text in (MEASURES[names[0]][0], MEASURES[names[1]][0], "1: lift", "2: drop", "3: wave"):
        assert text in table


def test_a_perception_of_a_state_that_is_kept_is_refused():
    with pytest.raises(InputError, match="oracle has no effect with --update none"):
        simulate.Simulate(perception="oracle", update="none").run()


def test_weights_that_were_not_made_for_the_scene_are_said_in_one_line(
    tmp_path, capsys, monkeypatch
):
    def stop(*args, **options):
        raise InputError("stopped before the weights are loaded")

    monkeypatch.setattr(Generator, "load", stop)
    video = configs.get("tabletop").video
    intrinsics_px = np.array([[140.0, 0, 79.5], [0, 140, 47.5], [0, 0, 1]])
    hand = np.array([[0, 0, 0], *([0.02 * f, -0.02 * k, 0] for f in range(5) for k in range(4))])
    action = Action(
        cameras=Cameras(
            world_from_camera=np.tile(np.eye(4), (video.frames, 1, 1)),
            intrinsics_px=intrinsics_px,
            height=video.height,
            width=video.width,
        ),
        joints_m=np.tile(hand + [0, 0, 0.5], (video.frames, 1, 1, 1)),
        kind="human",
        prompt="",
    )
    image = np.full((video.height, video.width, 3), 120, np.uint8)
    depth_m = np.full(image.shape[:2], 0.6)
    state = state_from_depth(image, depth_m, intrinsics_px, np.eye(4))
    for number, (scene, lines) in enumerate(
        ((state, 1), (replace(state, provenance={"world": "tabletop"}), 0))
    ):
        episode = tmp_path / f"{number}.zip"
        Episode(state=scene, actions=(action,), fps=video.fps).save(episode)
        with pytest.raises(InputError, match="stopped"):
            simulate.Simulate(episode=episode, out=tmp_path / str(number)).run()
        said = [line for line in capsys.readouterr().err.splitlines() if "trained on" in line]
        assert len(said) == lines
