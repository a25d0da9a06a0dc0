"""One pure step of the loop."""

from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest

from egosim_jax.rendering import reference
from egosim_jax.simulation.actions import split_action
from egosim_jax.simulation.simulator import Simulator, check_update_every
from egosim_jax.types import Clip, InputError, VideoSpec
from egosim_jax.worlds.tabletop import make_sequence, to_action

SPEC = VideoSpec(frames=5, height=48, width=80, fps=8)


def copy_the_view(view, action, first_frame, seed):
    return view.frames


@pytest.fixture(scope="module")
def clip():
    return next(make_sequence(3, spec=SPEC))


def test_step_does_not_change_the_state_it_is_given(clip):
    from egosim_jax.perception.oracle import OracleConfig
    from egosim_jax.worlds.tabletop import observation_of

    before = {f.name: np.array(getattr(clip.state, f.name)) for f in fields(clip.state)}
    oracle = OracleConfig().build({0: observation_of(clip)})
    simulator = Simulator(generator=copy_the_view, perception=oracle, fps=8)
    step = simulator.step(clip.state, to_action(clip), seed=0)
    assert step.state.step == clip.state.step + 1
    for name, value in before.items():
        np.testing.assert_array_equal(value, np.array(getattr(clip.state, name)))


def test_without_a_first_frame_the_generator_gets_that_of_the_view(clip):
    seen = []

    def generator(view, action, first_frame, seed):
        seen.append((first_frame.copy(), seed))
        return view.frames

    simulator = Simulator(generator=generator, perception=None, fps=8)
    step = simulator.step(clip.state, to_action(clip), seed=5)
    assert isinstance(step.clip, Clip)
    assert step.state is clip.state
    np.testing.assert_array_equal(seen[0][0], step.view.frames[0])
    assert seen[0][1] == 5


class Marked:
    """A generator with a renderer and a point size."""

    point_px = 3

    renderer = SimpleNamespace(
        render=lambda state, cameras, *, point_px, motion=None: replace(
            reference.render(state, cameras, point_px=point_px),
            object_ids=np.full((5, 48, 80), 99, np.int32),
        ),
        draw_hands=reference.draw_hands,
        draw_mesh=reference.draw_mesh,
    )

    def __call__(self, view, action, first_frame, seed):
        return view.frames


def test_the_view_is_drawn_by_the_renderer_of_the_generator(clip):
    plain = Simulator(generator=copy_the_view, perception=None, fps=8)
    assert plain.renderer is reference
    drawn = Simulator(generator=Marked(), perception=None, fps=8)
    assert (drawn.render(clip.state, to_action(clip)).object_ids == 99).all()


def test_points_have_the_size_that_the_generator_names(clip):
    plain = Simulator(generator=copy_the_view, perception=None, fps=8)
    assert plain.point_px == 2
    assert Simulator(generator=Marked(), perception=None, fps=8).point_px == 3
    view = Simulator(generator=Marked(), perception=None, fps=8).render(clip.state, to_action(clip))
    expected = reference.render(clip.state, clip.cameras, point_px=3)
    np.testing.assert_array_equal(view.frames, expected.frames)


class Chunked:
    """Generator of chunks of 3 and 2 frames, which shows the view with a little of each hand."""

    chunk_frames = (3, 2)
    renderer, point_px = reference, 2

    def __call__(self, view, action, first_frame, seed):
        hands, depth = reference.draw_hands(action.joints_m, action.cameras, kind=action.kind)
        return np.where((depth < view.depth_m)[..., None], hands, view.frames)

    def begin(self, first_frame, seed):
        given = []

        def take():
            frames = self(*given.pop(0), first_frame, seed)
            yield frames[:1]
            yield frames[1:]

        return SimpleNamespace(put=lambda view, action: given.append((view, action)), take=take)


def test_a_clip_of_chunks_is_the_clip_made_at_once(clip):
    action, shown = to_action(clip), []
    simulator = Simulator(generator=Chunked(), perception=None, fps=8, show=shown.append)
    step = simulator.step(clip.state, action, seed=5)
    view = simulator.render(clip.state, action)
    assert [len(frames) for frames in shown] == [1, 2, 1, 1]
    np.testing.assert_array_equal(step.clip.frames, Chunked()(view, action, None, 5))
    for name in ("frames", "mask", "depth_m", "object_ids"):
        np.testing.assert_array_equal(getattr(step.view, name), getattr(view, name))
    assert 0 < step.latency.first_frame_s < step.latency.last_frame_s


def test_a_hand_that_comes_into_view_later_is_missing_from_the_chunks_before(clip):
    action = to_action(clip)
    joints = action.joints_m.copy()
    joints[:3] += [0, -50, 0]  # behind the wearer
    first, second = split_action(replace(action, joints_m=joints), (3, 2))
    assert np.isnan(first.joints_m).all()
    np.testing.assert_array_equal(second.joints_m, joints[3:])


@pytest.mark.parametrize(
    ("chunks", "perception", "message"),
    [((5,), "classical", "tiny makes clips at once"), ((3, 2), "recorded --x 1", "by number")],
)
def test_what_cannot_update_the_state_by_chunk_is_refused(chunks, perception, message):
    with pytest.raises(InputError, match=message):
        check_update_every("chunk", chunks, "tiny", perception)
    check_update_every("clip", chunks, "tiny", perception)
    check_update_every("chunk", (3, 2), "tiny", "classical")
