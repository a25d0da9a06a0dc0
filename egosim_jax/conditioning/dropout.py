"""Conditions left out in training, so that the denoiser also learns to do without them.

Each sample loses each condition on its own, with that condition's rate. What it sees instead:

    prior   latents 0 and mask 1: nothing was observed, everything is to be generated
    mask    0: everything is to be kept, what the EgoSim release assumes without a mask file;
            the prior stays. A dropped prior goes first: its mask is 1 in any case
    hands   latents 0
    text    embeddings 0, the empty prompt of the EgoSim release's continuous runner

The CLIP tokens of the first frame are never dropped.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Key

from egosim_jax.diffusion.objective import sample_keys
from egosim_jax.types import Condition, InputError


@dataclass(frozen=True, kw_only=True)
class ConditionDropout:
    """The share of training samples that do without each condition."""

    prior: float = 0.0
    """Rate at which the prior is dropped, and its mask says nothing was observed."""
    mask: float = 0.0
    """Rate at which the mask is dropped: everything counts as observed."""
    hands: float = 0.0
    """Rate at which the hands are dropped."""
    text: float = 0.0
    """Rate at which the prompt is dropped."""

    def __post_init__(self) -> None:
        """Check that the rates are probabilities."""
        for field in fields(self):
            rate = getattr(self, field.name)
            if not 0 <= rate <= 1:
                raise InputError(f"the dropout rate of {field.name} must be in [0, 1], not {rate}.")

    def apply(self, condition: Condition, key: Key[Array, " *keys"]) -> Condition:
        """Drop conditions; `key` is one key, or one for each sample."""
        keys = sample_keys(key, condition.prior.shape[0])
        draws = jax.vmap(lambda k: jax.random.uniform(k, (4,)))(keys)
        rates = jnp.array([self.prior, self.mask, self.hands, self.text])
        prior, mask, hands, text = (draws < rates).T
        return replace(
            condition,
            prior=_fill(condition.prior, prior, 0),
            mask=_fill(_fill(condition.mask, mask, 0), prior, 1),
            hands=_fill(condition.hands, hands, 0),
            text=_fill(condition.text, text, 0),
        )


def _fill(x: Array, where: Bool[Array, " b"], value: int) -> Array:
    """`x` with whole samples replaced by a constant."""
    return jnp.where(where.reshape(-1, *[1] * (x.ndim - 1)), jnp.asarray(value, x.dtype), x)
