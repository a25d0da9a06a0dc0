import jax
import jax.numpy as jnp
import numpy as np
import pytest

from egosim_jax.diffusion import Guidance
from egosim_jax.types import InputError

X = jnp.arange(32.0).reshape(2, 1, 2, 2, 4)
T = jnp.array([1000.0, 500.0])


def with_prompt(x, t):
    return 2 * x + t[:, None, None, None, None]


def without_prompt(x, t):
    return (x - 1).astype(jnp.bfloat16)


def test_guidance_extrapolates_from_the_unconditional_velocity():
    guided = Guidance(scale=3.0).guide(with_prompt, without_prompt)(X, T)
    for index in np.ndindex(*X.shape):
        t = float(T[index[0]])
        cond, uncond = 2 * float(X[index]) + t, float(X[index]) - 1
        # Small whole numbers, exact in every dtype at hand.
        assert guided[index] == uncond + 3 * (cond - uncond)


def test_scale_one_never_runs_the_unconditional_branch():
    def must_not_run(x, t):
        raise AssertionError("the unconditional branch was run")

    guided = Guidance(scale=1.0).guide(with_prompt, must_not_run)(X, T)
    np.testing.assert_array_equal(guided, with_prompt(X, T))


def test_timesteps_outside_of_the_interval_are_not_guided():
    ran = []

    def counted(x, t):
        jax.debug.callback(lambda _: ran.append(1), t[0])
        return without_prompt(x, t)

    guidance = Guidance(scale=3.0, interval=(400, 600))
    guided = guidance.guide(with_prompt, counted)(X, T)
    everywhere = Guidance(scale=3.0).guide(with_prompt, without_prompt)(X, T)
    np.testing.assert_array_equal(guided[1], everywhere[1])
    np.testing.assert_array_equal(guided[0], with_prompt(X, T)[0])
    guidance.guide(with_prompt, counted)(X, jnp.array([1000.0, 700.0]))
    jax.effects_barrier()
    assert len(ran) == 1


@pytest.mark.parametrize(
    ("scale", "interval"),
    [(2.0, (600, 400)), (2.0, (-1, 500)), (2.0, (0, 1001)), (2.0, (500, 500)), (1.0, (0, 500))],
)
def test_an_interval_that_is_empty_or_has_no_effect_is_refused(scale, interval):
    with pytest.raises(InputError, match="--guidance-interval"):
        Guidance(scale=scale, interval=interval)
