"""Input channels of the denoiser against plain loops."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from egosim_jax.conditioning import ChannelLayout, Condition
from egosim_jax.conditioning.layout import (
    COGVIDEOX_INPAINT,
    DWM,
    DWM_WAN,
    EGOSIM,
    WAN_INPAINT,
)
from egosim_jax.types import WAN_GRID, InputError

GRID = (2, 3, 2, 4)


@pytest.fixture(scope="module")
def arrays():
    rng = np.random.default_rng(0)
    arrays = {
        name: rng.standard_normal((*GRID, 16)).astype(np.float32)
        for name in ("noisy", "prior", "hands")
    }
    return {**arrays, "mask": rng.integers(0, 2, (*GRID, 4)).astype(np.float32)}


@pytest.fixture(scope="module")
def condition(arrays):
    return Condition(
        mask=jnp.asarray(arrays["mask"]),
        prior=jnp.asarray(arrays["prior"]),
        hands=jnp.asarray(arrays["hands"]),
        text=jnp.zeros((2, 5, 8)),
    )


def test_the_order_is_noisy_mask_prior_hands(arrays, condition):
    assembled = EGOSIM.assemble(jnp.asarray(arrays["noisy"]), condition)
    assert assembled.shape == (*GRID, 52)
    np.testing.assert_array_equal(assembled[..., EGOSIM.slice("hands")], arrays["hands"])
    for cell in np.ndindex(*GRID):
        expected = [arrays["noisy"][cell][c] for c in range(16)]
        expected += [arrays["mask"][cell][c] for c in range(4)]
        expected += [arrays["prior"][cell][c] * (1 - arrays["mask"][cell][0]) for c in range(16)]
        expected += [arrays["hands"][cell][c] for c in range(16)]
        np.testing.assert_array_equal(assembled[cell], expected)


def test_the_channels_take_the_dtype_of_the_prior(condition):
    half = jax.tree.map(lambda x: x.astype(jnp.bfloat16), condition)
    packed = np.asarray(condition.mask).astype(np.uint8)
    channels = EGOSIM.condition_channels(
        Condition(mask=packed, prior=half.prior, hands=condition.hands, text=half.text),
        condition.hands,
    )
    assert channels.dtype == jnp.bfloat16
    np.testing.assert_array_equal(channels[..., :4], packed)


@pytest.mark.parametrize(
    ("layout", "channels"),
    [
        (EGOSIM, 52),
        (WAN_INPAINT, 36),
        (ChannelLayout(parts=(("noisy", 16),)), 16),  # Wan 2.1 text to video
        (COGVIDEOX_INPAINT, 33),
        (DWM, 49),
        (DWM_WAN, 52),
    ],
)
def test_layouts_of_published_models_have_their_channels(layout, channels):
    rng = np.random.default_rng(0)
    latents = jnp.asarray(rng.standard_normal((1, 3, 2, 4, 16)), jnp.float32)
    condition = Condition(prior=latents, hands=-latents, text=jnp.zeros((1, 1, 1)))
    if "mask" in layout:
        mask = layout.pack_mask(rng.integers(0, 128, (9, 16, 32), np.uint8), WAN_GRID)
        assert mask.shape == (3, 2, 4, layout.count("mask"))
        condition = replace(condition, mask=jnp.asarray(mask)[None])
    assembled = layout.assemble(2 * latents, condition)
    assert assembled.shape == (1, 3, 2, 4, channels) == (*latents.shape[:-1], layout.channels)
    assert sum(map(layout.count, ("noisy", "mask", "prior", "hands"))) == channels


def test_a_mask_of_dwm_on_cogvideox_is_seven_tenths_and_leaves_the_prior():
    latents = jnp.full((1, 2, 2, 2, 16), 3.0)
    mask = DWM.pack_mask(np.zeros((5, 16, 16), np.uint8), WAN_GRID)
    condition = Condition(
        mask=jnp.asarray(mask)[None], prior=latents, hands=latents, text=jnp.zeros((1, 1, 1))
    )
    assembled = DWM.assemble(latents, condition)
    np.testing.assert_allclose(assembled[..., DWM.slice("mask")], 0.7)
    assert (assembled[..., DWM.slice("prior")] == 3).all()


def test_a_mask_of_wan_is_one_where_pixels_are_kept():
    condition = Condition(
        mask=jnp.asarray([0.0, 1.0, 1.0, 0.0]).reshape(1, 1, 1, 1, 4),
        prior=jnp.ones((1, 1, 1, 1, 16)),
        text=jnp.zeros((1, 1, 1)),
    )
    channels = WAN_INPAINT.condition_channels(condition, jnp.zeros((1, 1, 1, 1, 16)))
    assert channels.ravel().tolist() == [1, 0, 0, 1] + [1] * 16


def test_a_condition_that_lacks_a_part_is_refused(condition):
    with pytest.raises(InputError, match="hands"):
        EGOSIM.condition_channels(replace(condition, hands=None), condition.prior)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"parts": (("mask", 4), ("noisy", 16))}, "noisy must come first"),
        ({"parts": (("noisy", 16), ("mask", 4), ("mask", 4))}, "every part once"),
        ({"parts": (("noisy", 16), ("prior", 0))}, "needs a channel"),
        ({"mask_packing": "single"}, "gives 1"),
    ],
)
def test_a_layout_that_cannot_be_is_refused(changes, message):
    with pytest.raises(InputError, match=message):
        ChannelLayout(**changes)


def test_half_a_condition_has_the_means_of_its_latents_of_the_prior_where_it_is_observed():
    rng = np.random.default_rng(1)
    prior, hands = rng.standard_normal((2, 2, 3, 4, 8, 16)).astype(np.float32)
    mask = rng.integers(0, 2, (2, 3, 4, 8, 4)).astype(np.float32)
    mask[0, 0, :2, :2] = 1  # a block without an observed cell
    text = jnp.ones((2, 5, 8))
    condition = Condition(
        mask=jnp.asarray(mask), prior=jnp.asarray(prior), hands=jnp.asarray(hands), text=text
    )
    half, plain = EGOSIM.halve(condition), DWM_WAN.halve(condition)
    assert half.text is text
    assert half.mask is not None
    for cell in np.ndindex(2, 3, 2, 4):
        b, f, i, j = cell
        block = [(b, f, 2 * i + di, 2 * j + dj) for di in (0, 1) for dj in (0, 1)]
        observed = [prior[place] for place in block if mask[place][0] == 0]
        wanted = np.mean(observed, axis=0) if observed else np.zeros(16)
        np.testing.assert_allclose(half.prior[cell], wanted, atol=1e-6)
        np.testing.assert_array_equal(half.mask[cell], [mask[place][0] for place in block])
        every = np.mean([hands[place] for place in block], axis=0)
        np.testing.assert_allclose(half.hands[cell], every, atol=1e-6)
        every = np.mean([prior[place] for place in block], axis=0)
        np.testing.assert_allclose(plain.prior[cell], every, atol=1e-6)
        unmasked = 1 - mask[b, f, 2 * i, 2 * j, 0]
        channels = EGOSIM.condition_channels(half, half.hands)[cell]
        np.testing.assert_allclose(channels[4:20], unmasked * wanted, atol=1e-6)
