"""Stages of the closed loop, with a substitute segmenter and depth network."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from egosim_jax.geometry import look_at, rotation_z, transform
from egosim_jax.perception.classical import take_action
from egosim_jax.perception.networks.align_depth import DepthAlignment
from egosim_jax.perception.networks.closed_loop import EstimateDepth, Segment, keep_changes
from egosim_jax.perception.pipeline import Observation, Pipeline, find_interactions
from egosim_jax.perception.video.estimates import DepthEstimate
from egosim_jax.rendering.reference import render
from egosim_jax.types import Action, Clip, InputError, SceneState
from tests.scenes import pinhole, state_of, without_hands

FRAMES, HEIGHT, WIDTH = 9, 120, 160
CUP, BOX = 3, 7


def texture(seed, shape):
    noise = np.random.default_rng(seed).integers(0, 256, (*shape, 3)).astype(np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 1.0).reshape(-1, 3)


def plane(size, count, *, height):
    grid = np.linspace(-size, size, count)
    x, y = np.meshgrid(grid, grid)
    return np.stack([x, y, np.full_like(x, height)], axis=-1).reshape(-1, 3)


def scene():
    """Return a table with two thin objects on it, 4 cm above it."""
    parts = {
        0: (plane(0.5, 250, height=0.0), texture(0, (250, 250))),
        CUP: (plane(0.06, 60, height=0.04) + [-0.1, 0, 0], texture(1, (60, 60))),
        BOX: (plane(0.05, 50, height=0.04) + [0.15, 0.1, 0], texture(2, (50, 50))),
    }
    contrast = {
        n: np.clip(4.0 * (c.astype(float) - 127) + 127, 0, 255) for n, (_, c) in parts.items()
    }
    return state_of(
        np.concatenate([p for p, _ in parts.values()]),
        colors=np.concatenate(list(contrast.values())),
        ids=np.concatenate([np.full(len(p), n) for n, (p, _) in parts.items()]),
        names={CUP: "red cup", BOX: "box"},
    )


def cameras():
    eyes = [np.array([0.01 * k, -0.35, 0.55]) for k in range(FRAMES)]
    poses = [look_at(eye, np.zeros(3), up=np.array([0, 0, 1.0])) for eye in eyes]
    return pinhole(poses, 150.0, HEIGHT, WIDTH)


def motion(frame):
    """Return the cup's motion: it slides by 8 cm and turns by 20 degrees, from frame 1 to 6."""
    share = np.clip((frame - 1) / 5, 0, 1)
    center = np.array([-0.1, 0, 0.04])
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_z(np.radians(20) * share)
    matrix[:3, 3] = center + share * np.array([0.05, -0.06, 0]) - matrix[:3, :3] @ center
    return matrix


@dataclass(frozen=True)
class Made:
    state: SceneState
    action: Action
    clip: Clip
    depth_m: np.ndarray
    object_ids: np.ndarray


@pytest.fixture(scope="module")
def made():
    state = scene()
    views = []
    for frame in range(FRAMES):
        points = state.points_m.astype(float)
        points[state.object_ids == CUP] = transform(motion(frame), points[state.object_ids == CUP])
        camera = replace(cameras(), world_from_camera=cameras().world_from_camera[[frame]])
        views.append(render(replace(state, points_m=points.astype(np.float32)), camera, point_px=2))
    frames, depth, ids = (
        np.concatenate([getattr(v, name) for v in views])
        for name in ("frames", "depth_m", "object_ids")
    )
    return Made(state, without_hands(cameras()), Clip(frames=frames, fps=8), depth, ids)


@dataclass(frozen=True)
class Masks:
    """Ground-truth masks with other ids, and a hand in a corner."""

    object_ids: np.ndarray

    def __call__(self, frames, phrases, hands=None):
        assert phrases == ("red cup", "box", "spoon", "hand", "arm")
        found = np.zeros_like(self.object_ids)
        found[self.object_ids == CUP], found[self.object_ids == BOX] = 2, 1
        found[:, :10, :10] = -1
        found[:, -12:, -12:] = 3
        return found, {2: "red cup", 1: "box", 3: "spoon", -1: "hand"}


