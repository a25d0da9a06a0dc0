import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from egosim_jax.conditioning import Condition, ConditionDropout
from egosim_jax.types import InputError

NAMES = ["prior", "mask", "hands", "text"]


def make_condition(batch):
    """Every latent 2 or 3 and every text 5, so that what was dropped shows."""
    mask = jnp.tile(jnp.array([0.0, 1.0, 1.0, 0.0]), (batch, 1, 1, 2, 1))
    return Condition(
        mask=mask,
        prior=jnp.full((batch, 1, 1, 2, 16), 2.0),
        hands=jnp.full((batch, 1, 1, 2, 16), 3.0),
        text=jnp.full((batch, 2, 4), 5.0),
        image=jnp.full((batch, 2, 4), 7.0),
    )


CONDITION = make_condition(3)


def differing(a, b):
    return {n for n in [*NAMES, "image"] if not np.array_equal(getattr(a, n), getattr(b, n))}


def test_a_dropped_prior_is_zero_and_nothing_is_observed():
    dropped = ConditionDropout(prior=1.0).apply(CONDITION, jax.random.key(0))
    assert (dropped.prior == 0).all()
    assert (dropped.mask == 1).all()
    assert differing(dropped, CONDITION) == {"prior", "mask"}


def test_a_dropped_mask_says_all_is_observed_and_the_prior_stays():
    dropped = ConditionDropout(mask=1.0).apply(CONDITION, jax.random.key(0))
    assert (dropped.mask == 0).all()
    assert differing(dropped, CONDITION) == {"mask"}


def test_a_dropped_prior_decides_the_mask_even_if_that_is_dropped_too():
    dropped = ConditionDropout(prior=1.0, mask=1.0).apply(CONDITION, jax.random.key(0))
    assert (dropped.mask == 1).all()


@pytest.mark.parametrize("name", ["hands", "text"])
def test_dropped_hands_and_text_are_zero_and_nothing_else_changes(name):
    dropped = ConditionDropout(**{name: 1.0}).apply(CONDITION, jax.random.key(0))
    assert (getattr(dropped, name) == 0).all()
    assert differing(dropped, CONDITION) == {name}


def test_a_dropped_prompt_is_the_negative_one_of_a_model_that_has_one():
    condition = replace(CONDITION, null_text=jnp.full((3, 2, 4), 9.0))
    dropped = condition.drop("text", jnp.array([True, False, True]))
    assert dropped.text[:, 0, 0].tolist() == [9, 5, 9]
    assert differing(dropped, condition) == {"text"}


def test_each_condition_is_dropped_at_its_own_rate_and_independently():
    batch = 4000
    rates = {"prior": 0.1, "mask": 0.3, "hands": 0.5, "text": 0.7}
    condition = make_condition(batch)
    dropped = ConditionDropout(**rates).apply(condition, jax.random.key(1))
    gone = {
        "prior": np.asarray(dropped.prior == 0).all(axis=(1, 2, 3, 4)),
        "hands": np.asarray(dropped.hands == 0).all(axis=(1, 2, 3, 4)),
        "text": np.asarray(dropped.text == 0).all(axis=(1, 2)),
    }
    # A mask's loss shows where the prior was kept.
    mask = np.asarray(dropped.mask == 0).all(axis=(1, 2, 3, 4))[~gone["prior"]]
    for name, lost in [*gone.items(), ("mask", mask)]:
        # Five standard deviations of a binomial share.
        spread = 5 * math.sqrt(rates[name] * (1 - rates[name]) / len(lost))
        assert lost.mean() == pytest.approx(rates[name], abs=spread)
    both = (gone["hands"] & gone["text"]).mean()
    assert both == pytest.approx(0.35, abs=5 * math.sqrt(0.35 * 0.65 / batch))


def test_a_batch_with_its_own_keys_equals_batches_of_one():
    dropout = ConditionDropout(prior=0.5, mask=0.5, hands=0.5, text=0.5)
    keys = jax.random.split(jax.random.key(5), 3)
    together = dropout.apply(CONDITION, keys)
    for b in range(3):
        one = jax.tree.map(lambda x, b=b: x[b : b + 1], (CONDITION, together))
        assert not differing(dropout.apply(one[0], keys[b : b + 1]), one[1])


@pytest.mark.parametrize("rate", [-0.1, 1.5])
def test_a_rate_that_is_no_probability_is_refused(rate):
    with pytest.raises(InputError, match="hands"):
        ConditionDropout(hands=rate)
