"""The preview of a clip: drawn hands over a view without holes."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.rendering.hand_mesh import REST_MM
from egosim_jax.rendering.reference import draw_hands
from egosim_jax.simulation.preview import Preview, mesh_of
from egosim_jax.simulation.simulator import Simulator
from egosim_jax.state.depth import state_from_depth
from egosim_jax.types import Action, VideoSpec, View
from tests.scenes import pinhole

GRAY = 128
SPEC = VideoSpec(frames=6, height=48, width=80, fps=8)


def cameras(spec=SPEC):
    return pinhole(spec.frames, float(spec.width), spec.height, spec.width)


def action(kind="human", spec=SPEC, side=1.0):
    """A hand that moves to the right, 60 cm in front of the camera."""
    if kind == "human":
        joints = REST_MM / 1000 * [side, -1, -1] + [0.0, 0.05, 0.6]
    else:
        joints = np.array([[0, 0.05, 0.6], [-0.03, -0.06, 0.6], [0.03, -0.06, 0.6]])
    shift = np.linspace(-0.05, 0.05, spec.frames)[:, None, None, None] * [1.0, 0, 0]
    return Action(cameras=cameras(spec), joints_m=joints[None, None] + shift, kind=kind, prompt="")


def view(spec=SPEC, depth_m=1.0, holes=()):
    """A gray wall, with holes in the given rows and columns."""
    shape = (spec.frames, spec.height, spec.width)
    frames, depth = np.full((*shape, 3), GRAY, np.uint8), np.full(shape, depth_m, np.float32)
    for window in holes:
        frames[window], depth[window] = 0, np.inf
    return View(
        frames=frames,
        mask=np.where(np.isinf(depth), 255, 0).astype(np.uint8),
        depth_m=depth,
        object_ids=np.zeros(shape, np.int32),
    )


def make(seen, acted):
    return Preview()(seen, acted, seen.frames[0], 0)


def is_drawn(frames):
    """Pixels that are no gray: hands have a color, shadows have none."""
    return np.ptp(frames.astype(int), axis=-1) > 12


@pytest.mark.parametrize(("kind", "covered"), [("human", 0.9), ("robot", 0.5)])
def test_hands_are_where_their_skeleton_is(kind, covered):
    acted = action(kind)
    drawn = is_drawn(make(view(), acted)) if kind == "human" else make(view(), acted)[..., 0] < 90
    bones = np.isfinite(draw_hands(acted.joints_m, acted.cameras, kind=kind)[1])
    assert drawn[bones].mean() > covered  # a gripper's fingers are parallel, its bones a V
    rows, columns = np.nonzero(bones.any(axis=0))
    far = np.ones(bones.shape[1:], bool)
    far[max(rows.min() - 8, 0) : rows.max() + 9, max(columns.min() - 8, 0) : columns.max() + 9] = 0
    assert not drawn[:, far].any()


def test_nearer_points_hide_hands():
    hidden = make(view(depth_m=0.4), action())
    assert not is_drawn(hidden).any()
    partly = view()
    partly.depth_m[:, :, :40] = 0.4
    drawn = is_drawn(make(partly, action()))
    assert not drawn[:, :, :39].any()
    assert drawn[-1, :, 41:].any()


def test_a_hand_in_a_corner_of_the_image_is_drawn():
    """Its window does not contain the middle of the image."""
    acted = action()
    acted = replace(acted, joints_m=acted.joints_m + [0.4, 0.2, 0.3])
    drawn = is_drawn(make(view(), acted))
    assert drawn[:, 30:, 50:].any()
    assert not drawn[:, :20].any()
    assert not drawn[..., :35].any()


def test_surfaces_near_hands_are_darker_and_others_are_not():
    frames = make(view(depth_m=0.65), action()).astype(int)
    wall = ~is_drawn(frames)
    assert (frames[wall] < GRAY - 15).any()
    assert (frames[:, 0, 0] == GRAY).all()


def test_no_hole_stays_black_and_objects_fill_none():
    seen = view(holes=[np.s_[:, :, 60:], np.s_[:, 10:20, 10:20]])
    seen.frames[:, 10:20, 20:30] = [250, 0, 0]
    seen.object_ids[:, 10:20, 20:30] = 3
    frames = make(seen, replace(action(), joints_m=np.full((6, 1, 21, 3), np.nan)))
    np.testing.assert_array_equal(frames[seen.mask == 0], seen.frames[seen.mask == 0])
    assert np.abs(frames[seen.mask > 0].astype(int) - GRAY).max() <= 4
    empty = view(holes=[np.s_[1:]])
    assert make(empty, action()).shape == empty.frames.shape


@pytest.mark.parametrize(("frames", "height", "width"), [(1, 17, 33), (9, 96, 160), (2, 240, 400)])
def test_clips_have_any_length_and_size_and_are_the_same_each_time(frames, height, width):
    spec = VideoSpec(frames=frames, height=height, width=width, fps=8)
    seen = view(spec)
    made = [Preview()(seen, action(spec=spec), seen.frames[0], seed) for seed in (1, 2)]
    assert made[0].shape == (frames, height, width, 3)
    np.testing.assert_array_equal(*made)


def test_a_left_hand_is_drawn_as_one():
    left, right = (mesh_of(action(side=side)).vertices_m[0] - [0, 0.05, 0.6] for side in (-1, 1))
    shift = np.array([-0.05, 0, 0])
    np.testing.assert_allclose((left - shift) * [-1, 1, 1], right - shift, atol=1e-9)


def test_the_simulator_predicts_what_it_shows_and_streams_groups():
    shape = (SPEC.height, SPEC.width)
    state = state_from_depth(
        np.full((*shape, 3), GRAY, np.uint8), np.ones(shape), cameras().intrinsics_px, np.eye(4)
    )
    shown = []
    simulator = Simulator(generator=Preview(), perception=None, fps=8, show=shown.append)
    assert simulator.prior == "predicted"
    step = simulator.step(state, action(), seed=0)
    assert [len(group) for group in shown] == [4, 2]
    np.testing.assert_array_equal(step.clip.frames, make(step.view, action()))


def test_a_hand_at_one_side_of_the_image_is_drawn():
    """The principal point is outside its window."""
    acted = action()
    aside = replace(acted, joints_m=acted.joints_m * 0.5 + [0.25, 0.1, 0.6])
    drawn = is_drawn(make(view(depth_m=2.0), aside))
    assert drawn.any(axis=0)[:, SPEC.width // 2 :].sum() > 50
    assert not drawn[..., : SPEC.width // 2].any()
