"""Encounters follow the true world: pushes, two hands, bodies on others, grasps that fail."""

import numpy as np
import pytest

from egosim_jax.types import VideoSpec
from egosim_jax.worlds.tabletop import encounters, make_sequence
from egosim_jax.worlds.tabletop.encounters import ENCOUNTERS, make_encounters

SPEC = VideoSpec(frames=17, height=16, width=24, fps=8)


def clips_of(monkeypatch, encounter, *seeds, **more):
    """Return the first clips of seeds in which an encounter is the only one."""
    monkeypatch.setattr(encounters, "ENCOUNTERS", (encounter,))
    return [next(make_encounters(seed, spec=SPEC, **more)) for seed in seeds]


def ways_of(clip):
    """Return the distance between the first and the last place of each body in meters."""
    return {
        name: float(np.linalg.norm(path[-1, :3, 3] - path[0, :3, 3]))
        for name, path in clip.world_from_body.items()
    }


def test_a_seed_gives_the_same_clips_in_which_hands_go_on():
    first, second = (list(make_encounters(1, spec=SPEC, clips=2)) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.frames, other.frames)
        assert one.caption == other.caption
    assert [clip.number for clip in first] == [0, 1]
    ends, starts = first[0].joints_m[-1], first[1].joints_m[0]
    np.testing.assert_allclose(starts[: len(ends)], ends, atol=1e-9)
    for name, path in first[0].world_from_body.items():
        np.testing.assert_allclose(first[1].world_from_body[name][0], path[-1], atol=1e-9)


@pytest.mark.parametrize("kind", ["human", "robot"])
def test_hands_push_bodies_over_the_table(monkeypatch, kind):
    for clip in clips_of(monkeypatch, encounters.push, 4, kind=kind):
        assert "pushes the" in clip.caption
        name = max(ways_of(clip), key=lambda name: ways_of(clip)[name])
        assert ways_of(clip)[name] > 0.01
        np.testing.assert_allclose(clip.world_from_body[name][:, 2, 3], 0, atol=1e-6)


def test_two_hands_move_two_bodies_or_one(monkeypatch):
    for clip in clips_of(monkeypatch, encounters.two_hands, 3, 8):
        assert clip.joints_m.shape[1] == 2
        lifted = [n for n, path in clip.world_from_body.items() if np.ptp(path[:, 2, 3]) > 0.02]
        assert len(lifted) == (1 if clip.caption.startswith("Both") else 2)


def test_a_rider_goes_along_and_a_taken_body_does_not(monkeypatch):
    (clip,) = clips_of(monkeypatch, encounters.rider, 6)
    heights = [path[:, 2, 3] - path[0, 2, 3] for path in clip.world_from_body.values()]
    first, second = [height for height in heights if np.ptp(height) > 0.05]
    np.testing.assert_allclose(first, second, atol=5e-3)
    (clip,) = clips_of(monkeypatch, encounters.take_off, 6)
    assert sum(way > 0.05 for way in ways_of(clip).values()) == 1


def test_a_fast_hand_rests_in_the_second_half(monkeypatch):
    (clip,) = clips_of(monkeypatch, encounters.fast, 3)
    np.testing.assert_array_equal(clip.joints_m[8], clip.joints_m[-1])
    assert (
        max(np.ptp(path[:, :3, 3], axis=0).max() for path in clip.world_from_body.values()) > 0.03
    )


def test_every_encounter_occurs_and_a_scene_without_one_has_scripts(monkeypatch):
    assert len(set(ENCOUNTERS)) == 7
    monkeypatch.setattr(encounters, "ENCOUNTERS", (lambda start: None,))
    clip = next(make_encounters(3, spec=SPEC))
    np.testing.assert_array_equal(clip.frames, next(make_sequence(3, spec=SPEC)).frames)
