"""Stages of an annotation."""

from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import pytest

from egosim_jax.annotate.clip import Job, open_record
from egosim_jax.annotate.frames import Sampling
from egosim_jax.annotate.hand_tracks import before_entry, drop_flashes, hold_hands, visible, without
from egosim_jax.annotate.objects import drop_unmeasured, find_moved_objects, join_objects
from egosim_jax.annotate.prepare import Cutting, RefusedError
from egosim_jax.annotate.scene import (
    STAGES,
    check_prior,
    clean_first_frame,
    plane_behind_objects,
    to_triplet,
)
from egosim_jax.annotate.sources import Source, open_source
from egosim_jax.annotate.stages import find_hands, search_hands
from egosim_jax.perception.video.estimates import LEFT, RIGHT
from egosim_jax.perception.video.moved import Moved
from tests.unit.annotate.stubs import StubHands, config, textured_video, write


def record_of(tmp_path, settings, frames):
    """Return the record of a clip of nine frames, before all stages."""
    path = write(tmp_path / "cup.mp4", frames)
    open_source(Source(name="cup", path=path)).save(tmp_path / "cup")
    job = Job(video_id="cup", recording=str(tmp_path / "cup"), start=0, stop=9, figures={})
    return open_record(job, settings)


def stages_of(tmp_path, settings, *, last="caption"):
    """Return the record of a video of a fixed camera after a stage."""
    record = record_of(tmp_path, settings, np.repeat(textured_video(1), 9, axis=0))
    parts = settings.build()
    for stage in STAGES:
        record = stage.run(record, parts, settings)
        if stage.name == last:
            break
    return record


def test_a_hand_keeps_its_silhouette_for_half_a_second():
    hands = StubHands(0.5, None)(np.zeros((40, 48, 80, 3), np.uint8))
    held = hold_hands(hands, Fraction(16))
    assert visible(hands)[:, RIGHT].sum() == 20
    assert np.flatnonzero(visible(held)[:, RIGHT]).tolist() == list(range(28))
    assert np.array_equal(held.joints_px[27], hands.joints_px[19], equal_nan=True)
    assert not visible(held)[:, 1 - RIGHT].any()