@dataclass(frozen=True)
class Depth:
    """Depth with a different scale and shift of inverse depth in each frame."""

    depth_m: np.ndarray

    def __call__(self, frames, moving, estimate, wanted):
        change = 1 + 0.05 * np.arange(len(frames))[:, None, None]
        depth = 1 / (0.7 * change / self.depth_m + 0.1 * change)
        return DepthEstimate(
            frames=np.arange(len(frames), dtype=np.int32),
            depth_m=depth.astype(np.float32),
            confident=np.isfinite(depth),
            metric=True,
        )


def no_hands(clip, action, state, so_far):
    return replace(so_far, object_ids=np.zeros(clip.frames.shape[:3], np.int32))


def moves(clip, action, state, so_far):
    """Set the true motion of the cup, and a new object without a name of a network."""
    path = np.stack([motion(frame) for frame in range(FRAMES)])
    return replace(so_far, motions={CUP: path}, names={**so_far.names, 5: "object 5"})


def stages(made):
    segment = Segment(segmenter=Masks(made.object_ids), phrases=("spoon",))
    estimate = EstimateDepth(estimator=Depth(made.depth_m))
    return take_action, no_hands, moves, segment, estimate, find_interactions, keep_changes


@pytest.fixture(scope="module")
def perceived(made):
    return Pipeline(stages=stages(made))(made.clip, made.action, made.state)


def test_instances_get_the_ids_of_the_state_or_new_ids(made, perceived):
    elsewhere = np.ones((HEIGHT, WIDTH), bool)
    elsewhere[:10, :10] = elsewhere[-12:, -12:] = False
    np.testing.assert_array_equal(perceived.object_ids[:, elsewhere], made.object_ids[:, elsewhere])
    assert (perceived.object_ids[:, :10, :10] < 0).all()
    new = set(np.unique(perceived.object_ids)) - {0, CUP, BOX, -1}
    assert len(new) == 1
    assert perceived.names == {5: "object 5", new.pop(): "spoon"}


def test_depth_is_that_of_the_scene_where_something_changed_and_unknown_elsewhere(made, perceived):
    last = perceived.depth_m[-1]
    view = render(made.state, made.action.cameras, point_px=2)
    cup = (made.object_ids[-1] == CUP) & (perceived.object_ids[-1] == CUP)
    revealed = (view.object_ids[-1] == CUP) & (perceived.object_ids[-1] == 0)
    assert min(cup.sum(), revealed.sum()) > 100
    for part in (cup, revealed):
        np.testing.assert_allclose(last[part], made.depth_m[-1][part], rtol=0.005)
    rest = (made.object_ids[-1] == BOX) | (perceived.object_ids[-1] < 0)
    assert not np.isfinite(last[rest]).any()


def test_a_state_without_names_needs_phrases(made):
    segment = Segment(segmenter=Masks(made.object_ids))
    seen = Observation(cameras=made.action.cameras, object_ids=np.zeros_like(made.object_ids))
    with pytest.raises(InputError, match=r"at least one phrase.*--phrases"):
        segment(made.clip, made.action, replace(made.state, names={}), seen)


def test_depth_that_does_not_agree_with_the_scene_is_unknown():
    rng = np.random.default_rng(0)
    scene = rng.uniform(0.5, 2, (40, 40)).astype(np.float32)
    other = rng.uniform(0.5, 2, (40, 40)).astype(np.float32)
    static = np.ones((40, 40), bool)
    align = DepthAlignment()
    assert np.isinf(align(other, scene, static)).all()
    assert np.isinf(align(scene, scene, static & (np.arange(40) < 4))).all()
    np.testing.assert_allclose(align(2 * scene, scene, static), scene, rtol=1e-4)


def test_alignment_ignores_what_has_changed():
    rng = np.random.default_rng(1)
    scene = rng.uniform(0.5, 2, (40, 40)).astype(np.float32)
    network = (1 / (0.5 / scene + 0.2)).astype(np.float32)
    network[:12] *= 0.6
    found = DepthAlignment()(network, scene, np.ones((40, 40), bool))
    np.testing.assert_allclose(found[12:], scene[12:], rtol=1e-3)


def test_a_plane_at_one_depth_is_scaled():
    scene, network = np.full((30, 30), 0.8, np.float32), np.full((30, 30), 1.6, np.float32)
    found = DepthAlignment()(network, scene, np.ones((30, 30), bool))
    np.testing.assert_allclose(found, scene, rtol=1e-5)
