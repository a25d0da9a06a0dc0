"""Data and models of `egosim experiment dwm`."""

from dataclasses import replace
from operator import attrgetter

import numpy as np
import pytest

from egosim_jax import configs
from egosim_jax.configs.model import Networks
from egosim_jax.convert.widen import Widening
from egosim_jax.experiments.config import DWM
from egosim_jax.experiments.dwm import run
from egosim_jax.experiments.dwm_training import (
    BASES,
    POSE_DIM,
    VARIANTS,
    changed,
    poses_of,
    widen,
    with_layout,
)
from egosim_jax.geometry import invert, transform
from egosim_jax.io import weights
from egosim_jax.io.weights import flat_shapes
from egosim_jax.models import abstract
from egosim_jax.types import InputError, Triplet, VideoSpec
from egosim_jax.worlds.tabletop import make_sequence

SPEC = VideoSpec(frames=9, height=16, width=32, fps=8)
CONFIG = configs.get("dwm_tabletop")
TINY = replace(
    CONFIG,
    dit=replace(CONFIG.dit, dim=16, heads=1, layers=1, time_dim=8),
    text=replace(CONFIG.text, layers=1),
)


def clip(name):
    video = np.full((9, 16, 32, 3), 200, np.uint8)
    mask = np.zeros((9, 16, 32), np.uint8)
    return Triplet(
        video_id=name, prompt="", prior=video, mask=mask, hands=video // 4, first_frame=video[0],
        target=video,
    )  # fmt: skip


@pytest.mark.parametrize("name", VARIANTS)
def test_every_model_of_the_comparison_has_networks_that_fit(name):
    model = VARIANTS[name].model(TINY, name)
    assert model.dit.in_channels == model.layout.channels
    assert BASES[VARIANTS[name].base].channels <= model.layout.channels


def test_the_image_base_sees_the_first_frame_alone():
    found = changed(clip("a"), "image")
    assert (found.prior[0] == 200).all()
    assert not found.prior[1:].any()


def test_the_painting_base_sees_what_is_not_masked_and_always_the_same():
    shares = []
    for number in range(40):
        found = changed(clip(f"clip_{number}"), "inpaint")
        hidden = found.mask > 127
        assert not hidden[0].any()
        assert not found.prior[hidden].any()
        assert (found.prior[~hidden] == 200).all()
        np.testing.assert_array_equal(found.mask, changed(clip(f"clip_{number}"), "inpaint").mask)
        shares.append(hidden[1:].mean())
    assert 0.3 < np.mean(np.array(shares) == 1) < 0.9


def test_poses_are_joints_in_the_camera_of_each_frame():
    events = next(make_sequence(3, spec=SPEC))
    poses = poses_of(events)
    assert poses.shape == (9, POSE_DIM)
    place = 0 if events.sides[0] == "left" else 1
    one = poses.reshape(9, 2, 64)[4, place]
    local = transform(invert(events.cameras.world_from_camera[4]), events.joints_m[4, 0])
    assert one[0] == 1
    np.testing.assert_allclose(one[1:].reshape(21, 3), 10 * local, rtol=1e-5)
    if len(events.sides) == 1:
        assert not poses.reshape(9, 2, 64)[:, 1 - place].any()


def test_a_wider_model_starts_as_its_base(tmp_path):
    base, layout = with_layout(TINY, BASES["inpaint"], "base"), VARIANTS["full"].layout
    rng, shapes = np.random.default_rng(0), flat_shapes(abstract(base.dit))
    start = {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    weights.write(tmp_path / "dit.safetensors", start)
    wide = Networks(dit=abstract(with_layout(TINY, layout, "wide").dit))
    widen(wide, tmp_path, Widening(base=BASES["inpaint"], layout=layout, input_layer="patch"))
    kernel = np.asarray(wide.dit.patch.kernel.get_value())
    np.testing.assert_array_equal(kernel[:33], start["patch.kernel"])
    assert not kernel[33:].any()
    for name in ("blocks.attn.q.kernel", "text.bias"):
        leaf = attrgetter(name)(wide.dit).get_value()
        np.testing.assert_array_equal(leaf, start[name])


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"only": ("fulll",)}, "no model fulll to compare"),
        ({"strength": 75.0}, r"strength 75\.0: it must be above 0 and at most 1"),
        ({"text_dropout": 1.5}, r"must be in \[0, 1\], not 1\.5"),
    ],
)
def test_bad_settings_are_refused_before_any_work(tmp_path, bad, message):
    with pytest.raises(InputError, match=message):
        run(DWM(out=tmp_path / "run", **bad))
    assert not (tmp_path / "run").exists()