@pytest.mark.parametrize("gap", [24, 25])
def test_a_silhouette_moves_through_a_gap_of_up_to_a_second_and_a_half(gap):
    hands = StubHands(1.0, None)(np.zeros((60, 48, 80, 3), np.uint8))
    pixels = hands.joints_px.copy()
    pixels[10 + gap :] += [6, 0]
    missing = slice(11, 10 + gap)
    pixels[missing] = np.nan
    presence = hands.presence.copy()
    presence[missing] = 0
    lost = replace(hands, joints_px=pixels, presence=presence)
    held = hold_hands(lost, Fraction(16))
    halfway = held.joints_px[10 + gap // 2, RIGHT] - pixels[10, RIGHT]
    if gap == 24:
        np.testing.assert_allclose(halfway, np.full((21, 2), [3, 0]), atol=1e-9)
    else:
        assert np.isnan(halfway).all()


@pytest.mark.parametrize(("shown", "absent"), [(200, True), (60, False)])
def test_a_hand_that_enters_hides_nothing_of_the_first_frame(shown, absent):
    """The place where it is found first shows something else before, or the hand, undetected."""
    hands = StubHands(1.0, None)(np.zeros((9, 48, 80, 3), np.uint8))
    late = np.zeros((9, 2), bool)
    late[:3] = True
    hands, frames = without(hands, late), np.full((9, 48, 80, 3), 60, np.uint8)
    frames[3:] = shown
    held = visible(without(hold_hands(hands, Fraction(16)), before_entry(hands, frames)))
    assert held[0, RIGHT] != absent
    assert held[1:, RIGHT].all()
    assert not before_entry(StubHands(1.0, None)(frames), frames).any()


def test_a_prior_that_is_worse_than_the_first_frame_is_refused():
    figures = {"psnr_background": 17.0, "psnr_first_frame": 20.0}
    with pytest.raises(RefusedError, match=r"-3\.0 dB .*\(--min-prior-gain\)"):
        check_prior("incremental", figures, config())
    check_prior("incremental", {**figures, "psnr_background": 19.0}, config())


@pytest.mark.parametrize("rung", ["static", "rotation"])
def test_the_prior_of_a_fixed_camera_is_checked_too(rung):
    exact, coarse = {"psnr_drawn": 100.0}, {"psnr_drawn": 27.5}
    wrong = {"psnr_background": 27.0, "psnr_first_frame": 30.0}
    with pytest.raises(RefusedError, match=r"-3\.0 dB .*\(--min-prior-gain\)"):
        check_prior(rung, wrong | exact, config())
    check_prior(rung, wrong | coarse, config())  # as well as the points can draw it
    changing = {"psnr_background": 12.0, "psnr_first_frame": 12.0} | exact
    with pytest.raises(RefusedError, match=r"12\.0 dB, below 16 dB.*a screen.*--rung"):
        check_prior(rung, changing, config())
    check_prior("incremental", changing, config())


def test_clips_are_not_advised_to_be_cut_into_clips(tmp_path):
    """Every refusal that names `--clips` omits it if the videos are cut already."""
    cut = Cutting(clips=True)
    changing = {"psnr_background": 12.0, "psnr_first_frame": 12.0, "psnr_drawn": 100.0}
    record = stages_of(tmp_path, config(), last="hands")
    for hands in (StubHands(0.0, None), TwoHands(9, mirrored=9)):
        for cutting, advised in ((Cutting(), True), (cut, False)):
            settings = config(sampling=Sampling(num_frames=9), cutting=cutting)
            with pytest.raises(RefusedError) as refused:
                find_hands(record, replace(settings.build(), hands=hands), settings)
            assert ("--clips" in str(refused.value)) == advised
    for cutting, advised in ((Cutting(), True), (cut, False)):
        with pytest.raises(RefusedError) as refused:
            check_prior(
                "static", changing, config(sampling=Sampling(num_frames=9), cutting=cutting)
            )
        assert ("--clips" in str(refused.value)) == advised


def test_moved_objects_are_joined_by_other_objects():
    ids, standing = np.zeros((2, 8, 8), np.int32)
    ids[2:5, 2:5] = 3
    standing[1:5, 2:5] = 1
    standing[6:, :4] = 2
    joined, names = join_objects(ids, {3: "moved object"}, standing)
    assert (joined[1:5, 2:5] == 3).all()
    assert (joined[6:, :4] == 4).all()
    assert names == {3: "moved object", 4: "object 4"}
    assert np.count_nonzero(joined) == 20


def test_moved_objects_get_ids_and_sleeves_are_arms(tmp_path, monkeypatch):
    record = stages_of(tmp_path, config(segment=True), last="scale")
    shown = np.zeros((3, 9, 48, 80), bool)
    shown[0, :, 9:21, 58:68] = True  # on the cup of the network
    shown[1, :, 30:40, 30:40] = True
    shown[2, :, 40:48, 0:20] = True
    found = [
        Moved(
            first=mask[0],
            start=np.zeros((0, 2), np.float32),
            shown=mask,
            motion_px=np.zeros((9, 2, 3)),
            contacts=(),
            worn=n == 2,
        )
        for n, mask in enumerate(shown)
    ]
    monkeypatch.setattr("egosim_jax.perception.video.moved.find_moved", lambda *_, **__: found)
    settings = config()
    record = find_moved_objects(record, settings.build(), settings)
    ids = record.require("object_ids")
    assert ids[4, 15, 65] == ids[4, 9, 58] == 5
    assert (ids[4, 35, 35], ids[4, 45, 10]) == (6, -1)
    assert record.names == {5: "cup", 6: "moved object"}
    assert record.require("moved_ids").tolist() == [5, 6]
    assert (record.moved == np.isin(ids, [5, 6])).all()
    plane = replace(record.require("depth"), confident=np.zeros((1, 48, 80), bool))
    depth_m = plane_behind_objects(replace(record, depth=plane)).depth_m[0]
    assert (depth_m[record.moved[0]] == plane.depth_m[0, 0, 0]).all()
    assert np.unique(depth_m[~record.moved[0]]) == pytest.approx(plane.depth_m[0, 0, 0] * 1.24)
    assert plane_behind_objects(record) is record.depth  # measured
    record = clean_first_frame(record, settings.build(), settings)
    assert (record.require("first_frame")[35, 35] == record.frames[0, 35, 35]).all()


def test_a_second_hand_for_a_moment_is_the_first_one_again():
    hands = StubHands(1.0, None)(np.zeros((60, 48, 80, 3), np.uint8))
    for frames in (slice(10, 14), slice(30, 45)):
        hands.joints_px[frames, LEFT] = hands.joints_px[frames, RIGHT] + 20
        hands.joints_hand_m[frames, LEFT] = hands.joints_hand_m[frames, RIGHT]
    filled = np.zeros((60, 2), bool)
    filled[[12, 40], LEFT] = True
    kept = drop_flashes(replace(hands, filled=filled), Fraction(16))
    assert np.argwhere(np.asarray(kept.filled)).tolist() == [[40, LEFT]]
    assert np.flatnonzero(visible(kept)[:, LEFT]).tolist() == list(range(30, 45))
    assert visible(kept)[:, RIGHT].all()
    alone = StubHands(0.05, None)(np.zeros((60, 48, 80, 3), np.uint8))
    assert visible(drop_flashes(alone, Fraction(16))).sum() == 3


@pytest.mark.parametrize(
    ("count", "aside", "kept"), [(15, 0.2, False), (17, 0.2, True), (15, 0.8, True)]
)
def test_a_second_hand_on_the_first_one_is_dropped_unless_it_lasts(count, aside, kept):
    """`aside` is the distance of the palms as a share of the hand's size."""
    hands = StubHands(1.0, None)(np.zeros((60, 48, 80, 3), np.uint8))
    size = np.ptp(hands.joints_px[0, RIGHT], axis=0).max()
    hands.joints_px[20 : 20 + count, LEFT] = hands.joints_px[0, RIGHT] + [aside * size, 0]
    hands.joints_hand_m[20 : 20 + count, LEFT] = hands.joints_hand_m[0, RIGHT]
    found = visible(drop_flashes(hands, Fraction(16)))
    assert found[:, LEFT].sum() == kept * count
    assert found[:, RIGHT].all()


def test_hands_outside_of_the_crop_are_missing_and_others_in_pixels_of_the_clip(tmp_path):
    settings = config(sampling=Sampling(size=(48, 64)))
    record, parts = record_of(tmp_path, settings, textured_video(9, 96, 160)), settings.build()
    found = search_hands(record, parts)
    searched = parts.hands(np.zeros((9, 96, 160, 3), np.uint8))
    half = (searched.joints_px + 0.5) / 2 - 0.5 - [8, 0]  # 80 x 48, cropped to 64 columns
    np.testing.assert_allclose(found.joints_px, half)
    aside = replace(searched, joints_px=searched.joints_px + [90, 0])
    assert not visible(search_hands(record, replace(parts, hands=lambda frames: aside))).any()


def test_all_hands_are_of_the_given_side(tmp_path):
    hands = stages_of(tmp_path, config(side="left"), last="hands").require("hands")
    assert visible(hands).all(axis=0).tolist() == [True, False]
    assert (hands.presence[:, LEFT] == 0.9).all()


@dataclass(frozen=True)
class MirroredHands:
    """The stub's hand, with the joints of the other side in some of nine frames."""

    frames: int

    def __call__(self, frames):
        hands = StubHands(1.0, None)(frames)
        mirrored = np.zeros(hands.presence.shape, bool)
        mirrored[: self.frames, RIGHT] = True
        return replace(hands, mirrored=mirrored)


def sides_checked(tmp_path, frames, **options):
    settings = config(**options)
    record = stages_of(tmp_path, settings, last="hands")
    parts = replace(settings.build(), hands=MirroredHands(frames))
    return find_hands(record, parts, settings).notes["hands"]["mirrored"]


def test_a_hand_that_is_mirrored_in_many_frames_is_refused_unless_its_side_is_given(tmp_path):
    assert sides_checked(tmp_path, 3) == {"left": 0, "right": 3}
    with pytest.raises(RefusedError, match=r"the right hand .* 44% of its frames.*\(--side\)"):
        sides_checked(tmp_path, 4)
    assert sides_checked(tmp_path, 4, side="right") == {"left": 0, "right": 4}


@dataclass(frozen=True)
class TwoHands:
    """The stub's hand and a left one, which is visible and mirrored in some of nine frames."""

    both: int
    mirrored: int = 0

    def __call__(self, frames):
        hands = MirroredHands(0)(frames)
        for values in (hands.joints_px, hands.joints_hand_m, hands.presence):
            values[: self.both, LEFT] = values[: self.both, RIGHT]
        hands.joints_px[: self.both, LEFT] += np.ptp(hands.joints_px[0, RIGHT], axis=0).max()
        hands.mirrored[: self.mirrored, LEFT] = True
        return hands


@pytest.mark.parametrize(
    ("hands", "side", "message"),
    [
        (TwoHands(9), "left", r"two are visible in 100% of the frames.*Omit it\. \(--side\)"),
        (TwoHands(5), "right", r"two are visible in 56%"),
        (TwoHands(9, mirrored=9), "auto", r"left hand .* 100% of.*\(--clips\).*\(--num-frames\)"),
        (MirroredHands(9), "auto", r"Give the side if there is one hand\. \(--side\)"),
    ],
    ids=["side of two", "side of two in half", "mirrored of two", "mirrored of one"],
)
def test_the_advice_about_a_side_fits_the_number_of_hands(tmp_path, hands, side, message):
    settings = config(side=side)
    record = stages_of(tmp_path, config(), last="hands")
    parts = replace(settings.build(), hands=hands)
    with pytest.raises(RefusedError, match=message):
        find_hands(record, parts, settings)
    advised = "auto" if side != "auto" else "right"
    if hands.mirrored if isinstance(hands, TwoHands) else False:
        return  # its advice is another part of the video
    assert find_hands(record, parts, config(side=advised)).hands is not None


def test_the_background_is_judged_where_the_prior_draws_it(tmp_path):
    record = stages_of(tmp_path, config())
    state = record.require("state")
    column = np.arange(48 * 80) % 80
    hidden = (
        (column >= 60) & (column < 78) & (column % 6 < 2)
    )  # a crack of one pixel between squares of two
    state = replace(
        state,
        points_m=state.points_m[~hidden],
        colors=state.colors[~hidden],
        object_ids=state.object_ids[~hidden],
        last_seen=state.last_seen[~hidden],
    )
    still = np.repeat(record.require("first_frame")[None], len(record.frames), axis=0)
    _, figures = to_triplet(replace(record, state=state, frames=still), config())
    assert figures["seen"] == 1
    assert figures["psnr_background"] > 35  # 22 with the cracks


def test_an_object_needs_confident_depth_in_half_of_its_pixels():
    standing = np.array([[0, 1, 1], [2, 2, 2]], np.int32)
    confident = np.array([[False, True, False], [True, False, False]])
    assert drop_unmeasured(standing, confident).tolist() == [[0, 1, 1], [0, 0, 0]]
    ids, names = join_objects(np.zeros((2, 3), np.int32), {}, np.where(standing == 2, standing, 0))
    assert (ids.tolist(), names) == ([[0, 0, 0], [1, 1, 1]], {1: "object 1"})
