"""One pure step of the loop."""

from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest

from egosim_jax.rendering import reference
from egosim_jax.simulation.simulator import Simulator
from egosim_jax.types import Clip, VideoSpec
from egosim_jax.worlds.tabletop import make_sequence, to_action

SPEC = VideoSpec(frames=5, height=48, width=80, fps=8)


def copy_the_view(view, action, first_frame, seed):
    return view.frames


@pytest.fixture(scope="module")
def clip():
    return next(make_sequence(3, spec=SPEC))


def test_step_does_not_change_the_state_it_is_given(clip):
    from egosim_jax.perception.oracle import OracleConfig
    from egosim_jax.worlds.tabletop import to_ground_truth

    before = {f.name: np.array(getattr(clip.state, f.name)) for f in fields(clip.state)}
    oracle = OracleConfig().build({0: to_ground_truth(clip)})
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
        render=lambda state, cameras, *, point_px: replace(
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
