"""Classifier-free condition dropout.

Each sample loses each condition independently, at that condition's rate, so that the denoiser also
learns to work without it (`condition.py`). A prior and a mask that are both dropped leave a mask of
1: nothing was observed.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from egosim_jax.conditioning.condition import Condition
from egosim_jax.diffusion.objective import sample_keys
from egosim_jax.types import InputError


@dataclass(frozen=True, kw_only=True)
class ConditionDropout:
    """Rates at which training samples lose their conditions."""

    prior: float = 0.0
    """Dropout rate of the prior; its mask then says that nothing was observed."""
    mask: float = 0.0
    """Dropout rate of the mask; everything then counts as observed."""
    hands: float = 0.0
    """Dropout rate of the hands."""
    text: float = 0.0
    """Dropout rate of the prompt."""

    def __post_init__(self) -> None:
        """Check that the rates are probabilities."""
        for field in fields(self):
            rate = getattr(self, field.name)
            if not 0 <= rate <= 1:
                raise InputError(f"the dropout rate of {field.name} must be in [0, 1], not {rate}.")

    def apply(self, condition: Condition, key: Key[Array, " *keys"]) -> Condition:
        """Drop conditions; `key` is one key, or one for each sample."""
        keys = sample_keys(key, condition.text.shape[0])
        draws = jax.vmap(lambda k: jax.random.uniform(k, (4,)))(keys)
        rates = jnp.array([self.prior, self.mask, self.hands, self.text])
        prior, mask, hands, text = (draws < rates).T
        condition = condition.drop("mask", mask).drop("prior", prior)
        return condition.drop("hands", hands).drop("text", text)
